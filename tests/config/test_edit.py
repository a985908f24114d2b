"""Single values changed in a file: everything else stays, character by character."""

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from emt.config.edit import marked_calibrated, replace_file, with_values
from emt.config.errors import ConfigError
from emt.config.source import parse_document

TEXT = """# a comment: with a colon
filters:
  one: &one
    cov: {diagonal: [10, 2,   1]}   # three numbers
    rate: '0.5 deg/s'
  two:
    <<: *one
    cov: {diagonal: [4, 5, 6]}
"""


def value_of(text):
    document = parse_document(text, "f")
    assert document is not None
    return document.value


def test_only_the_value_changes():
    changed = with_values(TEXT, "f", {("filters", "one", "cov", "diagonal", 1): "7.5"})
    assert changed == TEXT.replace("[10, 2,   1]", "[10, 7.5,   1]")


def test_a_value_shared_by_a_merge_is_not_changed_for_one_alone():
    key = ("filters", "one", "rate")
    with pytest.raises(ConfigError, match=r"f:5: filters\.one\.rate: shares its value with filters\.two\.rate"):
        with_values(TEXT, "f", {key: "1"})
    both = with_values(TEXT, "f", {key: "1", ("filters", "two", "rate"): "1"})
    assert both == TEXT.replace("'0.5 deg/s'", "1")


def test_a_value_that_is_not_there():
    with pytest.raises(ConfigError, match="not given in this file"):
        with_values(TEXT, "f", {("filters", "one", "nothing"): "1"})


@given(
    entries=st.lists(st.sampled_from(["a.b", "a.c", "d", "e.f.g"]), unique=True),
    calibrated=st.lists(st.sampled_from(["a.b", "x", "y"]), unique=True),
    block=st.booleans(),
    newline=st.sampled_from(["\n", "\r\n"]),
    order=st.booleans(),
)
def test_a_tuned_key_moves_to_calibrated(entries, calibrated, block, newline, order):
    def group(name, keys):
        if not block or not keys:
            return [f"  {name}: [{', '.join(keys)}]  # {name}"]
        return [f"  {name}:  # {name}", *(f"    - {key}  # {key}" for key in keys)]

    groups = [group("paper", entries), group("calibrated", calibrated) if calibrated else []]
    lines = ["a: 1  # first", "sources:", *itertools.chain(*(groups if order else groups[::-1])), "z: 2"]
    before = newline.join(lines) + newline
    after = marked_calibrated(before, "f", ["a.b", "d"])
    sources = value_of(after)["sources"]
    assert sources["paper"] == [key for key in entries if key not in ("a.b", "d")]
    assert set(sources["calibrated"]) == {*calibrated, "a.b", "d"}
    assert len(sources["calibrated"]) == len(set(sources["calibrated"]))
    assert value_of(after)["a"] == 1
    assert value_of(after)["z"] == 2
    assert "# first" in after
    assert after.count("\r\n") == (after.count("\n") if newline == "\r\n" else 0)
    assert marked_calibrated(after, "f", ["a.b", "d"]) == after


@pytest.mark.parametrize(
    "text", ["a: 1\n", "a: 1", "a: 1\nsources:\n", "sources: {}\na: 1\n", "a: 1\nsources: {paper: [q]}\n"]
)
def test_a_file_without_calibrated_sources_gets_them(text):
    after = marked_calibrated(text, "f", ["a"])
    assert value_of(after)["sources"]["calibrated"] == ["a"]
    assert value_of(after)["a"] == 1


def test_a_file_is_replaced_whole_or_not_at_all(tmp_path):
    file = tmp_path / "a.yaml"
    file.write_text("a: 1\n")
    file.chmod(0o640)
    replace_file(file, "a: 2\r\n")
    assert file.read_bytes() == b"a: 2\r\n"
    assert file.stat().st_mode & 0o777 == 0o640
    assert [p.name for p in tmp_path.iterdir()] == ["a.yaml"]

"""Reading YAML: what scalars mean, where keys stand, and that nothing hostile gets further than a message."""

import ast
import contextlib
import math
import time
from pathlib import Path

import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from emt.config import source as source_module
from emt.config.errors import ConfigError
from emt.config.source import (
    MAX_BYTES,
    MAX_DEPTH,
    MAX_LINE,
    MAX_NODES,
    load_source,
    parse_source,
    plain_scalar,
)

ROOT = Path(__file__).parents[2]


def messages(text: str) -> list[str]:
    with pytest.raises(ConfigError) as caught:
        parse_source(text, "c.yaml")
    return str(caught.value).split("\n")


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1e-3", 1e-3), ("1E3", 1000.0), (".5", 0.5), ("-.5e2", -50.0), ("5.", 5.0), ("+1.5", 1.5),
        ("0x1F", 31), ("0o17", 15), ("012", 12), ("-7", -7), ("no", "no"), ("yes", "yes"), ("on", "on"),
        ("y", "y"), ("true", True), ("False", False), ("null", None), ("~", None), ("1_000", "1_000"),
        ("2024-01-01", "2024-01-01"), ("12:30", "12:30"), ("50 km/h", "50 km/h"), ("-45 deg", "-45 deg"),
        ("'5'", "5"), ('"true"', "true"), ("-.inf", -math.inf), (".Inf", math.inf), ("1e999", math.inf),
        ("=", "="), ("0b1", "0b1"), ("+.nan", "+.nan"), ("١", "١"),
        ("0x" + "f" * 60, "0x" + "f" * 60),
    ],
)  # fmt: skip
def test_scalars_follow_yaml_1_2(text, value):
    got = parse_source(f"a: {text}", "c.yaml").data["a"]
    assert got == value
    assert type(got) is type(value)


def test_nan_is_read_so_that_validation_can_refuse_it():
    assert math.isnan(parse_source("a: .nan", "c.yaml").data["a"])


def test_a_yaml_1_1_directive_does_not_change_the_meaning_of_no():
    assert parse_source("%YAML 1.1\n---\na: no\nb: 010\n", "c.yaml").data == {"a": "no", "b": 10}


def test_only_plain_types_come_out():
    data = parse_source("a: [1, 2.0, x, true, null, {b: x}]\nb: |\n  text\n", "c.yaml").data

    def check(value):
        assert type(value) in (dict, list, int, float, str, bool, type(None))
        for child in value.values() if isinstance(value, dict) else value if isinstance(value, list) else ():
            check(child)

    check(data)


def test_lines_of_keys_entries_and_ancestors():
    source = parse_source("# top\na:\n  b: 1\n  c:\n    - 1\n    - d: 2\n'5': x\n", "c.yaml")
    assert source.data == {"a": {"b": 1, "c": [1, {"d": 2}]}, "5": "x"}
    assert [source.line(k) for k in [("a",), ("a", "b"), ("a", "c", 0), ("a", "c", 1, "d"), ("5",)]] == [
        2,
        3,
        5,
        6,
        7,
    ]
    assert source.line(("a", "missing", "deeper")) == 2
    assert source.line(("nothing",)) == 2


def test_anchors_merges_and_their_lines():
    text = "base: &b {x: 1, y: 2}\nother: &o {y: 3, z: 4}\nuse:\n  y: 9\n  <<: [*b, *o]\nlist: [*b]\nsame: *b\n"
    source = parse_source(text, "c.yaml")
    assert source.data["use"] == {"x": 1, "y": 9, "z": 4}
    assert source.data["same"] == {"x": 1, "y": 2}
    assert source.data["same"] is not source.data["base"]
    assert [source.line(k) for k in [("use", "x"), ("use", "y"), ("use", "z"), ("list", 0), ("same",)]] == [
        1,
        4,
        2,
        6,
        7,
    ]


def test_merging_a_merge_and_the_earlier_merge_wins():
    data = parse_source("a: &a {x: 1}\nb: &b\n  <<: *a\n  y: 2\nc:\n  <<: [{y: 7}, *b]\n", "c.yaml").data
    assert data["c"] == {"x": 1, "y": 7}


def test_a_quoted_merge_sign_is_an_ordinary_key():
    assert parse_source("'<<': 1\n", "c.yaml").data == {"<<": 1}


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("a: 1\nb: 2\na: 3\n", "c.yaml:3: a: is given twice, first on line 1"),
        ("f:\n  x: 1\n  'x': 2\n", "c.yaml:3: f.x: is given twice, first on line 2"),
        ("a: {b: 1, b: 2}\n", "c.yaml:1: a.b: is given twice"),
        ("a: &a {}\nb:\n  <<: *a\n  <<: *a\n", "c.yaml:4: b.'<<': is given twice, first on line 3"),
        ("x: 1\na: !!python/object/apply:os.system ['true']\n",
         "c.yaml:2: a: the tag !!python/object/apply:os.system is not allowed; write the plain value"),
        ("a: !!float 3\n", "c.yaml:1: a: the tag !!float is not allowed; write the plain value"),
        ("a: !mine 3\n", "c.yaml:1: a: the tag !mine is not allowed; write the plain value"),
        ("!!map {a: 1}\n", "c.yaml:1: the tag !!map is not allowed; write the plain value"),
        ("!!str a: 1\n", "c.yaml:1: a key must be a plain name"),
        ("a: *x\n", "c.yaml:1: a: the alias *x has no anchor above it"),
        ("a: &a [*a]\n", "c.yaml:1: a[0]: the alias *a contains itself"),
        ("a: &a {<<: *a}\n", "c.yaml:1: a.'<<': the alias *a contains itself"),
        ("a:\n  <<: 3\n", "c.yaml:2: a.'<<': can only merge a mapping or a list of mappings"),
        ("? [a]\n: 1\n", "c.yaml:1: a key must be a plain name"),
        (": 1\n", "c.yaml:1: a key is missing or is not text"),
        ("- 1\n", "c.yaml:1: expected settings as 'key: value' at the top of the file"),
        ("\n\nhello\n", "c.yaml:3: expected settings as 'key: value' at the top of the file"),
        ("", "c.yaml: the file is empty"),
        ("# only this\n---\n", "c.yaml: the file is empty"),
        ("a: 1\n---\nb: 1\n", "c.yaml:2: a second document starts here; only one is allowed"),
        ("a: " + "9" * 41, "c.yaml:1: a: a whole number of more than 40 digits"),
        ('a: "\\ud800"\n', "c.yaml:1: a: an escape in this text is half a character"),
        ("a: b\nc: \x00\n", "c.yaml:2: not valid YAML: the character U+0000 is not allowed"),
        ("a: 1\nb: [1\nc: 2\n", "c.yaml:3: not valid YAML: "),
        ("a: 1\n\tb: 2\n", "c.yaml:2: not valid YAML: "),
        ('a: "\\UFFFFFFFF"\n', "c.yaml: not valid YAML: "),
    ],
)  # fmt: skip
def test_a_bad_file_is_a_message_with_its_line(text, expected):
    [message] = messages(text)
    assert message.startswith(expected)


def test_all_problems_at_once_by_line():
    assert [m.split(" ")[0] for m in messages("b: !x 1\na: 1\na: 2\nc: *no\n")] == [
        "c.yaml:1:",
        "c.yaml:3:",
        "c.yaml:4:",
    ]


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (b"a: 1\nb: \xff\n", ":2: not UTF-8 text"),
        ("a: 1".encode("utf-16"), ":1: not UTF-8 text"),
        (b"#" * (MAX_BYTES + 1), ": larger than the limit of 1024 KiB"),
        (b"", ": the file is empty"),
    ],
)
def test_bytes_that_are_no_settings(tmp_path, content, expected):
    path = tmp_path / "c.yaml"
    path.write_bytes(content)
    with pytest.raises(ConfigError) as caught:
        load_source(path)
    assert str(caught.value).startswith(str(path) + expected)


def test_files_that_cannot_be_read(tmp_path):
    for path, expected in [
        (tmp_path / "none.yaml", "no such file"),
        (tmp_path, "is a folder"),
        ("a\0b", "cannot be read"),
        (tmp_path / ("x" * 300), "cannot be read"),
    ]:
        with pytest.raises(ConfigError, match=expected):
            load_source(path)


def test_a_byte_order_mark_and_windows_line_ends_are_fine(tmp_path):
    path = tmp_path / "c.yaml"
    path.write_bytes(b"\xef\xbb\xbfa: 1\r\nb: 2\r\n")
    source = load_source(path)
    assert (source.data, source.line(("b",)), source.path) == ({"a": 1, "b": 2}, 2, path)


LAUGHS = "a0: &a0 [x, x]\n" + "".join(f"a{i}: &a{i} [*a{i - 1}, *a{i - 1}]\n" for i in range(1, 30))
HOSTILE = {
    "billion laughs": (LAUGHS, f"more than {MAX_NODES} values"),
    "merge laughs": (
        "a0: &a0 {k: 1}\n" + "".join(f"a{i}: &a{i} {{<<: [*a{i - 1}, *a{i - 1}], k{i}: 1}}\n" for i in range(1, 39)),
        None,
    ),
    "merge chain": (
        "a0: &a0 {k: 1}\n" + "".join(f"a{i}: &a{i} {{<<: *a{i - 1}}}\n" for i in range(1, 2000)),
        None,
    ),
    "merge chain upwards": (
        "x: {<<: &a {<<: &b {<<: &c {k: 1}}}}\n" + "y: " + "{<<: " * 50 + "{}" + "}" * 50,
        f"nested deeper than {MAX_DEPTH}",
    ),
    "wide merges": (
        "a: &a {"
        + ", ".join(f"k{i}: 1" for i in range(1000))
        + "}\n"
        + "".join(f"b{i}: {{<<: *a}}\n" for i in range(90)),
        f"more than {MAX_NODES} values",
    ),
    "one merge many times": (
        "a: &a {\n" + "".join(f"k{i}: 1,\n" for i in range(3000)) + "}\nb: {<<: [\n" + "*a,\n" * 3000 + "]}\n",
        f"more than {MAX_NODES} values",
    ),
    "merge chain under a repeated key": (
        "x: &a0 {k: 1}\n" + "".join(f"x: &a{i} {{<<: *a{i - 1}}}\n" for i in range(1, 2000)) + "y: *a1999\n",
        f"merges nested deeper than {MAX_DEPTH} levels",
    ),
    "long text repeated": (
        "a: &a " + "x" * 19_000 + "\n" + "b: [" + "*a, " * 4000 + "]\n",
        f"more than {MAX_NODES} values",
    ),
    "deep by aliases": (
        "a0: &a0 [x]\n" + "".join(f"a{i}: &a{i} [*a{i - 1}]\n" for i in range(1, 60)),
        f"nested deeper than {MAX_DEPTH}",
    ),
    "10k flow": ("a: " + "[" * 10_000, f"nested deeper than {MAX_DEPTH}"),
    "10k block": ("a:\n  " + "- " * 9_000, f"nested deeper than {MAX_DEPTH}"),
    "10k keys": ("? " * 9_000, f"nested deeper than {MAX_DEPTH}"),
    "many values": ("a:\n" + "- 1\n" * 25_000, f"more than {MAX_NODES} values"),
    "1 MB of [": ("[" * 1_000_000, f"line longer than {MAX_LINE}"),
    "1 MB of !": ("!" * 1_000_000, f"line longer than {MAX_LINE}"),
    "lines of [": (("[" * 10_000 + "\n") * 100, f"nested deeper than {MAX_DEPTH}"),
    "lines of !": (("!" * 10_000 + "\n") * 100, "not valid YAML"),
    "1 MB of tabs": ("\t" * 19_000 + "\n" + "\t\n" * 400_000, "not valid YAML"),
    "NUL bytes": ("\0" * 1_000_000, f"line longer than {MAX_LINE}"),
    "NUL byte": ("a: 1\n\0", "not allowed"),
    "long number": ("a: " + "9" * 19_000, "more than 40 digits"),
    "long hex": ("a: 0x" + "f" * 19_000, None),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_files_end_soon(name):
    text, expected = HOSTILE[name]
    start = time.process_time()
    if expected is None:
        with contextlib.suppress(ConfigError):
            parse_source(text, "c.yaml")
    else:
        assert any(expected in message for message in messages(text))
    assert time.process_time() - start < 10.0


def test_limits_are_the_last_accepted_value():
    deep = "a: " + "[" * (MAX_DEPTH - 1) + "1" + "]" * (MAX_DEPTH - 1)
    assert parse_source(deep, "c.yaml").data
    assert "nested deeper" in messages("a: [" + deep[3:] + "]")[0]
    assert parse_source("a: " + "x" * (MAX_LINE - 3), "c.yaml").data
    assert "line longer" in messages("a: " + "x" * (MAX_LINE - 2))[0]


YAML_BITS = st.lists(
    st.sampled_from(
        ["a", "b: ", "- ", "? ", ": ", "[", "]", "{", "}", ",", "&a ", "*a", "!!str ", "!x ", "<<: ", "|\n",
         ">\n", "'", '"', "\n", "  ", "\t", "#", "---\n", "...\n", "%YAML 1.1\n", "%TAG ! x\n", "1e3", ".nan",
         "~", "\\U", "\\xff", "\0", "\ufeff", "\x85", "\u2028", "é", "0x", "9" * 50, "@", "`", "\r"]
    ),
    max_size=40,
).map("".join)  # fmt: skip


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(st.one_of(YAML_BITS, YAML_BITS.map("a: ".__add__), st.text(max_size=60)))
@example('"\\UFFFFFFFF"')
@example("%YAML 1.x\n---\na: 1")
@example("a: &a\n<<: *a")
@example("&a a: *a")
def test_no_text_raises_anything_but_a_config_error(text):
    try:
        source = parse_source(text, "c.yaml")
    except ConfigError as error:
        str(error).encode()
        problems = error.problems
    else:
        problems = None
        assert isinstance(source.data, dict)
        assert () in source.places
    assert problems != ()


@settings(max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(content=st.one_of(st.binary(max_size=60), YAML_BITS.map(str.encode)))
def test_no_bytes_raise_anything_but_a_config_error(tmp_path, content):
    path = tmp_path / "fuzz.yaml"
    path.write_bytes(content)
    with contextlib.suppress(ConfigError):
        load_source(path)


@given(st.text(alphabet="0123456789+-.eExobinfaN_", max_size=12))
def test_plain_numbers_agree_with_python(text):
    value = plain_scalar(text)
    if isinstance(value, float) and math.isfinite(value):
        assert value == float(text)
    if isinstance(value, str):
        with pytest.raises(ValueError, match=r"invalid literal|could not convert"):
            int(text.replace("_", "?"))
        if not any(char in text.lower() for char in "_in"):
            with pytest.raises(ValueError, match="could not convert"):
                float(text)


def test_nothing_constructs_objects_and_nothing_imports_jax():
    for name in ["settings", "units", "matrices", "registry", "config/source", "config/errors", "config/overrides"]:
        tree = ast.parse((ROOT / "emt" / f"{name}.py").read_text())
        imported = {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names}
        imported |= {node.module or "" for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
        assert not any(module.split(".")[0] in ("jax", "jaxtyping", "pickle", "yaml") for module in imported)
        called = {
            node.func.id for node in ast.walk(tree) if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)
        }
        assert not called & {"eval", "exec", "compile"}
    assert ".load(" not in Path(source_module.__file__).read_text()

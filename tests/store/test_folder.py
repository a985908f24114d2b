import errno
import json
import os

import numpy as np
import pytest

from emt.store import (
    Chunk,
    ConfigMismatch,
    DamagedChunk,
    FileSystem,
    FolderBusy,
    NotARunFolder,
    RunFolder,
    StoreError,
    read_folder,
)
from emt.store import manifest as manifest_module
from emt.store.errors import SHOWN_DIFFERENCES
from tests.store.unreliable import assert_same_arrays, make_manifest, score_runs


def write_runs(path, *ranges, **identity) -> None:
    with RunFolder.open(path, make_manifest(**identity)) as folder:
        for start, stop in ranges:
            folder.write_chunk(start, stop, score_runs(start, stop))


def refused(path, error=NotARunFolder) -> str:
    """The message of a refused opening, after which the folder is as before."""
    before = sorted(path.rglob("*")) if path.is_dir() else path.read_bytes()
    with pytest.raises(error) as caught:
        RunFolder.open(path, make_manifest())
    assert (sorted(path.rglob("*")) if path.is_dir() else path.read_bytes()) == before
    return str(caught.value)


def test_write_resume_and_read(tmp_path):
    path = tmp_path / "results" / "run"
    with RunFolder.open(path, make_manifest()) as folder:
        assert folder.missing(100, 208) == [(0, 100)]
        written = folder.write_chunk(0, 100, score_runs(0, 100))
        assert written == Chunk(0, 100, path / "chunk-000000000-000000100.npz")
    with RunFolder.open(path, make_manifest()) as folder:
        assert folder.chunks() == [written]
        assert folder.missing(1000, 208) == [(100, 208), (208, 416), (416, 624), (624, 832), (832, 1000)]
        folder.write_chunk(100, 208, score_runs(100, 208))
    reader = read_folder(path)
    assert [(chunk.start, chunk.stop) for chunk in reader.chunks()] == [(0, 100), (100, 208)]
    assert_same_arrays(reader.read_chunk(reader.chunks()[1]), score_runs(100, 208))
    assert list(reader.read_chunk(reader.chunks()[0], ["label"])) == ["label"]
    with pytest.raises(StoreError, match="holds no array 'gwd'"):
        reader.read_chunk(reader.chunks()[0], ["gwd"])


def test_json_and_text(tmp_path):
    with RunFolder.open(tmp_path, make_manifest()) as folder:
        folder.write_json("summary.json", {"b": [1, None], "a": "Özkan"})
        folder.write_text("table.tex", "a\r\nb\n")
        with pytest.raises(ValueError, match="JSON compliant"):
            folder.write_json("summary.json", {"a": float("nan")})
    assert (tmp_path / "summary.json").read_bytes().decode() == (
        '{\n  "a": "Özkan",\n  "b": [\n    1,\n    null\n  ]\n}\n'
    )
    assert (tmp_path / "table.tex").read_bytes() == b"a\r\nb\n"
    assert read_folder(tmp_path).read_json("summary.json") == {"a": "Özkan", "b": [1, None]}
    with pytest.raises(StoreError, match=r"none\.json: cannot read the file: No such file"):
        read_folder(tmp_path).read_json("none.json")
    with pytest.raises(StoreError, match="is not JSON"):
        read_folder(tmp_path).read_json("table.tex")


@pytest.mark.parametrize("name", ["../a.json", "/a.json", ".lock", "a/b.json", "", "a.json\n"])
def test_names_stay_inside_the_folder(tmp_path, name):
    with RunFolder.open(tmp_path / "run", make_manifest()) as folder:
        for action in (lambda: folder.write_json(name, 1), lambda: folder.write_text(name, "")):
            with pytest.raises(ValueError, match="file name"):
                action()
        with pytest.raises(ValueError, match="file name"):
            folder.read_json(name)
    assert {file.name for file in tmp_path.iterdir()} == {"run"}


@pytest.mark.parametrize("name", ["manifest.json", "Manifest.JSON", "chunk-x", "a.partial"])
def test_names_of_the_store_itself_are_reserved(tmp_path, name):
    with (
        RunFolder.open(tmp_path, make_manifest()) as folder,
        pytest.raises(ValueError, match="reserved"),
    ):
        folder.write_text(name, "")


def test_nothing_is_overwritten_but_a_repeated_call_is_fine(tmp_path):
    with RunFolder.open(tmp_path, make_manifest()) as folder:
        folder.write_chunk(4, 8, score_runs(4, 8))
        folder.write_chunk(4, 8, score_runs(4, 8))
        with pytest.raises(StoreError, match=r"8\.npz already holds run 4, and nothing is overwritten"):
            folder.write_chunk(4, 8, {"x": np.zeros(4)})
        with pytest.raises(StoreError, match="already holds run 7"):
            folder.write_chunk(7, 9, score_runs(7, 9))
        for start, stop in [(3, 3), (5, 4), (-1, 2)]:
            with pytest.raises(ValueError, match="0 <= start < stop"):
                folder.write_chunk(start, stop, {})
        assert_same_arrays(folder.read_chunk(folder.chunks()[0]), score_runs(4, 8))


def test_overlapping_files_are_an_error(tmp_path):
    write_runs(tmp_path, (0, 4))
    (tmp_path / "chunk-000000003-000000005.npz").write_bytes(b"")
    with pytest.raises(StoreError, match=r"000000004\.npz and chunk-000000003-.* both hold run 3"):
        read_folder(tmp_path).chunks()


def test_wrong_byte_in_a_chunk(tmp_path):
    write_runs(tmp_path, (0, 4), (4, 8))
    path = tmp_path / "chunk-000000004-000000008.npz"
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    reader = read_folder(tmp_path)
    with pytest.raises(DamagedChunk) as caught:
        reader.read_chunk(reader.chunks()[1])
    message = str(caught.value)
    assert message.startswith(f"{path}: damaged (")
    assert "it held runs 4 to 7. Remove this file and run the same command again" in message
    assert (caught.value.start, caught.value.stop) == (4, 8)
    path.unlink()
    assert reader.missing(8, 4) == [(4, 8)]


def test_chunk_renamed_or_brought_from_another_configuration(tmp_path):
    write_runs(tmp_path / "a", (0, 4))
    write_runs(tmp_path / "b", (4, 8), seed=8)
    os.replace(tmp_path / "b/chunk-000000004-000000008.npz", tmp_path / "a/chunk-000000004-000000008.npz")
    os.link(tmp_path / "a/chunk-000000000-000000004.npz", tmp_path / "a/chunk-000000008-000000012.npz")
    reader = read_folder(tmp_path / "a")
    _, foreign, renamed = reader.chunks()
    with pytest.raises(DamagedChunk, match="belongs to another configuration"):
        reader.read_chunk(foreign)
    with pytest.raises(DamagedChunk, match="is of runs 0 to 4"):
        reader.read_chunk(renamed)


def test_other_configuration_is_refused_by_dotted_keys(tmp_path):
    filters = [{"kind": "random-matrix", "forgetting": 0.9}, {"kind": "memekf"}]
    write_runs(tmp_path, (0, 4))
    before = (tmp_path / "manifest.json").read_bytes()
    with pytest.raises(ConfigMismatch) as caught:
        RunFolder.open(tmp_path, make_manifest(seed=True, filters=filters, extra=None))
    assert [tuple(difference) for difference in caught.value.differences] == [
        ("extra", "(absent)", "null"),
        ("filters.0.forgetting", "0.99", "0.9"),
        ("filters.1", "(absent)", '{"kind": "memekf"}'),
        ("seed", "7", "true"),
    ]
    assert "  filters.0.forgetting: stored 0.99, now 0.9\n" in str(caught.value)
    assert (tmp_path / "manifest.json").read_bytes() == before
    write_runs(tmp_path, (4, 8))  # the refusal left no lock behind


def test_long_list_of_differences_is_cut(tmp_path):
    write_runs(tmp_path)
    many = {f"key{i:03d}": "x" * 500 for i in range(SHOWN_DIFFERENCES + 5)}
    with pytest.raises(ConfigMismatch) as caught:
        RunFolder.open(tmp_path, make_manifest(**many))
    assert len(caught.value.differences) == SHOWN_DIFFERENCES + 5
    assert "  and 5 more\n" in str(caught.value)
    assert len(str(caught.value)) < 100 * (SHOWN_DIFFERENCES + 5)


def test_order_of_keys_tuples_and_whole_floats_do_not_matter(tmp_path):
    RunFolder.open(tmp_path, {"identity": {"a": 1, "b": {"c": [1, 2], "d": 2.0}}}).close()
    RunFolder.open(tmp_path, {"identity": {"b": {"d": 2, "c": (1, 2)}, "a": 1.0}}).close()
    with pytest.raises(ConfigMismatch, match="  a: stored 1, now true\n"):  # though equal in Python
        RunFolder.open(tmp_path, {"identity": {"a": True, "b": {"c": [1, 2], "d": 2.0}}})


def test_environments_are_recorded_not_compared(tmp_path):
    for device in ("cpu", "gpu", "gpu", "cpu"):
        RunFolder.open(tmp_path, make_manifest(device) | {"n_runs": len(device)}).close()
    manifest = read_folder(tmp_path).manifest
    assert manifest["environments"] == [{"device": "cpu"}, {"device": "gpu"}]
    assert manifest["environment"] == {"device": "cpu"}
    assert manifest["n_runs"] == 3


@pytest.mark.parametrize("given", [{}, {"identity": {}, "format": "x"}, {"identity": {"a": float("inf")}}])
def test_unusable_manifest_creates_nothing(tmp_path, given):
    with pytest.raises(ValueError, match=r"manifest needs|JSON compliant"):
        RunFolder.open(tmp_path / "run", given)
    assert list(tmp_path.iterdir()) == []


def test_foreign_folders_are_refused_untouched(tmp_path):
    (tmp_path / "thesis.tex").write_text("years of work")
    assert "holds other files ('thesis.tex')" in refused(tmp_path)
    assert "is a file and not a folder" in refused(tmp_path / "thesis.tex")
    with pytest.raises(NotARunFolder, match=r"there is no manifest\.json"):
        read_folder(tmp_path)
    with pytest.raises(NotARunFolder, match=r"there is no manifest\.json"):
        read_folder(tmp_path / "nowhere")


def test_manifest_of_another_program(tmp_path):
    (tmp_path / "manifest.json").write_text('{"name": "web page"}')
    (tmp_path / "film.partial").write_text("")
    assert "manifest.json is of another program" in refused(tmp_path)


def test_damaged_and_later_manifests(tmp_path):
    write_runs(tmp_path, (0, 4))
    path = tmp_path / "manifest.json"
    stored = json.loads(path.read_text())
    for text, message in [
        (json.dumps(stored | {"identity": {"seed": 8}}), "does not match its checksum"),
        (json.dumps(stored | {"format_version": 2}), "written in format 2"),
        (json.dumps(stored | {"environments": 1}), "no list of environments"),
        (path.read_text()[:-20], "damaged"),
        ('{"a": NaN}', "NaN is not a number"),
        ("[" * 10**5, "nested too deeply"),
    ]:
        path.write_text(text)
        assert message in refused(tmp_path, StoreError)


def test_size_is_limited_before_parsing(tmp_path, monkeypatch):
    write_runs(tmp_path)
    with RunFolder.open(tmp_path, make_manifest()) as folder:
        folder.write_json("big.json", ["x" * 1000])
        monkeypatch.setattr(manifest_module, "MAX_JSON_BYTES", 100)
        with pytest.raises(ValueError, match="more than the 100"):
            folder.write_json("big.json", ["x" * 1000])
    monkeypatch.undo()
    monkeypatch.setattr("emt.store.reader.MAX_JSON_BYTES", 100)
    monkeypatch.setattr("emt.store.reader.decode_json", pytest.fail)
    monkeypatch.setattr("emt.store.reader.parse_manifest", pytest.fail)
    with pytest.raises(StoreError, match="is larger than"):
        folder.read_json("big.json")
    with pytest.raises(StoreError, match="is larger than"):
        read_folder(tmp_path)


def test_leftovers_are_ignored_and_removed(tmp_path):
    write_runs(tmp_path, (0, 4))
    leftovers = [tmp_path / "chunk-000000004-000000008.npz.partial", tmp_path / "summary.json.partial"]
    for path in leftovers:
        path.write_bytes(b"half")
    assert len(read_folder(tmp_path).chunks()) == 1
    assert all(path.exists() for path in leftovers)  # a reader removes nothing
    with RunFolder.open(tmp_path, make_manifest()) as folder:
        assert not any(path.exists() for path in leftovers)
        assert folder.missing(8, 4) == [(4, 8)]


def test_closed_folder_reads_but_does_not_write(tmp_path):
    write_runs(tmp_path, (0, 4))
    folder = RunFolder.open(tmp_path, make_manifest())
    folder.close()
    folder.close()
    for action in (lambda: folder.write_chunk(4, 8, {}), lambda: folder.write_text("a", "")):
        with pytest.raises(StoreError, match="is closed"):
            action()
    assert_same_arrays(folder.read_chunk(folder.chunks()[0]), score_runs(0, 4))


def test_second_opening_in_the_same_process_is_refused(tmp_path):
    with RunFolder.open(tmp_path, make_manifest()):
        for _ in range(2):  # the refusal itself must not free the lock
            with pytest.raises(FolderBusy, match=f"process {os.getpid()} on") as caught:
                RunFolder.open(tmp_path, make_manifest())
            assert caught.value.pid == os.getpid()
    assert (tmp_path / ".lock").read_bytes() == b""  # names no owner it does not have
    RunFolder.open(tmp_path, make_manifest()).close()


@pytest.mark.parametrize(
    ("code", "advice"),
    [
        (errno.EACCES, "Get the permission, or choose another output folder"),
        (errno.ENOSPC, "Free some space on that disk"),
        (errno.ENOLCK, "Choose an output folder on a disk with file locks"),
        (errno.EIO, "Check the disk"),
    ],
)
def test_message_says_what_to_do(tmp_path, code, advice):
    class Refusing(FileSystem):
        def lock(self, path):
            raise OSError(code, os.strerror(code))

    with pytest.raises(StoreError) as caught:
        RunFolder.open(tmp_path, make_manifest(), Refusing())
    assert str(caught.value) == (
        f"{tmp_path}: cannot open the folder: {os.strerror(code)}. "
        f"{advice}, then run the same command again; finished chunks are kept."
    )


def test_writing_many_chunks_lists_the_folder_once(tmp_path):
    """Otherwise a run of a million chunks would spend its time on listings."""
    listings = []

    class Counting(FileSystem):
        def listdir(self, path):
            listings.append(path)
            return super().listdir(path)

    with RunFolder.open(tmp_path, make_manifest(), Counting()) as folder:
        before = len(listings)
        for start in (40, 0, 20, 60, 10, 30, 50):  # in any order
            folder.write_chunk(start, start + 10, score_runs(start, start + 10))
        assert len(listings) - before == 1
        for start, stop in ((5, 8), (35, 45), (0, 100), (69, 80)):
            with pytest.raises(StoreError, match="already holds run"):
                folder.write_chunk(start, stop, score_runs(start, stop))
        folder.write_chunk(20, 30, score_runs(20, 30))  # the same again
        (tmp_path / "chunk-000000020-000000030.npz").unlink()
        folder.write_chunk(20, 28, score_runs(20, 28))  # as the message advises
        with pytest.raises(StoreError, match="already holds run 27"):
            folder.write_chunk(27, 30, score_runs(27, 30))
        assert folder.missing(80, 100) == [(28, 30), (70, 80)]

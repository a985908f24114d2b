import io
import json
import zipfile

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from emt.store.chunks import (
    DamageError,
    chunk_name,
    decode_chunk,
    encode_chunk,
    missing_ranges,
    parse_chunk_name,
)
from tests.store.unreliable import assert_same_arrays, score_runs


def decode(data: bytes, start: int = 4, stop: int = 8, identity: str = "id", names=None):
    return decode_chunk(io.BytesIO(data), start, stop, identity, names)


def rewrite(data: bytes, member: str, content: bytes, method: int = zipfile.ZIP_STORED) -> bytes:
    """The same archive with one member replaced or added, and valid zip checksums."""
    stream = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as old, zipfile.ZipFile(stream, "w", method) as new:
        for name in old.namelist():
            if name != member:
                new.writestr(name, old.read(name))
        new.writestr(member, content)
    return stream.getvalue()


def test_gives_back_what_was_written():
    odd = {
        "empty": np.zeros((0, 3)),
        "scalar": np.array(2.5),
        "flags": np.array([True, False]),
        "complex": np.array([1j, np.nan]),
        "big_endian": np.arange(3, dtype=">f4"),
        "text": np.array(["", "Göttingen"]),
        "no_text": np.array([], dtype="U"),
        "small": np.arange(3, dtype=np.uint8),
    }
    found = decode(encode_chunk(odd, 4, 8, "id"))
    expected = odd | {"big_endian": odd["big_endian"].astype("<f4")}
    assert_same_arrays(found, expected)
    found["flags"][0] = False  # the caller owns what he gets


def test_equal_arrays_give_equal_bytes_whatever_their_layout():
    arrays = score_runs(4, 8)
    shuffled = {name: np.asfortranarray(arrays[name]) for name in reversed(list(arrays))}
    strided = {name: np.repeat(array, 2, axis=0)[::2] for name, array in arrays.items()}
    swapped = {name: array.astype(array.dtype.newbyteorder(">")) for name, array in arrays.items()}
    data = encode_chunk(arrays, 4, 8, "id")
    for same in (shuffled, strided, swapped):
        assert encode_chunk(same, 4, 8, "id") == data


def test_numpy_reads_it():
    with np.load(io.BytesIO(encode_chunk(score_runs(4, 8), 4, 8, "id")), allow_pickle=False) as file:
        np.testing.assert_array_equal(file["vb/rmse"], score_runs(4, 8)["vb/rmse"])


def test_only_some_arrays():
    data = encode_chunk(score_runs(4, 8), 4, 8, "id")
    assert list(decode(data, names=["label"])) == ["label"]
    with pytest.raises(KeyError, match="holds no array 'gwd', only label, vb/rmse, vb/status"):
        decode(data, names=["gwd"])


@pytest.mark.parametrize("name", ["", "../x", "/x", "a//b", ".x", "a/../b", "a b", "x" * 101])
def test_refuses_names(name):
    with pytest.raises(ValueError, match="array name"):
        encode_chunk({name: np.zeros(1)}, 0, 1, "id")


@pytest.mark.parametrize(
    "array",
    [
        np.array([{}], dtype=object),
        np.zeros(2, dtype="f8,i4"),
        np.array([b"x"]),
        np.array(["2026-01-01"], dtype="M8[D]"),
        np.zeros(2, dtype="V4"),
        np.zeros(2, dtype=np.longdouble),
    ],
    ids=lambda array: str(array.dtype),
)
def test_refuses_dtypes(array):
    with pytest.raises(ValueError, match="not a plain number, bool or text"):
        encode_chunk({"x": array}, 0, 1, "id")


def test_every_wrong_byte_is_found_or_harmless():
    arrays = score_runs(4, 8)
    data = encode_chunk(arrays, 4, 8, "id")
    found = 0
    for position in range(len(data)):
        for flip in (0x01, 0xFF):
            wrong = bytearray(data)
            wrong[position] ^= flip
            try:
                assert_same_arrays(decode(bytes(wrong)), arrays)  # a time stamp of the zip, say
            except DamageError:
                found += 1
    assert found > len(data)


def test_wrong_numbers_are_found_even_if_the_zip_is_consistent():
    data = encode_chunk({"x": np.zeros(3)}, 4, 8, "id")
    other = encode_chunk({"x": np.ones(3)}, 4, 8, "id")
    with zipfile.ZipFile(io.BytesIO(other)) as archive:
        forged = rewrite(data, "x.npy", archive.read("x.npy"))
    with pytest.raises(DamageError, match="checksum of 'x' differs"):
        decode(forged)
    header = rewrite(data, "header.json", zipfile.ZipFile(io.BytesIO(data)).read("header.json").replace(b"4", b"5"))
    with pytest.raises(DamageError, match="checksum of the header differs"):
        decode(header)


def test_every_truncation_is_found():
    data = encode_chunk(score_runs(4, 8), 4, 8, "id")
    for length in range(len(data)):
        with pytest.raises(DamageError):
            decode(data[:length])


def test_chunk_of_other_runs_or_of_another_configuration():
    data = encode_chunk(score_runs(4, 8), 4, 8, "id")
    with pytest.raises(DamageError, match="runs 4 to 8"):
        decode(data, start=0, stop=4)
    with pytest.raises(DamageError, match="another configuration"):
        decode(data, identity="other")


def test_nothing_hostile_is_unfolded():
    data = encode_chunk({"x": np.zeros(3)}, 4, 8, "id")
    with pytest.raises(DamageError, match="compressed"):
        decode(rewrite(data, "bomb.npy", bytes(10**6), zipfile.ZIP_DEFLATED))
    with pytest.raises(DamageError, match="not those its header lists"):
        decode(rewrite(data, "more.npy", b""))
    with pytest.raises(DamageError):
        decode(rewrite(data, "header.json", b"[" * 10**5))


@pytest.mark.parametrize(
    "layout",
    [
        "{'descr': '|O', 'fortran_order': False, 'shape': (3,), }",
        "{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000000,), }",
        "{'descr': '<f8', 'fortran_order': False, 'shape': (-1, -3), }",
        "__import__('os').abort()",
    ],
)
def test_forged_array_header_with_right_checksums(layout, monkeypatch):
    import emt.store.chunks as chunks

    text = layout.encode().ljust(117) + b"\n"
    forged = b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text + bytes(24)
    monkeypatch.setattr(chunks, "_encode_array", lambda name, values: forged)
    data = encode_chunk({"x": np.zeros(3)}, 4, 8, "id")
    with pytest.raises(DamageError, match=r"unreadable header|not plain numbers"):
        decode(data)


def test_header_is_readable_by_people():
    with zipfile.ZipFile(io.BytesIO(encode_chunk(score_runs(4, 8), 4, 8, "id"))) as archive:
        header = json.loads(archive.read("header.json"))
    assert (header["start"], header["stop"], header["identity"]) == (4, 8, "id")


def test_file_names():
    assert chunk_name(0, 208) == "chunk-000000000-000000208.npz"
    for start, stop in [(0, 1), (999_999_999, 1_000_000_000), (10**12, 10**12 + 7)]:
        assert parse_chunk_name(chunk_name(start, stop)) == (start, stop)
    for name in ["chunk-000000000-000000208.npz.partial", "chunk-000000005-000000005.npz", "chunk-0-4.npz"]:
        assert parse_chunk_name(name) is None
    assert parse_chunk_name("chunk-0000000000-0000000004.npz") is None  # a second name for the same runs


def test_missing_ranges_end_at_multiples():
    assert missing_ranges([(0, 100)], 1000, 208) == [
        (100, 208), (208, 416), (416, 624), (624, 832), (832, 1000)
    ]  # fmt: skip
    assert missing_ranges([], 5, 2) == [(0, 2), (2, 4), (4, 5)]
    assert missing_ranges([(0, 8)], 5, 2) == []
    assert missing_ranges([(3, 6), (7, 9)], 8, 4) == [(0, 3), (6, 7)]
    assert missing_ranges([], 0, 4) == []
    for n_runs, chunk_size in [(-1, 4), (4, 0)]:
        with pytest.raises(ValueError, match="n_runs"):
            missing_ranges([], n_runs, chunk_size)


@settings(database=None, deadline=None)
@given(st.sets(st.integers(0, 60)), st.integers(0, 60), st.integers(1, 20))
def test_missing_ranges_are_exactly_the_missing_runs(cuts, n_runs, chunk_size):
    edges = sorted(cuts)
    done = list(zip(edges[::2], edges[1::2], strict=False))
    ranges = missing_ranges(done, n_runs, chunk_size)
    finished = {run for start, stop in done for run in range(start, stop)}
    runs = [run for start, stop in ranges for run in range(start, stop)]
    assert runs == [run for run in range(n_runs) if run not in finished]
    for start, stop in ranges:
        assert start // chunk_size == (stop - 1) // chunk_size  # never across a multiple

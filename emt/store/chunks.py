"""Chunk files: the arrays of a range of runs, with checksums, as bytes that depend on nothing else.

A chunk is an uncompressed zip of `.npy` members that `numpy.load` reads, and a `header.json` that
says which runs of which configuration it holds and the SHA-256 of every member. Members are stored, not
compressed: Monte Carlo numbers hardly shrink, compressed bytes change with the zlib version, and nothing
can unfold to more than the size of the file.
"""

import hashlib
import io
import json
import math
import re
import struct
import zipfile
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from numpy.lib import format as npy

from emt.store.files import is_plain_name

HEADER = "header.json"
MAX_HEADER_BYTES = 16 * 2**20
MIDNIGHT_1980 = (1980, 1, 1, 0, 0, 0)
CHUNK_NAME = re.compile(r"chunk-(\d{9,18})-(\d{9,18})\.npz", re.ASCII)
# what a wrong byte in the tables of a zip surfaces as
WRONG_BYTES = (
    zipfile.BadZipFile,
    struct.error,
    ValueError,
    EOFError,
    ArithmeticError,
    RuntimeError,
    KeyError,
)
PLAIN_DTYPE = re.compile(r"\|b1|\|[iu]1|<[iu][248]|<f[248]|<c(8|16)|<U\d+", re.ASCII)


class Chunk(NamedTuple):
    """A finished range of runs: `start` to `stop - 1`, and the file that holds it."""

    start: int
    stop: int
    path: Path


class DamageError(Exception):
    """A chunk file is not what was written; the text says what the check found."""


def chunk_name(start: int, stop: int) -> str:
    """File name of the chunk holding runs `start` to `stop - 1`."""
    return f"chunk-{start:09d}-{stop:09d}.npz"


def parse_chunk_name(name: str) -> tuple[int, int] | None:
    """The range `[start, stop)` a file name stands for, None if it is not the name of a chunk."""
    match = CHUNK_NAME.fullmatch(name)
    if match is None:
        return None
    start, stop = int(match[1]), int(match[2])
    return (start, stop) if chunk_name(start, stop) == name and start < stop else None


def missing_ranges(done: Iterable[tuple[int, int]], n_runs: int, chunk_size: int) -> list[tuple[int, int]]:
    """What is still to compute so that runs 0 to `n_runs - 1` are covered.

    Args:
        done: Finished ranges `[start, stop)`, sorted, without overlap; they may reach beyond `n_runs`.
        n_runs: Number of runs wanted.
        chunk_size: Largest length of a range; ranges end at its multiples wherever a finished range allows.

    Returns:
        Ranges `[start, stop)`, sorted.

    Raises:
        ValueError: Negative `n_runs`, or a `chunk_size` below 1.
    """
    if n_runs < 0 or chunk_size < 1:
        raise ValueError(f"n_runs must be >= 0 and chunk_size >= 1, not {n_runs} and {chunk_size}")
    ranges = []
    position = 0
    for start, stop in [*done, (n_runs, n_runs)]:
        while position < min(start, n_runs):
            end = min(start, n_runs, (position // chunk_size + 1) * chunk_size)
            ranges.append((position, end))
            position = end
        position = max(position, stop)
    return ranges


def encode_chunk(arrays: Mapping[str, np.ndarray], start: int, stop: int, identity: str) -> bytes:
    """The bytes of a chunk file; equal arguments give equal bytes, whatever the memory order of the arrays.

    Args:
        arrays: Plain numbers, truth values or texts; a name is one or more plain names joined by `/`.
        start: First run.
        stop: One past the last run.
        identity: Fingerprint of the configuration the numbers belong to.

    Raises:
        ValueError: A name outside the whitelist, or a dtype that is not a plain number, bool or text.
    """
    members: dict[str, bytes] = {}
    for name in sorted(arrays):
        if not all(is_plain_name(part) for part in name.split("/")):
            raise ValueError(f"array name {name!r}: only letters, digits, '_', '.', '-', parts joined by '/'")
        members[name] = _encode_array(name, arrays[name])
    header = {
        "arrays": {name: hashlib.sha256(data).hexdigest() for name, data in members.items()},
        "identity": identity,
        "start": start,
        "stop": stop,
    }
    header["sha256"] = _header_checksum(header)
    text = json.dumps(header, sort_keys=True, indent=2).encode()
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_STORED) as archive:
        archive.writestr(_member(HEADER), text)
        for name, data in members.items():
            archive.writestr(_member(f"{name}.npy"), data)
    return stream.getvalue()


def decode_chunk(
    stream: BinaryIO, start: int, stop: int, identity: str, names: Iterable[str] | None = None
) -> dict[str, np.ndarray]:
    """Read a chunk and check every byte that is handed out against its checksum.

    Args:
        stream: The file.
        start: First run the file must hold.
        stop: One past the last run it must hold.
        identity: Fingerprint of the configuration it must belong to.
        names: Arrays wanted, all if None; the others are not read.

    Raises:
        DamageError: The content is not what was written, or belongs to other runs or another configuration.
        KeyError: An intact chunk does not hold one of `names`; its argument is a sentence.
        OSError: The file cannot be read.
    """
    try:
        with zipfile.ZipFile(stream) as archive:
            members = _list_members(archive)
            checksums = _read_header(archive, members, start, stop, identity)
            wanted = sorted(checksums) if names is None else list(names)
            contents = {name: archive.read(members[f"{name}.npy"]) for name in wanted if f"{name}.npy" in members}
    except WRONG_BYTES as error:
        raise DamageError(f"not a readable chunk: {error}") from error
    for name in wanted:
        if name not in checksums:
            raise KeyError(f"holds no array {name!r}, only {', '.join(sorted(checksums)) or 'none'}")
    return {name: _decode_array(name, contents[name], checksums[name]) for name in wanted}


def _member(name: str) -> zipfile.ZipInfo:
    member = zipfile.ZipInfo(name, MIDNIGHT_1980)
    member.create_system = 3  # zipfile would record the system it runs on
    member.external_attr = 0o644 << 16
    return member


def _encode_array(name: str, values: Any) -> bytes:
    array = np.asarray(values)
    array = np.asarray(array, dtype=array.dtype.newbyteorder("<"), order="C")
    if PLAIN_DTYPE.fullmatch(array.dtype.str) is None:
        raise ValueError(f"array {name!r}: dtype {array.dtype} is not a plain number, bool or text")
    stream = io.BytesIO()
    layout = {"descr": array.dtype.str, "fortran_order": False, "shape": array.shape}
    npy.write_array_header_1_0(stream, layout)
    return stream.getvalue() + array.tobytes()


def _decode_array(name: str, data: bytes, checksum: str) -> np.ndarray:
    if hashlib.sha256(data).hexdigest() != checksum:
        raise DamageError(f"checksum of {name!r} differs")
    stream = io.BytesIO(data)
    try:
        if npy.read_magic(stream) != (1, 0):
            raise ValueError("unknown version")
        shape, fortran_order, dtype = npy.read_array_header_1_0(stream)
    except ValueError as error:
        raise DamageError(f"array {name!r} has an unreadable header") from error
    # the size is compared before anything is allocated; a checksum keeps out accidents, not intent
    expected = len(data) - stream.tell()
    plain = PLAIN_DTYPE.fullmatch(dtype.str) is not None and not fortran_order
    if not plain or any(n < 0 for n in shape) or math.prod(shape) * dtype.itemsize != expected:
        raise DamageError(f"array {name!r} is not plain numbers, or its size is wrong")
    return np.ndarray(shape, dtype, buffer=data, offset=stream.tell()).copy()


def _list_members(archive: zipfile.ZipFile) -> dict[str, zipfile.ZipInfo]:
    members = {member.filename: member for member in archive.infolist()}
    if len(members) != len(archive.infolist()):
        raise DamageError("a member appears twice")
    for member in members.values():
        if member.compress_type != zipfile.ZIP_STORED or member.file_size != member.compress_size:
            raise DamageError("a member is compressed, which emt never writes")
    return members


def _read_header(
    archive: zipfile.ZipFile, members: Mapping[str, zipfile.ZipInfo], start: int, stop: int, identity: str
) -> dict[str, str]:
    """Checksum of every array, once the header itself is known to be the right one."""
    if HEADER not in members or members[HEADER].file_size > MAX_HEADER_BYTES:
        raise DamageError("its header is missing or too large")
    header = json.loads(archive.read(members[HEADER]))
    if not isinstance(header, dict) or header.pop("sha256", None) != _header_checksum(header):
        raise DamageError("checksum of the header differs")
    checksums = header.get("arrays")
    if not isinstance(checksums, dict) or set(members) != {HEADER, *(f"{name}.npy" for name in checksums)}:
        raise DamageError("its arrays are not those its header lists")
    if (header.get("start"), header.get("stop")) != (start, stop):
        raise DamageError(f"its content is of runs {header.get('start')} to {header.get('stop')} (exclusive)")
    if header.get("identity") != identity:
        raise DamageError("its content belongs to another configuration")
    return checksums


def _header_checksum(header: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(header, sort_keys=True).encode()).hexdigest()

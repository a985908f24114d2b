"""The read side of a run folder, for reports: no lock, no writing, safe while another process writes."""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from emt.store.chunks import Chunk, DamageError, decode_chunk, missing_ranges, parse_chunk_name
from emt.store.errors import DamagedChunk, NotARunFolder, StoreError, disk_trouble
from emt.store.files import FileSystem, is_plain_name
from emt.store.manifest import MANIFEST, MAX_JSON_BYTES, decode_json, parse_manifest


class RunReader:
    """A run folder open for reading.

    Args:
        path: An existing run folder.
        fs: The disk.

    Attributes:
        path: The folder.
        manifest: Its manifest: `identity`, `environment`, `environments`, and what else was recorded.

    Raises:
        NotARunFolder: There is no manifest of ours.
        StoreError: The manifest is damaged or cannot be read.
    """

    def __init__(self, path: str | Path, fs: FileSystem | None = None):
        self.path = Path(path)
        self._fs = FileSystem() if fs is None else fs
        self.manifest: dict[str, Any] = read_manifest(self._fs, self.path)

    def chunks(self) -> list[Chunk]:
        """Finished chunks in order of runs; the content is checked only by `read_chunk`.

        Raises:
            StoreError: Two files claim the same run, or the folder cannot be listed.
        """
        with in_words("list the folder", self.path):
            names = self._fs.listdir(self.path)
        ranges = [(parse_chunk_name(name), name) for name in names]
        chunks = sorted(Chunk(*found, self.path / name) for found, name in ranges if found is not None)
        for left, right in pairwise(chunks):
            if right.start < left.stop:
                raise StoreError(
                    f"{self.path}: {left.path.name} and {right.path.name} both hold run {right.start}. "
                    "Move one of the two out of the folder and run the same command again."
                )
        return chunks

    def missing(self, n_runs: int, chunk_size: int) -> list[tuple[int, int]]:
        """Ranges `[start, stop)` still to compute so that runs 0 to `n_runs - 1` are covered.

        Each is at most `chunk_size` runs long and ends at a multiple of it where finished chunks allow.
        """
        return missing_ranges([(chunk.start, chunk.stop) for chunk in self.chunks()], n_runs, chunk_size)

    def read_chunk(self, chunk: Chunk, names: Iterable[str] | None = None) -> dict[str, np.ndarray]:
        """Arrays of a chunk, checked against their checksums.

        Args:
            chunk: One of `chunks()`.
            names: Arrays wanted; all if None.

        Raises:
            DamagedChunk: The file does not hold what was written.
            StoreError: The file cannot be read, or is intact but has no such array.
        """
        try:
            with in_words("read the chunk", chunk.path), self._fs.open_read(chunk.path) as stream:
                return decode_chunk(stream, chunk.start, chunk.stop, self.fingerprint, names)
        except DamageError as damage:
            raise DamagedChunk(chunk.path, chunk.start, chunk.stop, str(damage)) from damage
        except KeyError as error:
            raise StoreError(f"{chunk.path}: {error.args[0]}. Choose one of these.") from error

    def read_json(self, name: str) -> Any:
        """Content of a JSON file of this folder, at most 16 MiB of it.

        Raises:
            StoreError: There is no such file, it is too large, or it is not JSON.
        """
        path = self.path / check_name(name)
        with in_words("read the file", path), self._fs.open_read(path) as stream:
            data = _read_limited(stream, path)
        try:
            return decode_json(data)
        except ValueError as error:
            raise StoreError(f"{path}: is not JSON ({error}). Remove it and write it anew.") from error

    @property
    def fingerprint(self) -> str:
        """SHA-256 of the identity; every chunk carries it."""
        return self.manifest["identity_sha256"]


def read_folder(path: str | Path, fs: FileSystem | None = None) -> RunReader:
    """Open a run folder for reading only; raises like `RunReader`."""
    return RunReader(path, fs)


@contextmanager
def in_words(doing: str, path: Path) -> Iterator[None]:
    """Turn an `OSError` into a `StoreError` that says what was being done, and to which path."""
    try:
        yield
    except OSError as error:
        raise disk_trouble(doing, path, error) from error


def check_name(name: str) -> str:
    """Give back a name that may become a file of the folder; any other is a `ValueError`."""
    if not is_plain_name(name):
        raise ValueError(f"file name {name!r}: only 1 to 100 letters, digits, '_', '.', '-', no leading dot")
    return name


def _read_limited(stream: BinaryIO, path: Path) -> bytes:
    data = stream.read(MAX_JSON_BYTES + 1)
    if len(data) > MAX_JSON_BYTES:
        raise StoreError(
            f"{path}: is larger than {MAX_JSON_BYTES // 2**20} MiB, the most emt reads. "
            "Move it out of the folder if it is not from emt."
        )
    return data


def read_manifest(fs: FileSystem, folder: Path) -> dict[str, Any]:
    """The manifest of a folder; raises like `RunReader`."""
    path = folder / MANIFEST
    try:
        with in_words("read the manifest", path), fs.open_read(path) as stream:
            return parse_manifest(_read_limited(stream, path), path)
    except StoreError as error:
        if isinstance(error.__cause__, FileNotFoundError | NotADirectoryError):
            raise NotARunFolder(
                f"{folder}: is not a run folder, there is no {MANIFEST}. Name a folder that `emt run` wrote."
            ) from error
        raise

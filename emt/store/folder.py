"""The write side of a run folder.

What a folder promises: a file with a final name is whole; a chunk that `write_chunk` has returned from is
still there after any kill, full disk or power cut; results of two configurations never meet; one process
writes.
"""

from bisect import bisect_left, insort
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from emt.store.chunks import Chunk, chunk_name, encode_chunk
from emt.store.errors import ConfigMismatch, NotARunFolder, StoreError
from emt.store.files import PARTIAL, FileSystem, is_plain_name, make_folder, write_atomically
from emt.store.lock import FolderLock
from emt.store.manifest import MANIFEST, encode_json, list_differences, make_manifest
from emt.store.reader import RunReader, check_name, in_words, read_manifest

LOCK = ".lock"
UNFINISHED = {LOCK, MANIFEST + PARTIAL}  # all that a folder may hold when its creation was interrupted


class RunFolder(RunReader):
    """A run folder open for writing by this process alone; made by `RunFolder.open`, used with `with`."""

    def __init__(self, path: str | Path, fs: FileSystem, lock: FolderLock):
        self._lock = lock
        self._ranges: list[tuple[int, int]] | None = None
        super().__init__(path, fs)

    @classmethod
    def open(cls, path: str | Path, manifest: Mapping[str, Any], fs: FileSystem | None = None) -> "RunFolder":
        """Create a folder, or continue one that belongs to the same configuration.

        Args:
            path: The folder; created with its parents if missing. It must be empty or a run folder.
            manifest: `identity`, nested plain data that the results depend on and that must equal the stored
                one; `environment`, versions and devices, recorded but free to change; further keys are kept
                as last given.
            fs: The disk.

        Raises:
            NotARunFolder: The path is a file, or a folder of something else.
            FolderBusy: Another process has the folder open.
            ConfigMismatch: The identity differs from the stored one.
            StoreError: The manifest is damaged, or the disk refuses.
            ValueError: `manifest` has no identity, or holds a number that is not finite.
        """
        path, fs = Path(path), FileSystem() if fs is None else fs
        make_manifest(manifest, None)  # raises before anything is created
        with in_words("open the folder", path):
            _refuse_foreign(fs, path)
            make_folder(fs, path)
            lock = fs.lock(path / LOCK)
        try:
            with in_words("prepare the folder", path):
                if MANIFEST in _refuse_foreign(fs, path):
                    _update_manifest(fs, path, manifest)
                else:
                    _write_manifest(fs, path, make_manifest(manifest, None))
                _remove_leftovers(fs, path)
            return cls(path, fs, lock)
        except BaseException:
            lock.release()
            raise

    def write_chunk(self, start: int, stop: int, arrays: Mapping[str, np.ndarray]) -> Chunk:
        """Store the arrays of runs `start` to `stop - 1`; on return they are safe.

        Writing a chunk again is allowed if it is the same to the byte, which makes a failed call repeatable.

        Raises:
            StoreError: The disk failed, or other results of some of these runs are there already.
            ValueError: An empty range, a name outside the whitelist, or a dtype that is not plain.
        """
        self._require_lock()
        if not 0 <= start < stop:
            raise ValueError(f"a chunk needs 0 <= start < stop, not {start} and {stop}")
        path = self.path / chunk_name(start, stop)
        data = encode_chunk(arrays, int(start), int(stop), self.fingerprint)
        clash = self._clashes(start, stop)
        with in_words("write the chunk", path):
            if [chunk.path for chunk in clash] == [path] and self._holds(path, data):
                self._fs.fsync_dir(self.path)  # the failed call may have missed just this
            elif clash:
                raise StoreError(
                    f"{path}: {clash[0].path.name} already holds run {max(start, clash[0].start)}, "
                    "and nothing is overwritten. Remove that file to have its runs computed anew."
                )
            else:
                ranges, self._ranges = self._ranges, None  # a call that fails may leave the file or not
                write_atomically(self._fs, path, data)
                if ranges is not None:
                    insort(ranges, (start, stop))
                self._ranges = ranges
        return Chunk(int(start), int(stop), path)

    def write_json(self, name: str, value: Any) -> Path:
        """Write or replace a JSON file: sorted keys, indented by 2; a NaN is a `ValueError`.

        Raises:
            StoreError: The disk failed; the former file is untouched.
            ValueError: A name outside the whitelist, or a number that is not finite.
        """
        return self._write(name, encode_json(value))

    def write_text(self, name: str, text: str) -> Path:
        """Write or replace a text file in UTF-8, line ends as given; raises like `write_json`."""
        return self._write(name, text.encode())

    def write_bytes(self, name: str, data: bytes) -> Path:
        """Write or replace a file of bytes, such as a picture; raises like `write_json`."""
        return self._write(name, data)

    def close(self) -> None:
        """Let other processes write into the folder; reading stays possible."""
        self._lock.release()

    def __enter__(self) -> "RunFolder":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _clashes(self, start: int, stop: int) -> list[Chunk]:
        """Stored chunks that hold some of the runs `start` to `stop - 1`.

        The folder is listed at the first call only, because nobody else writes, and again before a refusal, because
        files may be removed by hand. Listing it for every chunk would take time with the square of their number.
        """
        if self._ranges is not None:
            place = bisect_left(self._ranges, (start, start))
            if all(last <= start or stop <= first for first, last in self._ranges[max(place - 1, 0) : place + 1]):
                return []
        chunks = self.chunks()
        self._ranges = [(chunk.start, chunk.stop) for chunk in chunks]
        return [chunk for chunk in chunks if chunk.start < stop and start < chunk.stop]

    def _write(self, name: str, data: bytes) -> Path:
        self._require_lock()
        path = self.path / check_name(name)
        lowered = name.lower()
        if lowered == MANIFEST or lowered.startswith("chunk-") or lowered.endswith(PARTIAL):
            raise ValueError(f"file name {name!r} is reserved for the store itself")
        with in_words("write the file", path):
            write_atomically(self._fs, path, data)
        return path

    def _holds(self, path: Path, data: bytes) -> bool:
        with self._fs.open_read(path) as stream:
            return stream.read(len(data) + 1) == data

    def _require_lock(self) -> None:
        if not self._lock.held:
            raise StoreError(f"{self.path}: is closed, or a parent process opened it. Open it again to write.")


def _refuse_foreign(fs: FileSystem, folder: Path) -> list[str]:
    """Names in the folder, none if it is missing, once it is certain that emt may write there."""
    try:
        names = fs.listdir(folder)
    except FileNotFoundError:
        return []
    except NotADirectoryError as error:
        raise NotARunFolder(
            f"{folder}: this, or a parent of it, is a file and not a folder. Choose another output folder."
        ) from error
    if MANIFEST in names:
        read_manifest(fs, folder)
    elif not set(names) <= UNFINISHED:
        foreign = min(set(names) - UNFINISHED)
        raise NotARunFolder(
            f"{folder}: holds other files ({foreign!r}) and no {MANIFEST}, so emt does not write into it. "
            "Choose an empty or a new output folder."
        )
    return names


def _update_manifest(fs: FileSystem, folder: Path, given: Mapping[str, Any]) -> None:
    stored = read_manifest(fs, folder)
    differences = list_differences(stored["identity"], given["identity"])
    if differences:
        raise ConfigMismatch(folder, differences)
    updated = make_manifest(given, stored)
    if updated != stored:
        _write_manifest(fs, folder, updated)


def _write_manifest(fs: FileSystem, folder: Path, manifest: dict[str, Any]) -> None:
    write_atomically(fs, folder / MANIFEST, encode_json(manifest))


def _remove_leftovers(fs: FileSystem, folder: Path) -> None:
    for name in fs.listdir(folder):
        if name.endswith(PARTIAL) and is_plain_name(name.removesuffix(PARTIAL)):
            fs.remove(folder / name)
    fs.fsync_dir(folder)  # also makes safe a chunk whose writer was killed right after its rename

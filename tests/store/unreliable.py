"""Disks for tests: one in memory that forgets what was not fsynced, one that fails at a chosen operation."""

import errno
import io
import random
from functools import cache
from pathlib import Path
from typing import BinaryIO, Literal

import numpy as np

from emt.store.errors import FolderBusy
from emt.store.files import FileSystem

ROOT = Path("/disk")
IDENTITY = {"seed": 7, "filters": [{"kind": "random-matrix", "forgetting": 0.99}]}

Failure = Literal["once", "always", "power cut"]
Loss = Literal["names", "contents", "some"]


class PowerCut(BaseException):
    """The machine stops; not an `Exception`, as nothing may handle it."""


class MemoryFile:
    def __init__(self):
        self.data = bytearray()
        self.safe: bytes | None = None


class MemoryLock:
    def __init__(self, disk: "MemoryDisk", path: Path):
        self.disk, self.path, self.held = disk, path, True

    def release(self):
        if self.held:
            self.disk.locked.discard(self.path)
        self.held = False


class MemoryDisk(FileSystem):
    """A disk in memory. Contents are safe after `fsync`, names after `fsync_dir`, as POSIX has it."""

    def __init__(self):
        self.now: dict[Path, MemoryFile | None] = {ROOT: None}  # None is a folder
        self.safe = dict(self.now)
        self.handles: dict[int, MemoryFile] = {}
        self.locked: set[Path] = set()

    def listdir(self, path: Path) -> list[str]:
        if self._find(path) is not None:
            raise NotADirectoryError(errno.ENOTDIR, "Not a directory")
        return sorted(child.name for child in self.now if child.parent == path)

    def is_folder(self, path: Path) -> bool:
        return path == ROOT.parent or (path in self.now and self.now[path] is None)

    def mkdir(self, path: Path) -> None:
        self._find(path.parent)
        if path in self.now:
            raise FileExistsError(errno.EEXIST, "File exists")
        self.now[path] = None

    def open_read(self, path: Path) -> BinaryIO:
        file = self._find(path)
        assert file is not None
        return io.BytesIO(bytes(file.data))

    def open_new(self, path: Path) -> int:
        self._find(path.parent)
        if path in self.now:
            raise FileExistsError(errno.EEXIST, "File exists")
        handle = max(self.handles, default=0) + 1
        self.now[path] = self.handles[handle] = MemoryFile()
        return handle

    def write(self, handle: int, data: bytes) -> None:
        self.handles[handle].data += data

    def fsync(self, handle: int) -> None:
        self.handles[handle].safe = bytes(self.handles[handle].data)

    def close(self, handle: int) -> None:
        del self.handles[handle]

    def rename(self, source: Path, target: Path) -> None:
        self._find(source)
        self.now[target] = self.now.pop(source)

    def fsync_dir(self, path: Path) -> None:
        elsewhere = {name: file for name, file in self.safe.items() if name.parent != path}
        self.safe = elsewhere | {name: file for name, file in self.now.items() if name.parent == path}

    def remove(self, path: Path) -> None:
        self._find(path)
        del self.now[path]

    def lock(self, path: Path):
        self._find(path.parent)
        if path in self.locked:
            raise FolderBusy(path.parent)
        self.locked.add(path)
        self.now.setdefault(path, MemoryFile())
        return MemoryLock(self, path)

    def power_cut(self, loss: Loss, rng: random.Random) -> None:
        """Keep what is safe; of the rest lose the names, or the contents under new names, or some of both."""
        survivors: dict[Path, MemoryFile | None] = {}
        for path in sorted(self.now.keys() | self.safe.keys()):
            keep_name = loss == "contents" or (loss == "some" and rng.random() < 0.5)
            entries = self.now if keep_name else self.safe
            if path not in entries or (path != ROOT and path.parent not in survivors):
                continue
            file = entries[path]
            if file is not None:
                torn = bytes(file.data[: len(file.data) // 2])
                file.data = bytearray(torn if file.safe is None else file.safe)
                file.safe = bytes(file.data)
            survivors[path] = file
        self.now, self.safe = survivors, dict(survivors)
        self.handles.clear()
        self.locked.clear()

    def _find(self, path: Path) -> MemoryFile | None:
        if path not in self.now:
            raise FileNotFoundError(errno.ENOENT, "No such file or directory")
        return self.now[path]


class Unreliable(FileSystem):
    """Passes on to another disk and fails at the n-th operation: once, from then on, or by a power cut."""

    def __init__(self, inner: FileSystem, fail_at: int = 0, failure: Failure = "once"):
        self.inner, self.fail_at, self.failure = inner, fail_at, failure
        self.count = 0

    @property
    def met(self) -> bool:
        return 0 < self.fail_at <= self.count

    def _step(self, code: int = errno.EIO) -> None:
        self.count += 1
        if self.count == self.fail_at or (self.met and self.failure != "once"):
            if self.failure == "power cut":
                raise PowerCut
            raise OSError(code, "No space left on device" if code == errno.ENOSPC else "Input/output error")

    def listdir(self, path: Path) -> list[str]:
        self._step()
        return self.inner.listdir(path)

    def is_folder(self, path: Path) -> bool:
        return self.inner.is_folder(path)

    def mkdir(self, path: Path) -> None:
        self._step(errno.ENOSPC)
        self.inner.mkdir(path)

    def open_read(self, path: Path) -> BinaryIO:
        self._step()
        return self.inner.open_read(path)

    def open_new(self, path: Path) -> int:
        self._step(errno.ENOSPC)
        return self.inner.open_new(path)

    def write(self, handle: int, data: bytes) -> None:
        try:
            self._step(errno.ENOSPC)
        except BaseException:
            self.inner.write(handle, data[: len(data) // 2])
            raise
        self.inner.write(handle, data)

    def fsync(self, handle: int) -> None:
        self._step(errno.ENOSPC)
        self.inner.fsync(handle)

    def close(self, handle: int) -> None:
        self.inner.close(handle)  # a failing close closes all the same
        self._step()

    def rename(self, source: Path, target: Path) -> None:
        self._step(errno.ENOSPC)
        self.inner.rename(source, target)

    def fsync_dir(self, path: Path) -> None:
        self._step()
        self.inner.fsync_dir(path)

    def remove(self, path: Path) -> None:
        self._step()
        self.inner.remove(path)

    def lock(self, path: Path):
        self._step(errno.ENOSPC)
        return self.inner.lock(path)


def make_manifest(device: str = "cpu", **identity) -> dict:
    return {"identity": IDENTITY | identity, "environment": {"device": device}}


@cache
def score_runs(start: int, stop: int) -> dict[str, np.ndarray]:
    """Stands for a simulation: depends on nothing but the run numbers."""
    runs = np.arange(start, stop)
    return {
        "vb/rmse": np.sqrt(runs[:, None] + np.linspace(0.0, 1.0, 3)),
        "vb/status": (runs % 5 == 0).astype(np.int32),
        "label": np.array([f"run {run}" for run in runs]),
    }


def assert_same_arrays(left: dict[str, np.ndarray], right: dict[str, np.ndarray]) -> None:
    assert left.keys() == right.keys()
    for name in left:
        assert left[name].dtype == right[name].dtype
        np.testing.assert_array_equal(left[name], right[name])


def read_bytes(fs: FileSystem, path: Path) -> bytes:
    with fs.open_read(path) as stream:
        return stream.read()


def read_all(fs: FileSystem, folder: Path) -> dict[str, bytes]:
    """Content of every file of a folder but the lock; nothing if the folder is missing."""
    try:
        names = fs.listdir(folder)
    except FileNotFoundError:
        return {}
    return {name: read_bytes(fs, folder / name) for name in names if name != ".lock"}

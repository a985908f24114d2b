"""The few operations on files that results depend on, and the one way a file is written.

All reading and writing of `emt.store` passes through `FileSystem`, so that tests can put a disk in its place
that fails at any chosen operation and forgets whatever was not yet safe.
"""

import errno
import os
import re
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO

from emt.store.lock import FolderLock

PARTIAL = ".partial"
# what file systems answer that have no syncing of folders, or nothing to sync
CANNOT_SYNC = (errno.EINVAL, errno.EOPNOTSUPP, errno.ENOSYS, errno.EROFS)
MAX_NAME = 100
PLAIN_NAME = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9_.-]*", re.ASCII)
DEVICES = re.compile(r"(con|prn|aux|nul|com[0-9]|lpt[0-9])(\..*)?", re.IGNORECASE)


class FileSystem:
    """The disk of this machine; errors are `OSError` as the operating system reports them."""

    def listdir(self, path: Path) -> list[str]:
        """Names in a folder, sorted."""
        return sorted(os.listdir(path))

    def is_folder(self, path: Path) -> bool:
        """Whether the path is an existing folder."""
        return os.path.isdir(path)

    def mkdir(self, path: Path) -> None:
        """Create one folder whose parent exists."""
        os.mkdir(path)

    def open_read(self, path: Path) -> BinaryIO:
        """Open a file for reading."""
        return open(path, "rb")

    def open_new(self, path: Path) -> int:
        """Create a file for writing; it must not exist, not even as a link to elsewhere."""
        return os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0), 0o666)

    def write(self, handle: int, data: bytes) -> None:
        """Write all of `data`."""
        rest = memoryview(data)
        while rest:
            rest = rest[os.write(handle, rest) :]

    def fsync(self, handle: int) -> None:
        """Return once the content would survive a power cut; nothing is buffered on our side."""
        os.fsync(handle)

    def close(self, handle: int) -> None:
        """Close a file opened by `open_new`."""
        os.close(handle)

    def rename(self, source: Path, target: Path) -> None:
        """Give a file its final name, replacing what had it, in one step."""
        os.replace(source, target)

    def fsync_dir(self, path: Path) -> None:
        """Return once the names in a folder would survive a power cut."""
        if os.name == "nt":  # folders cannot be opened there; NTFS journals names by itself
            return
        handle = os.open(path, os.O_RDONLY)
        try:
            os.fsync(handle)
        except OSError as error:
            if error.errno not in CANNOT_SYNC:
                raise
        finally:
            os.close(handle)

    def remove(self, path: Path) -> None:
        """Remove a file."""
        os.remove(path)

    def lock(self, path: Path) -> FolderLock:
        """Take the exclusive lock; raises `FolderBusy` if it is taken."""
        return FolderLock(path)


def write_atomically(fs: FileSystem, path: Path, data: bytes) -> None:
    """Replace a file so that at every moment, power cuts included, the old or the new one is there, whole.

    The only possible leftover is `<name>.partial` in the same folder. When this function returns the new
    content is safe. When it raises, the old file is untouched, except if the very last step fails: then the
    new one is in place and whole, but a power cut may still bring back the old one.

    Args:
        fs: The disk.
        path: Final name; its folder must exist.
        data: The whole content.

    Raises:
        OSError: The disk is full or failed; the leftover is removed where possible.
    """
    partial = path.with_name(path.name + PARTIAL)
    try:
        handle = fs.open_new(partial)
    except FileExistsError:
        fs.remove(partial)
        handle = fs.open_new(partial)
    try:
        try:
            fs.write(handle, data)
            fs.fsync(handle)
        finally:
            fs.close(handle)
        fs.rename(partial, path)
    except BaseException:
        with suppress(OSError):
            fs.remove(partial)
        raise
    fs.fsync_dir(path.parent)


def make_folder(fs: FileSystem, path: Path) -> None:
    """Create a folder and its missing parents and make their names safe; an existing folder is fine.

    Raises:
        OSError: A parent is not a folder, or the disk refuses.
    """
    for folder in [*reversed(path.parents), path]:
        if not fs.is_folder(folder):
            with suppress(FileExistsError):  # another process was quicker
                fs.mkdir(folder)
        # also for folders found: whoever made them may have been killed, or have failed, before this step
        with suppress(PermissionError):
            fs.fsync_dir(folder.parent)


def is_plain_name(name: str) -> bool:
    """Whether a name is safe as a file name on every system: letters, digits, `_.-`, no leading dot."""
    return (
        len(name) <= MAX_NAME
        and PLAIN_NAME.fullmatch(name) is not None
        and not name.endswith(".")
        and DEVICES.fullmatch(name) is None
    )

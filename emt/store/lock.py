"""One writer per folder: a lock the operating system takes back when its owner dies."""

import errno
import os
import platform
import sys
import weakref
from contextlib import suppress
from pathlib import Path

from emt.store.errors import FolderBusy

if sys.platform == "win32":
    import msvcrt

    def _lock(fd: int) -> None:
        os.lseek(fd, 1 << 30, os.SEEK_SET)  # beyond the text: locked bytes could not be read by others
        msvcrt.locking(fd, msvcrt.LK_NBLCK, 1)

    def _unlock(fd: int) -> None:
        os.lseek(fd, 1 << 30, os.SEEK_SET)
        msvcrt.locking(fd, msvcrt.LK_UNLCK, 1)
else:
    import fcntl

    def _lock(fd: int) -> None:
        # flock, not lockf: a lockf lock is lost when any other handle of this process is closed
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)

    def _unlock(fd: int) -> None:
        fcntl.flock(fd, fcntl.LOCK_UN)


HELD_ELSEWHERE = (errno.EWOULDBLOCK, errno.EACCES, errno.EDEADLK)


class FolderLock:
    """An exclusive lock on a file, held from construction to `release` or the end of the process.

    The file names the owner (process id and machine) while the lock is held and is empty afterwards.
    It is never removed: two processes could otherwise lock two files of the same name.

    Args:
        path: The lock file, created if missing; its folder must exist.

    Raises:
        FolderBusy: Somebody else, or this process under another handle, holds the lock.
        OSError: The file cannot be opened, or the file system knows no locks.
    """

    def __init__(self, path: Path):
        flags = os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_BINARY", 0)
        fd = os.open(path, flags, 0o666)
        try:
            _lock(fd)
        except OSError as error:
            owner = _read_owner(fd)
            os.close(fd)
            if error.errno in HELD_ELSEWHERE:
                raise FolderBusy(path.parent, *owner) from None
            raise
        self._fd: int | None = fd
        _held.add(self)
        with suppress(OSError):  # a full disk must not stop a run that needs no space
            _write_owner(fd, f"{os.getpid()} {platform.node()}\n")

    @property
    def held(self) -> bool:
        """Whether this process still owns the lock; False in a forked child."""
        return self._fd is not None

    def release(self) -> None:
        """Give the lock back; a second call does nothing."""
        if self._fd is None:
            return
        fd, self._fd = self._fd, None
        _held.discard(self)
        with suppress(OSError):
            _write_owner(fd, "")
        with suppress(OSError):
            _unlock(fd)
        os.close(fd)

    def forget(self) -> None:
        """Drop the copy a fork made, without unlocking the parent."""
        fd, self._fd = self._fd, None
        if fd is not None:
            os.close(fd)


_held: "weakref.WeakSet[FolderLock]" = weakref.WeakSet()


def _forget_all() -> None:
    for lock in list(_held):
        lock.forget()


if hasattr(os, "register_at_fork"):
    # a forked worker that outlives a killed owner would otherwise keep the folder locked
    os.register_at_fork(after_in_child=_forget_all)


def _write_owner(fd: int, text: str) -> None:
    os.lseek(fd, 0, os.SEEK_SET)
    os.ftruncate(fd, 0)
    os.write(fd, text.encode())


def _read_owner(fd: int) -> tuple[int | None, str]:
    try:
        os.lseek(fd, 0, os.SEEK_SET)
        pid, _, host = os.read(fd, 300).decode().strip().partition(" ")
        return int(pid), host
    except (OSError, ValueError):  # the owner may be between locking and writing its name
        return None, ""

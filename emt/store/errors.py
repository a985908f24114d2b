"""What can go wrong with a run folder, in sentences for the person at the keyboard.

Every message says what happened, why, and what to do next. The command line prints it and exits with 2.
"""

import errno
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

SHOWN_DIFFERENCES = 20
SHOWN_CHARACTERS = 60
ADVICE = (
    ((errno.ENOSPC, getattr(errno, "EDQUOT", errno.ENOSPC)), "Free some space on that disk"),
    ((errno.EACCES, errno.EPERM, errno.EROFS), "Get the permission, or choose another output folder"),
    ((errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS), "Choose an output folder on a disk with file locks"),
)


class StoreError(Exception):
    """The folder cannot be read or written until the user changes something."""


class NotARunFolder(StoreError):  # noqa: N818 - reads as what is wrong
    """The path is something other than a folder of results, so emt neither reads it nor writes into it."""


class Difference(NamedTuple):
    """One key in which two configurations differ; a value the side does not have reads `(absent)`."""

    key: str
    stored: str
    given: str


class ConfigMismatch(StoreError):  # noqa: N818
    """The folder holds results of another configuration.

    Args:
        folder: The run folder.
        differences: Every differing key, dotted, with both values as JSON text.
    """

    def __init__(self, folder: Path, differences: Sequence[Difference]):
        self.folder = folder
        self.differences = list(differences)
        lines = [
            f"  {key}: stored {_shorten(stored)}, now {_shorten(given)}"
            for key, stored, given in self.differences[:SHOWN_DIFFERENCES]
        ]
        if len(self.differences) > SHOWN_DIFFERENCES:
            lines.append(f"  and {len(self.differences) - SHOWN_DIFFERENCES} more")
        super().__init__(
            f"{folder}: holds results of another configuration; these keys differ:\n"
            + "\n".join(lines)
            + "\nGive this configuration another output folder, or restore the stored values to continue."
        )


class FolderBusy(StoreError):  # noqa: N818
    """Another process is writing into the folder.

    Args:
        folder: The run folder.
        pid: Process id of the writer, None if it could not be read.
        host: Machine of the writer, empty if it could not be read.
    """

    def __init__(self, folder: Path, pid: int | None = None, host: str = ""):
        self.folder, self.pid, self.host = folder, pid, host
        who = "another process" if pid is None else f"process {pid}" + (f" on {host}" if host else "")
        super().__init__(
            f"{folder}: {who} is writing into this folder. "
            "Wait until it ends, or stop it, or choose another output folder."
        )


class DamagedChunk(StoreError):  # noqa: N818
    """A chunk file does not hold what was written into it.

    Args:
        path: The damaged file.
        start: First run it held.
        stop: One past the last run it held.
        reason: What the check found.
    """

    def __init__(self, path: Path, start: int, stop: int, reason: str):
        self.path, self.start, self.stop, self.reason = path, start, stop, reason
        super().__init__(
            f"{path}: damaged ({reason}); it held runs {start} to {stop - 1}. "
            "Remove this file and run the same command again: only these runs are computed anew."
        )


def disk_trouble(doing: str, path: Path, error: OSError) -> StoreError:
    """Put an error of the operating system into words, with the step that helps.

    Args:
        doing: What was attempted, as in "cannot <doing>".
        path: The file or folder concerned.
        error: What the operating system said.
    """
    advice = next((advice for codes, advice in ADVICE if error.errno in codes), "Check the disk")
    reason = error.strerror or str(error)
    return StoreError(
        f"{path}: cannot {doing}: {reason}. {advice}, then run the same command again; finished chunks are kept."
    )


def _shorten(text: str) -> str:
    return text if len(text) <= SHOWN_CHARACTERS else text[: SHOWN_CHARACTERS - 3] + "..."

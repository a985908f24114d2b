"""Files of the user's that a scenario reads."""

import hashlib
from pathlib import Path

MAX_BYTES = 1 << 30
"""Largest file that is read."""


class DataError(ValueError):
    """A file that cannot be used; the message is for the user.

    Attributes:
        key: the setting of the scenario that is at fault.
    """

    def __init__(self, message: str, key: str = "path"):
        super().__init__(message)
        self.key = key


def read_data(given: str | None, sha256: str | None) -> tuple[Path, bytes]:
    """Path and content of a data file.

    Raises:
        DataError: no path was given, or the file is missing, too large or of another hash.
    """
    if given is None:
        raise DataError("is required: give the recording's file, e.g. scenario.path=FILE")
    path = Path(given)
    try:
        if path.stat().st_size > MAX_BYTES:
            raise DataError(f"'{path}' is larger than {MAX_BYTES >> 20} MiB")
        content = path.read_bytes()
    except OSError as error:
        raise DataError(f"cannot read '{path}': {error.strerror or error}") from error
    found = hashlib.sha256(content).hexdigest()
    if sha256 is not None and found != sha256:
        raise DataError(f"'{path}' is not the expected recording: sha256 is {found}, expected {sha256}")
    return path, content

"""Results on disk: chunks of runs that survive kills, full disks and power cuts. No JAX, no pickle."""

from emt.store.chunks import Chunk
from emt.store.errors import (
    ConfigMismatch,
    DamagedChunk,
    Difference,
    FolderBusy,
    NotARunFolder,
    StoreError,
)
from emt.store.files import FileSystem, write_atomically
from emt.store.folder import RunFolder
from emt.store.reader import RunReader, read_folder

__all__ = [
    "Chunk",
    "ConfigMismatch",
    "DamagedChunk",
    "Difference",
    "FileSystem",
    "FolderBusy",
    "NotARunFolder",
    "RunFolder",
    "RunReader",
    "StoreError",
    "read_folder",
    "write_atomically",
]

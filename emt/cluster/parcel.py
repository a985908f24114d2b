"""What travels to a worker: a checked configuration as plain data, and what must be the same over there."""

import hashlib
import importlib
import json
import sys
import warnings
from pathlib import Path
from typing import Any, NamedTuple

from emt.config.load import Loaded, check
from emt.config.source import Place, Source
from emt.config.warning import ConfigWarning
from emt.device import environment
from emt.montecarlo.chunks import Engine
from emt.montecarlo.identity import identity_of
from emt.montecarlo.program import Program
from emt.registry import FILTERS, SCENARIOS
from emt.store.manifest import fingerprint

PACKAGES = ("emt", "jax", "jaxlib", "numpy")
"""Packages of the same version everywhere: other ones may compute other numbers."""


class ParcelError(Exception):
    """This process cannot compute what the parcel holds; the text says why, as in "the worker ..."."""


class Parcel(NamedTuple):
    """An experiment, so that another process can build the same one."""

    name: str
    path: str
    """The configuration file; plug-ins may stand beside it. Workers do not read it."""
    data: dict[str, Any]
    """Its settings as given, overrides included; the path of a recording is absolute."""
    plugins: dict[str, tuple[str, str]]
    """Modules from beside the configuration: file relative to its folder, and SHA-256."""
    identity: str
    """Fingerprint of what the results depend on."""
    quick: bool
    versions: dict[str, str]

    def key(self) -> str:
        """Equal for parcels of which the same engine is built."""
        return hashlib.sha256(json.dumps(self, sort_keys=True).encode()).hexdigest()


def pack(loaded: Loaded, program: Program, *, quick: bool = False) -> Parcel:
    """The parcel of an experiment.

    Args:
        program: that of the experiment.
        quick: whether workers compile in a hurry.
    """
    path, data = Path(loaded.source.path).resolve(), dict(loaded.source.data)
    recording = getattr(loaded.experiment.scenario, "path", None)
    if recording is not None:
        data["scenario"] = data["scenario"] | {"path": str(Path(recording).resolve())}
    identity = fingerprint(identity_of(loaded, program))
    return Parcel(loaded.name, str(path), data, plugins_beside(path.parent), identity, quick, versions())


def versions() -> dict[str, str]:
    """Versions of the packages that results depend on."""
    facts = environment()
    return {name: facts[name] for name in PACKAGES}


def plugins_beside(folder: Path) -> dict[str, tuple[str, str]]:
    """Imported modules whose file stands in a folder, or in a package that stands there."""
    found = {}
    for name, module in sorted(sys.modules.items()):
        given = getattr(module, "__file__", None) or ""
        if not given.endswith(".py") or name.split(".")[0] in ("emt", "__main__"):
            continue
        file = Path(given).resolve()
        depth = name.count(".") + (file.name == "__init__.py")
        if depth < len(file.parents) and file.parents[depth] == folder and file.is_file():
            found[name] = (file.relative_to(folder).as_posix(), hashlib.sha256(file.read_bytes()).hexdigest())
    return found


def unpack(parcel: Parcel) -> Engine:
    """The engine of a parcel, not compiled yet.

    Raises:
        ParcelError: versions, plug-ins or recordings are not those of the process that packed it.
        ConfigError, DataError: a plug-in cannot be imported, or a recording cannot be read.
    """
    ours = versions()
    other = [f"{k} {mine} instead of {parcel.versions[k]}" for k, mine in ours.items() if mine != parcel.versions[k]]
    if other:
        raise ParcelError(f"has {', '.join(other)}: install the same versions everywhere")
    path = Path(parcel.path)
    renew_plugins(parcel, path.parent)
    source = Source(path, parcel.data, {(): Place(parcel.path, None)})
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConfigWarning)  # the client has shown them
        loaded = Loaded(parcel.name, check(source, path), source)
    for name, (file, _) in parcel.plugins.items():
        module = sys.modules.get(name)
        if module is not None and Path(module.__file__ or "").resolve() != (path.parent / file).resolve():
            raise ParcelError(f"imports '{name}' from {module.__file__}, not from {path.parent / file}: rename one")
    program = Program.of(loaded.experiment)
    if fingerprint(identity_of(loaded, program)) != parcel.identity:
        raise ParcelError("reads another experiment from the same settings: its recording or its plug-ins differ")
    return Engine(program, loaded.experiment.monte_carlo.seed, loaded.experiment.chunk_size, quick=parcel.quick)


def renew_plugins(parcel: Parcel, folder: Path) -> None:
    """Makes sure that plug-ins are imported as they were when the run began: a worker may be older than an edit.

    Raises:
        ParcelError: a file is missing, or is another one by now.
    """
    for file, expected in parcel.plugins.values():
        try:
            content = (folder / file).read_bytes()
        except OSError as error:
            message = "plug-ins beside the configuration must be readable by workers, at the same path"
            raise ParcelError(f"cannot read {folder / file} ({error.strerror}): {message}") from error
        if hashlib.sha256(content).hexdigest() != expected:
            raise ParcelError(f"finds {folder / file} changed since the run began; run the command again")
    for name in parcel.plugins:
        sys.modules.pop(name, None)
    if parcel.plugins:
        importlib.invalidate_caches()
        FILTERS.forget()
        SCENARIOS.forget()

"""What runs on a worker: one chunk is one task; engines are built and compiled once and kept for the next chunks.

XLA spreads a chunk over the cores it finds. Chunks of one process are computed one after the other, even in a worker of
several threads: programs that run side by side can block each other, each waiting for threads that the other holds.
"""

import platform
import threading
import time
from collections import OrderedDict
from functools import cache
from typing import Any, NamedTuple

import jax
import numpy as np

from emt.cluster.parcel import Parcel, ParcelError, unpack
from emt.config.errors import ConfigError
from emt.device import configure, environment
from emt.montecarlo.chunks import Engine
from emt.scenarios.data import DataError

MAX_ENGINES = 2
"""Experiments whose programs a worker keeps."""

_engines: "OrderedDict[str, Engine]" = OrderedDict()
_building, _running = threading.Lock(), threading.Lock()


class Result(NamedTuple):
    """A finished chunk, as it travels back."""

    arrays: dict[str, np.ndarray]
    seconds: dict[str, float]
    """Wall-clock time of each filter with its metrics."""
    compile_seconds: float
    """Time to build and compile, 0 if the engine was there already."""
    environment: dict[str, Any]
    """Versions and device of the worker."""


def compute(parcel: Parcel, start: int, stop: int, tracked: int) -> Result:
    """Computes the runs `start` to `stop - 1`; with every report and scan of the first `tracked` runs.

    Raises:
        ParcelError: this worker cannot; the text says why.
    """
    began = time.perf_counter()
    try:
        engine, is_new = engine_of(parcel)
    except ParcelError as error:
        raise ParcelError(f"the worker on {platform.node()} {error}") from error
    compile_seconds = time.perf_counter() - began if is_new else 0.0
    with _running:
        arrays = engine.run_chunk(start, stop, tracked=tracked)
        # taken out again, so that a worker that lives long does not collect them
        seconds = {label: found.pop() for label, found in engine.seconds.items() if found}
    return Result(arrays, seconds, compile_seconds, own_environment())


@cache
def own_environment() -> dict[str, Any]:
    """Versions and device of this process."""
    return environment()


def engine_of(parcel: Parcel) -> tuple[Engine, bool]:
    """The compiled engine of a parcel, and whether it was built just now.

    Raises:
        ParcelError: as `unpack`.
    """
    key = parcel.key()
    with _building:
        if key in _engines:
            _engines.move_to_end(key)
            return _engines[key], False
        if len(_engines) >= MAX_ENGINES:
            _engines.popitem(last=False)
            jax.clear_caches()
        configure()
        try:
            engine = unpack(parcel)
        except DataError as error:
            message = "recordings must be readable by workers, at the same path"
            raise ParcelError(f"cannot use the recording: {error}; {message}") from error
        except ConfigError as error:
            raise ParcelError(f"cannot use the configuration: {error}") from error
        engine.compile()
        _engines[key] = engine
        return engine, True

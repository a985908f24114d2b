"""Interleaved timing in one process, on one core."""

import gc
import os
import statistics
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from typing import Any, NamedTuple

BLAS_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
LONG_SECONDS, FEWEST = 4.0, 3
"""A call that takes longer is repeated `FEWEST` times only."""
SHORT_SECONDS = 0.02
"""A call that takes less is repeated within a repetition until it takes as long: clocks of CPU time are coarse."""


class Cost(NamedTuple):
    """Medians over repetitions, in seconds per call."""

    cpu: float
    """Of all threads of the process."""
    wall: float
    repetitions: int


def blas_on_one_thread() -> None:
    """Has NumPy's BLAS compute with one thread; it must not be loaded yet, or `threadpoolctl` be installed."""
    for name in BLAS_THREADS:
        os.environ[name] = "1"
    with suppress(ImportError):
        from importlib import import_module

        import_module("threadpoolctl").threadpool_limits(1)


@contextmanager
def one_core() -> Iterator[int | None]:
    """Keeps every thread of this process on one core for a while; gives its number, None where that is impossible."""
    if not hasattr(os, "sched_setaffinity"):
        yield None
        return
    before = os.sched_getaffinity(0)
    core = max(before)
    _bind({core})
    try:
        yield core
    finally:
        _bind(before)


def _bind(cores: set[int]) -> None:
    """Binds the threads that run already; those they start later inherit it."""
    for thread in os.listdir("/proc/self/task") if os.path.isdir("/proc/self/task") else ["0"]:
        with suppress(OSError):  # it may have ended
            os.sched_setaffinity(int(thread), cores)


def timed(call: Callable[[], Any], times: int = 1) -> tuple[float, float]:
    """CPU and wall-clock seconds per call."""
    wall, cpu = time.perf_counter(), time.process_time()
    for _ in range(times):
        call()
    return (time.process_time() - cpu) / times, (time.perf_counter() - wall) / times


def interleaved(calls: Mapping[str, Callable[[], Any]], repetitions: int) -> dict[str, Cost]:
    """Costs of several calls, one after the other in every repetition, so that what disturbs one disturbs all.

    A first round, which is not counted, warms caches and shows which calls are long or short.
    """
    times, wanted = {}, {}
    for name, call in calls.items():
        _, wall = timed(call)
        times[name] = max(1, min(round(SHORT_SECONDS / max(wall, 1e-9)), 1000))
        wanted[name] = min(repetitions, FEWEST) if wall > LONG_SECONDS else repetitions
    found: dict[str, list[tuple[float, float]]] = {name: [] for name in calls}
    collects = gc.isenabled()
    gc.collect()
    gc.disable()
    try:
        for repetition in range(repetitions):
            for name, call in calls.items():
                if repetition < wanted[name]:
                    found[name].append(timed(call, times[name]))
    finally:
        if collects:
            gc.enable()
    return {
        name: Cost(statistics.median(cpu for cpu, _ in pairs), statistics.median(wall for _, wall in pairs), len(pairs))
        for name, pairs in found.items()
    }

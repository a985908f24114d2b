"""Where the chunks of an experiment come from: this process or workers, and what is recorded of costs."""

import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from emt.cluster.parcel import pack
from emt.cluster.pool import Pool
from emt.config.load import Loaded
from emt.montecarlo.chunks import Engine
from emt.montecarlo.program import Program

SHORT_SECONDS = 3.0
"""Experiments that take less are computed again for the record of costs, unless they are in a hurry."""


class ChunkSource:
    """Where chunks come from: the engine of this process, or a pool.

    Args:
        pool: None for this process.
        quick: whether programs are compiled in a hurry.
    """

    def __init__(self, loaded: Loaded, program: Program, pool: Pool | None, *, quick: bool):
        experiment = loaded.experiment
        self._engine = Engine(program, experiment.monte_carlo.seed, experiment.chunk_size, quick=quick)
        self._quick, self._pool = quick, pool
        self._parcel = None if pool is None else pack(loaded, program, quick=quick)
        self._compile_seconds = 0.0
        self._environments: list[dict[str, Any]] = []

    def prepare(self, on_start: Callable[[str], None] = lambda detail: None) -> None:
        """Compiles if the chunks are computed here, with a word on what is compiled; workers do so on their own."""
        if self._pool is not None:
            workers = self._pool.workers()
            counted = f"{workers} worker{'s' * (workers > 1)}"
            on_start(counted if workers else f"waiting for workers at {self._pool.address}")
            return
        names: list[str] = []

        def on_name(name: str) -> None:
            names.append(name)
            on_start(", ".join(names[-2:]))

        started = time.perf_counter()
        self._engine.compile(on_name)
        self._compile_seconds = time.perf_counter() - started

    def chunks(self, ranges: list[tuple[int, int]]) -> Iterator[tuple[int, int, dict[str, np.ndarray]]]:
        """(start, stop, arrays) of chunks, in any order; run 0 comes with tracks."""
        if self._pool is None or self._parcel is None:
            yield from self._engine.run_chunks(ranges)
            return
        for start, stop, result in self._pool.run_chunks(self._parcel, ranges):
            for label, seconds in result.seconds.items():
                self._engine.seconds[label].append(seconds)
            self._compile_seconds = max(self._compile_seconds, result.compile_seconds)
            if result.environment not in self._environments:
                self._environments.append(result.environment)
            yield start, stop, result.arrays

    def timing(self, done: list[tuple[int, int]], run_seconds: float) -> dict[str, Any]:
        """What `timing.json` says of compilation and costs, and of workers if there were any.

        `compile_seconds` is that of the slowest worker, and part of `run_seconds` then.

        Args:
            done: the chunks of this run.
            run_seconds: time they took.
        """
        if self._pool is not None:
            workers = {"workers": self._pool.most_workers, "environments": self._environments}
        else:
            workers = {}
            if done and run_seconds < SHORT_SECONDS and len(done) < 3 and not self._quick:
                self._engine.run_chunk(*done[0])
        costs = {"microseconds_per_run_and_step": self._engine.costs()}
        return {"compile_seconds": self._compile_seconds} | costs | workers

"""Many runs: chunks of fixed size, from run numbers to the arrays that are stored."""

import itertools
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from emt.montecarlo.fields import truth_fields
from emt.montecarlo.program import Program, Simulation
from emt.montecarlo.run import Scores, as_truth
from emt.status import FAILURE

WORKERS = 2
"""Chunks in work at a time."""
BLOCKS = 8
"""Groups of runs per chunk whose sums per step are kept apart, for standard errors of root-mean-square metrics."""


def chunk_runs(start: int, stop: int, chunk_size: int) -> np.ndarray:
    """Run numbers of a chunk, padded to the fixed size with repetitions of the last one."""
    return np.minimum(np.arange(start, start + chunk_size), stop - 1)


def score_arrays(label: str, scores: Scores, n: int) -> dict[str, np.ndarray]:
    """What is stored of one filter's scores of the first `n` runs of a chunk.

    `values` (run, metric), `status`, `failed_step` and `nis`, its mean over steps (run); over the runs without
    failure, per block of runs, `step_sum` (block, step, metric) and `step_count` (block); and `step_squares`
    (step, metric).
    """
    rows, status = np.asarray(scores.per_step)[:n].astype(np.float64), np.asarray(scores.status)[:n]
    sound = (status & int(FAILURE)) == 0
    kept = np.where(sound[:, None, None], rows, 0.0)
    edges = np.linspace(0, n, BLOCKS + 1).astype(int)
    blocks = [slice(a, b) for a, b in itertools.pairwise(edges)]
    return {
        f"{label}/values": np.asarray(scores.values)[:n].astype(np.float64),
        f"{label}/status": status.astype(np.int32),
        f"{label}/failed_step": np.asarray(scores.failed_step)[:n].astype(np.int32),
        f"{label}/nis": np.asarray(scores.track.nis)[:n].mean(axis=1, dtype=np.float64),
        f"{label}/step_sum": np.stack([kept[block].sum(axis=0) for block in blocks]),
        f"{label}/step_count": np.array([sound[block].sum() for block in blocks]),
        f"{label}/step_squares": (kept**2).sum(axis=0),
    }


def track_arrays(label: str, scores: Scores, n: int) -> dict[str, np.ndarray]:
    """Every report of a filter in the first `n` runs of a chunk."""
    fields = scores.track._asdict() | {"per_step": scores.per_step}
    fields |= fields.pop("shape")
    return {f"{label}/track/{name}": np.asarray(value)[:n] for name, value in fields.items() if value is not None}


def scan_arrays(simulation: Simulation, has_truth: bool, n: int) -> dict[str, np.ndarray]:
    """Scans, and the truth where there is one, of the first `n` runs of a chunk."""
    arrays = {"scans/points": simulation.scans.points, "scans/mask": simulation.scans.mask}
    if has_truth:
        drawn = jax.vmap(jax.vmap(truth_fields))(jax.tree.map(lambda leaf: leaf[:n], simulation.truth))
        arrays |= {f"truth/{name}": value for name, value in drawn.items()}
    return {name: np.asarray(value)[:n] for name, value in arrays.items()}


class Engine:
    """Runs chunks of one experiment; compiled once, for the chunk size."""

    def __init__(self, program: Program, seed: int, chunk_size: int):
        self.program, self.seed, self.chunk_size = program, jnp.asarray(seed), chunk_size
        self._compiled: dict[str, Any] = {}

    def labels(self) -> list[str]:
        """Filters in the order of computation: a reference filter first."""
        labels, reference = list(self.program.experiment.filters), self.program.experiment.reference
        return sorted(labels, key=lambda label: label != reference)

    def compile(self, on_start: Callable[[str], None] = lambda name: None) -> None:
        """Compiles simulator and filters, two at a time; again is free."""
        if self._compiled:
            return
        program, runs = self.program, jnp.zeros(self.chunk_size, int)
        simulator = program.simulator()
        shapes = jax.eval_shape(simulator, program.world, self.seed, runs)

        def build(name: str):
            on_start(name or "scenario")
            if not name:
                return simulator.lower(program.world, self.seed, runs).compile()
            arguments = (program.world, program.filter_params[name], self.seed, runs, shapes.scans, shapes.truth)
            return program.scorer(name).lower(*arguments).compile()

        names = ["", *self.labels()]
        with ThreadPoolExecutor(WORKERS) as pool:
            self._compiled = dict(zip(names, pool.map(build, names), strict=True))

    def run_chunk(self, start: int, stop: int, *, tracked: int = 0) -> dict[str, np.ndarray]:
        """Arrays of the runs `start` to `stop - 1`, by name; with every report and scan of the first `tracked` runs.

        An experiment that asks for traces gets those of all runs.
        """
        program, n = self.program, stop - start
        experiment, world = program.experiment, program.world
        runs = jnp.asarray(chunk_runs(start, stop, self.chunk_size))
        simulation = self._compiled[""](world, self.seed, runs)
        target, arrays = simulation.truth, {}
        tracked = n if experiment.traces else min(tracked, n)
        for label in self.labels():
            params = program.filter_params[label]
            scores = self._compiled[label](world, params, self.seed, runs, simulation.scans, target)
            if label == experiment.reference:
                target = jax.vmap(as_truth)(scores.track)
            arrays |= score_arrays(label, scores, n)
            if tracked:
                arrays |= track_arrays(label, scores, tracked)
        if tracked:
            arrays |= scan_arrays(simulation, experiment.scenario.has_truth, tracked)
        return arrays

    def run_chunks(self, ranges: Iterable[tuple[int, int]]) -> Iterator[tuple[int, int, dict[str, np.ndarray]]]:
        """(start, stop, arrays) of several chunks in order, two of them in work at a time; run 0 comes with tracks.

        Two chunks on two cores take less time than each of them spread over both.
        """
        with ThreadPoolExecutor(WORKERS) as pool:
            waiting: deque = deque()
            try:
                for start, stop in ranges:
                    waiting.append((start, stop, pool.submit(self.run_chunk, start, stop, tracked=int(start == 0))))
                    if len(waiting) > WORKERS:
                        first, last, future = waiting.popleft()
                        yield first, last, future.result()
                while waiting:
                    first, last, future = waiting.popleft()
                    yield first, last, future.result()
            finally:
                for _, _, future in waiting:
                    future.cancel()


def without_tracks(arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The arrays that are stored of a chunk unless every report is asked for."""
    return {
        name: array
        for name, array in arrays.items()
        if "/track/" not in name and not name.startswith(("scans/", "truth/"))
    }

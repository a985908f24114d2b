"""Many runs: chunks of fixed size, from run numbers to the arrays that are stored."""

import gc
import itertools
import statistics
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from emt.device import threads
from emt.keys import filter_number
from emt.models.state_space.measurements import Measurement
from emt.montecarlo.compiling import filter_options, simulator_options
from emt.montecarlo.devices import chunks_at_once
from emt.montecarlo.fields import truth_fields
from emt.montecarlo.program import RUNS_OF_SIMULATION, Program, Simulation
from emt.montecarlo.run import Scores, as_truth
from emt.status import FAILURE
from emt.types import Measurements

WORKERS = 2
"""Programs compiled at a time, and chunks in work where XLA has a thread for each: on one they would only wait for one
another, and what a filter costs could not be told."""
BLOCKS = 8
"""Groups of runs per chunk whose sums per step are kept apart, for standard errors of root-mean-square metrics."""


def chunk_runs(start: int, stop: int, chunk_size: int) -> np.ndarray:
    """Run numbers of a chunk, padded to the fixed size with repetitions of the last one."""
    return np.minimum(np.arange(start, start + chunk_size), stop - 1)


def score_arrays(label: str, scores: Scores, n: int) -> dict[str, np.ndarray]:
    """What is stored of one filter's scores of the first `n` runs of a chunk.

    `values` (run, metric), `status`, `failed_step` and `nis`, its mean over steps (run); over the runs without
    failure, per block of runs, `step_sum` (block, step, metric) and `step_count` (block), and over all of them
    `step_squares` (step, metric) and, of a filter with modes, the sum `mode_sum` (step, mode) of their probabilities.
    """
    rows, status = np.asarray(scores.per_step)[:n].astype(np.float64), np.asarray(scores.status)[:n]
    sound = (status & int(FAILURE)) == 0
    kept = np.where(sound[:, None, None], rows, 0.0)
    edges = np.linspace(0, n, BLOCKS + 1).astype(int)
    blocks = [slice(a, b) for a, b in itertools.pairwise(edges)]
    modes, sums = scores.track.modes, {}
    if modes is not None:
        probability = np.asarray(modes)[:n].astype(np.float64)
        sums[f"{label}/mode_sum"] = np.where(sound[:, None, None], probability, 0.0).sum(axis=0)
    return sums | {
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


def scan_places(measurement: Measurement, scans: Measurements) -> Float[Array, "run step 2"] | None:
    """Where in the plane the measurements say that a point is (m); NaN without a measurement, None if they do not say.

    Args:
        measurement: what is measured of the point.
        scans: with leading axes run and step.
    """
    places = jax.vmap(jax.vmap(lambda points: measurement.place(points[0])))(scans.points)
    return None if places is None else jnp.where(scans.mask, places, jnp.nan)


def scan_arrays(program: Program, simulation: Simulation, n: int) -> dict[str, np.ndarray]:
    """Scans, and the truth where there is one, of the first `n` runs of a chunk, with leading axes run and step."""
    # by NumPy: JAX would compile a program for every shape
    simulation = jax.tree.map(lambda leaf: np.moveaxis(np.asarray(leaf)[:, :n], RUNS_OF_SIMULATION, 0), simulation)
    arrays = {"scans/points": simulation.scans.points, "scans/mask": simulation.scans.mask}
    measurement = getattr(program.world.scenario, "measurement", None)
    if isinstance(measurement, Measurement):
        places = scan_places(measurement, simulation.scans)
        arrays |= {} if places is None else {"scans/places": places}
    if program.experiment.scenario.has_truth:
        drawn = jax.vmap(jax.vmap(truth_fields))(simulation.truth)
        arrays |= {f"truth/{name}": value for name, value in drawn.items()}
    return {name: np.asarray(value) for name, value in arrays.items()}


SHOWN = "with points"
"""Name, which no filter can have, of the simulator that keeps the points of scans."""


@contextmanager
def without_collection() -> Iterator[None]:
    """Garbage is collected later: going through the many objects of traced programs is a fifth of a warm start."""
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


class Engine:
    """Runs chunks of one experiment; compiled once, for the chunk size.

    Args:
        quick: compile in a hurry, for a few runs.
        devices: where to run; by default all that this process has. They change no result.
    """

    def __init__(
        self,
        program: Program,
        seed: int,
        chunk_size: int,
        *,
        quick: bool = False,
        devices: Sequence[Any] | None = None,
    ):
        self.program, self.seed, self.chunk_size = program, jnp.asarray(seed), chunk_size
        self.devices = list(devices or jax.local_devices())
        self.at_once = chunks_at_once(chunk_size, self.devices)
        self.options, self.simulator_options = filter_options(quick=quick), simulator_options(quick=quick)
        """Options of XLA for filters, and for the simulator."""
        self._compiled: dict[str, Any] = {}
        self.seconds: dict[str, list[float]] = {label: [] for label in program.filter_params}
        """Wall-clock time of filter and metrics of each chunk so far, by filter."""

    def labels(self) -> list[str]:
        """Filters in the order of computation: a reference filter first."""
        labels, reference = list(self.program.experiment.filters), self.program.experiment.reference
        return sorted(labels, key=lambda label: label != reference)

    def compile(self, on_start: Callable[[str], None] = lambda name: None) -> None:
        """Compiles simulator and filters, two at a time; again is free."""
        if self._compiled:
            return
        program, runs = self.program, jnp.zeros(self.chunk_size * self.at_once, int)
        simulator = program.simulator(self.devices, program.needs_points)

        def build(name: str):
            on_start(name or "scenario")
            if not name:
                return simulator.lower(program.world, self.seed, runs).compile(self.simulator_options)
            arguments = self.arguments(name, runs, shapes.scans, shapes.truth)
            return program.shared_scorer(name, self.devices).lower(*arguments).compile(self.options)

        names = ["", *self.labels()]
        with without_collection(), ThreadPoolExecutor(WORKERS) as pool:
            shapes = jax.eval_shape(simulator, program.world, self.seed, runs)
            self._compiled = dict(zip(names, pool.map(build, names), strict=True))

    def with_points(self, runs: Array) -> Simulation:
        """The same simulation with the points of scans, for a chunk whose runs are shown; compiled when it is first
        asked for."""
        arguments = self.program.world, self.seed, runs
        if SHOWN not in self._compiled:
            lowered = self.program.simulator(self.devices).lower(*arguments)
            self._compiled[SHOWN] = lowered.compile(self.simulator_options)
        return self._compiled[SHOWN](*arguments)

    def arguments(self, label: str, runs, scans, target) -> tuple[Any, ...]:
        """What the program of a filter is given."""
        params = self.program.filter_params[label]
        return self.program.world, params, self.seed, runs, scans, target, jnp.asarray(filter_number(label))

    def costs(self) -> dict[str, float]:
        """Microseconds per run and step of each filter with its metrics: the median over chunks but the first, which is
        slower than the others, if there are any.

        Two chunks are in work at a time where there are threads for both, so it is what a run costs in company, not
        alone.
        """
        lanes = self.chunk_size * self.program.n_steps
        later = {label: found[1:] or found for label, found in self.seconds.items() if found}
        return {label: 1e6 * statistics.median(found) / lanes for label, found in later.items()}

    def run_chunk(self, start: int, stop: int, *, tracked: int = 0) -> dict[str, np.ndarray]:
        """Arrays of the runs `start` to `stop - 1`, by name; with every report and scan of the first `tracked` runs.

        An experiment that asks for traces gets those of all runs.
        """
        return self.run_group([(start, stop)], tracked=tracked)[0]

    def run_group(self, ranges: Sequence[tuple[int, int]], *, tracked: int = 0) -> list[dict[str, np.ndarray]]:
        """The arrays of up to `at_once` chunks in one call of each program; the first chunk is tracked."""
        program, experiment = self.program, self.program.experiment
        size = self.chunk_size
        filled = [*ranges, *[ranges[-1]] * (self.at_once - len(ranges))]
        runs = jnp.asarray(np.concatenate([chunk_runs(start, stop, size) for start, stop in filled]))
        simulation = jax.block_until_ready(self._compiled[""](program.world, self.seed, runs))
        target, found = simulation.truth, [{} for _ in ranges]

        def part(tree: Any, k: int, axis: int = 0) -> Any:
            """The share of one chunk."""
            if self.at_once == 1:
                return tree
            mine = (*[slice(None)] * axis, slice(k * size, (k + 1) * size))
            return jax.tree.map(lambda leaf: np.asarray(leaf)[mine], tree)

        def traced(k: int) -> int:
            n = ranges[k][1] - ranges[k][0]
            return n if experiment.traces else min(tracked, n) * (k == 0)

        for label in self.labels():
            arguments = self.arguments(label, runs, simulation.scans, target)
            started = time.perf_counter()
            scores = jax.block_until_ready(self._compiled[label](*arguments))
            self.seconds[label].append((time.perf_counter() - started) / len(ranges))
            if label == experiment.reference:
                target = jax.vmap(as_truth, out_axes=RUNS_OF_SIMULATION)(scores.track)
            for k, (start, stop) in enumerate(ranges):
                mine = part(scores, k)
                found[k] |= score_arrays(label, mine, stop - start)
                if traced(k):
                    found[k] |= track_arrays(label, mine, traced(k))
        if not program.needs_points and any(traced(k) for k in range(len(ranges))):
            simulation = self.with_points(runs)
        for k in range(len(ranges)):
            if traced(k):
                found[k] |= scan_arrays(program, part(simulation, k, RUNS_OF_SIMULATION), traced(k))
        return found

    def run_chunks(self, ranges: Iterable[tuple[int, int]]) -> Iterator[tuple[int, int, dict[str, np.ndarray]]]:
        """(start, stop, arrays) of several chunks in order, two calls of them in work at a time if there are threads
        for both; run 0 comes with tracks.

        Two chunks on two cores take less time than each of them spread over both.
        """
        remaining, at_a_time = iter(ranges), min(WORKERS, threads())
        groups = iter(lambda: list(itertools.islice(remaining, self.at_once)), [])
        with ThreadPoolExecutor(at_a_time) as pool:
            waiting: deque = deque()

            def first() -> Iterator[tuple[int, int, dict[str, np.ndarray]]]:
                group, future = waiting.popleft()
                for (start, stop), arrays in zip(group, future.result(), strict=True):
                    yield start, stop, arrays

            try:
                for group in groups:
                    waiting.append((group, pool.submit(self.run_group, group, tracked=int(group[0][0] == 0))))
                    if len(waiting) > at_a_time:
                        yield from first()
                while waiting:
                    yield from first()
            finally:
                for _, future in waiting:
                    future.cancel()


def without_tracks(arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The arrays that are stored of a chunk unless every report is asked for."""
    return {
        name: array
        for name, array in arrays.items()
        if "/track/" not in name and not name.startswith(("scans/", "truth/"))
    }

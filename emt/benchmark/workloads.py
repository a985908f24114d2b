"""The parts of a standard workload that are timed."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from emt.benchmark.operations import COUNTS
from emt.benchmark.peers.agreement import own_reports
from emt.benchmark.peers.base import ELLIPSE, Scans
from emt.benchmark.peers.given import scans_of
from emt.benchmark.standard import WORKLOADS
from emt.config.load import Loaded, load_experiment
from emt.montecarlo.chunks import Engine
from emt.montecarlo.program import Program
from emt.runner import build_program


class Bench(NamedTuple):
    """A workload compiled, with what its first chunk of runs gave."""

    name: str
    loaded: Loaded
    program: Program
    label: str
    """Its filter."""
    runs: int
    """In a chunk."""
    calls: dict[str, Callable[[], Any]]
    """Each computes a chunk: `simulation`; `filter`, from stored scans to tracks; `end_to_end`, simulation, filter,
    metrics and statistics, to the arrays that a folder stores."""
    arrays: dict[str, np.ndarray]
    """Scans, truth and tracks of the chunk."""
    scans: Scans

    @property
    def few(self) -> int:
        """Runs given to what takes one after the other."""
        return min(WORKLOADS[self.name].few, self.runs)

    @property
    def steps(self) -> int:
        """Of a run."""
        return self.program.n_steps

    def reports(self, columns: Sequence[str] | None = None) -> np.ndarray:
        """What the filter reported (run, step, k): the columns of a peer; all there are of an ellipse, or the mean of
        the state, by default."""
        if columns is None and f"{self.label}/track/orientation" not in self.arrays:
            return self.arrays[f"{self.label}/track/mean"]
        return own_reports(self.arrays, self.label, ELLIPSE if columns is None else columns)

    def points_per_scan(self) -> float:
        """Mean number of measurements."""
        return float(self.scans.mask.sum(axis=-1).mean())

    def operations(self) -> float | None:
        """Floating-point operations per run and step, at the mean number of points; None if they are not counted."""
        if self.name not in COUNTS:
            return None
        told = self.loaded.experiment.filters[self.label].model_dump()
        told["motions"] = len(getattr(self.loaded.experiment.model, "named_motions", ()))
        return COUNTS[self.name](self.points_per_scan(), told)


def load_workload(name: str, overrides: Sequence[str] = ()) -> Loaded:
    """The experiment of a workload."""
    return load_experiment(f"benchmark/{name}", overrides)


def compiled_filter(
    program: Program, label: str, seed: jax.Array, runs: jax.Array, simulation, options: dict[str, Any] | None
) -> Callable[[], Any]:
    """The call of the filter alone, without metrics, on these scans."""
    bare = dataclasses.replace(program, metrics=())
    arguments = (program.world, program.filter_params[label], seed, runs, simulation.scans, simulation.truth)
    compiled = bare.scorer(label).lower(*arguments).compile(options)
    return lambda: jax.block_until_ready(compiled(*arguments))


def prepared(name: str, overrides: Sequence[str] = ()) -> Bench:
    """A workload ready to be timed.

    Args:
        overrides: texts `key=value`, to make it smaller.
    """
    loaded = load_workload(name, overrides)
    program = build_program(loaded)
    (label,) = loaded.experiment.filters
    seed, n = loaded.experiment.monte_carlo.seed, loaded.experiment.chunk_size
    engine = Engine(program, seed, n)
    engine.compile()
    arguments = (program.world, jnp.asarray(seed), jnp.arange(n))
    simulator = program.simulator(points=program.needs_points).lower(*arguments).compile(engine.simulator_options)
    simulation = jax.block_until_ready(simulator(*arguments))
    calls = {
        "simulation": lambda: jax.block_until_ready(simulator(*arguments)),
        "filter": compiled_filter(program, label, *arguments[1:], simulation, engine.options),
        "end_to_end": lambda: engine.run_chunk(0, n),
    }
    arrays = engine.run_chunk(0, n, tracked=n)
    return Bench(name, loaded, program, label, n, calls, arrays, scans_of(program, arrays, seed))

"""Scores of candidates on a fixed batch of runs: common random numbers, so differences between them are sharp."""

import dataclasses
import itertools
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from emt.config.load import Loaded
from emt.metrics.base import Metric
from emt.montecarlo.chunks import WORKERS
from emt.montecarlo.compiling import filter_options, simulator_options
from emt.montecarlo.program import RUNS_OF_SIMULATION, SCORED
from emt.montecarlo.run import as_truth
from emt.runner import build_program
from emt.status import FAILURE
from emt.tuning.trial import Built, Trial, grouped
from emt.types import Measurements, Truth

LANES = 208
"""Filters computed together; see `MonteCarlo.chunk`."""


class Score(NamedTuple):
    """A metric of one candidate on a batch."""

    value: float
    shares: np.ndarray
    """What each run contributes: their mean is the value (run); 0 for failed runs."""
    sound: np.ndarray
    """True for the runs without failure (run)."""

    @property
    def failed(self) -> int:
        """Runs that failed."""
        return int((~self.sound).sum())

    @property
    def error(self) -> float:
        """Standard error of the value."""
        return standard_error(self.shares[self.sound])

    def above(self, other: "Score") -> tuple[float, float]:
        """Mean and standard error of the difference to another candidate over the runs sound in both."""
        both = self.sound & other.sound
        gap = self.shares[both] - other.shares[both]
        return (float(gap.mean()) if len(gap) else float("nan")), standard_error(gap)


def standard_error(values: np.ndarray) -> float:
    """Of the mean; NaN for fewer than two values."""
    return float(np.std(values, ddof=1) / np.sqrt(len(values))) if len(values) > 1 else float("nan")


def shares_of(metric: Metric, values: jax.Array, rows: jax.Array, sound: jax.Array) -> jax.Array:
    """What each run (run,) contributes to a metric, from its value (run,) and those of its steps (run, step).

    For a mean it is the value of the run. For a root mean square over runs, averaged over steps, it is the first-order
    share mean_k (√m_k + (e²_k - m_k) / 2√m_k), with m_k the mean square at step k: shares average to the value exactly
    and spread as the value does. For one over runs and steps it is the same with the mean squares of runs.
    """
    used = jnp.maximum(sound.sum(dtype=rows.dtype), 1.0)
    rows = jnp.where(sound[:, None], rows, 0.0)
    if metric.over_runs == "rms":
        root = jnp.sqrt(rows.sum(axis=0) / used)
        safe = jnp.where(root > 0.0, root, 1.0)
        return jnp.where(sound, (0.5 * root[None, :] + 0.5 * rows / safe[None, :]).mean(axis=1), 0.0)
    if metric.over_runs == "pooled":
        squares = jnp.where(sound, values * values, 0.0)
        root = jnp.sqrt(squares.sum() / used)
        return jnp.where(sound, 0.5 * root + 0.5 * squares / jnp.where(root > 0.0, root, 1.0), 0.0)
    return jnp.where(sound, values, 0.0)


class Data(NamedTuple):
    """Runs that candidates are scored on; an argument of compiled functions, in which it would be a huge constant."""

    seed: jax.Array
    runs: jax.Array
    scans: Measurements
    target: Truth


class Batch:
    """Simulated runs on which candidates for one filter are scored.

    Args:
        loaded: the experiment before tuning; its scenario makes the runs.
        label: the filter.
        metrics: what is scored.
        first, count: the runs.
    """

    def __init__(self, loaded: Loaded, label: str, metrics: Sequence[Metric], first: int, count: int):
        self.label, self.metrics = label, tuple(metrics)
        self.program = dataclasses.replace(build_program(loaded), metrics=self.metrics)
        program, reference = self.program, loaded.experiment.reference
        seed, runs = jnp.asarray(loaded.experiment.monte_carlo.seed), first + jnp.arange(count)
        simulate = program.simulator().lower(program.world, seed, runs).compile(simulator_options())
        simulation = simulate(program.world, seed, runs)
        self.data = Data(seed, runs, simulation.scans, simulation.truth)
        if reference != "truth":
            arguments = (program.world, program.filter_params[reference], *self.data)
            scores = program.scorer(reference).lower(*arguments).compile(filter_options())(*arguments)
            self.data = self.data._replace(target=jax.vmap(as_truth, out_axes=RUNS_OF_SIMULATION)(scores.track))

    def shares(self, make: Callable[..., Any], trial: Trial, data: Data) -> tuple[jax.Array, jax.Array]:
        """Shares (metric, run) and soundness (run) of one candidate; to be compiled."""
        program = dataclasses.replace(self.program, make_filter={self.label: make})
        world = program.world._replace(model=trial.model, prior=trial.prior)
        one = partial(program.score_run, self.label)
        scores = jax.vmap(one, in_axes=SCORED)(world, trial.params, *data)
        sound = (scores.status & int(FAILURE)) == 0
        rows = scores.per_step[:, program.experiment.skip_steps :]
        values = scores.values
        return jnp.stack([shares_of(m, values[:, k], rows[:, :, k], sound) for k, m in enumerate(self.metrics)]), sound

    def score(
        self, trials: Sequence[Built], on_progress: Callable[[int], None] = lambda done: None
    ) -> list[list[Score]]:
        """Scores of every metric for every candidate; candidates of one structure share one compilation."""
        results: list[list[Score]] = [[] for _ in trials]
        done = 0
        for group in grouped(list(trials)):
            together = max(1, min(LANES // len(self.data.runs), len(group)))
            of_all = jax.vmap(partial(self.shares, trials[group[0]].make), in_axes=(0, None))
            compiled = jax.jit(of_all, compiler_options=filter_options())

            def one(members: list[int], compiled=compiled, together=together):
                padded = members + [members[-1]] * (together - len(members))
                stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *(trials[k].trial for k in padded))
                return members, jax.block_until_ready(compiled(stacked, self.data))

            parts = [group[k : k + together] for k in range(0, len(group), together)]
            finished = [one(parts[0])]  # the first one compiles
            with ThreadPoolExecutor(WORKERS) as pool:
                for members, (shares, sound) in itertools.chain(finished, pool.map(one, parts[1:])):
                    for k, member in enumerate(members):
                        results[member] = scores_of(np.asarray(shares[k]), np.asarray(sound[k]))
                    done += len(members)
                    on_progress(done)
        return results


def scores_of(shares: np.ndarray, sound: np.ndarray) -> list[Score]:
    """A score per metric from shares (metric, run)."""
    used = max(int(sound.sum()), 1)
    return [Score(float(row.sum() / used) if sound.any() else float("nan"), row, sound) for row in shares]

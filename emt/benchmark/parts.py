"""Any experiment, part by part: simulation, filters, and filters with metrics."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from emt.benchmark.clock import interleaved, timed
from emt.benchmark.processes import peak_memory
from emt.config.load import Loaded, load_experiment
from emt.config.shipped import config_names, papers
from emt.montecarlo.chunks import Engine
from emt.montecarlo.program import Program
from emt.reports.paper import published_of
from emt.reports.table import Column, Table
from emt.runner import build_program

ALONE = ", filter only, one run alone"
COLUMNS = [
    Column("part", "part"),
    Column("us", "µs per run and step", True),
    Column("ratio", "ratio", True),
    Column("compile", "compile s", True),
]


def experiments_of(name: str) -> list[str]:
    """The experiments of a paper that are its benchmarks, or all if none are; any other name stands for itself."""
    if name not in papers():
        return [name]
    published = published_of(name)
    return list((published.benchmarks if published else ()) or config_names(name))


def parts_table(name: str, repetitions: int) -> Table:
    """Wall-clock times of the parts of an experiment, interleaved in this process, on all its cores.

    Raises:
        ConfigError: there is no such experiment, or it cannot be used.
    """
    loaded = load_experiment(name)
    parts, compile_seconds = timed_parts(build_program(loaded), loaded)
    costs = interleaved(parts, repetitions)
    n_steps, chunk = getattr(loaded.experiment.scenario, "n_steps", 1), loaded.experiment.chunk_size
    fastest = min(cost.wall for part, cost in costs.items() if not part.endswith(ALONE))
    rows, values = [], []
    for part, cost in costs.items():
        alone = part.endswith(ALONE)
        us, ratio = 1e6 * cost.wall / (n_steps * (1 if alone else chunk)), None if alone else cost.wall / fastest
        values.append({"part": part, "us": us, "ratio": ratio, "compile": compile_seconds[part]})
        shown = {"us": f"{us:.2f}", "ratio": "" if ratio is None else f"{ratio:.1f}"}
        rows.append({"part": part, **shown, "compile": f"{compile_seconds[part]:.1f}"})
    note = f"wall clock, median of {repetitions}, {chunk} runs; peak memory {peak_memory():.0f} MiB"
    return Table(loaded.name, COLUMNS, rows, values, [note])


def timed_parts(program: Program, loaded: Loaded) -> tuple[dict[str, Callable[[], Any]], dict[str, float]]:
    """Calls that compute one chunk of each part and wait for it, compiled; with their compile times (s).

    Filters are called on a whole chunk of runs and on a single run alone.
    """
    seed = jnp.asarray(loaded.experiment.monte_carlo.seed)
    runs = jnp.arange(loaded.experiment.chunk_size)
    bare = dataclasses.replace(program, metrics=())
    engine = Engine(program, loaded.experiment.monte_carlo.seed, loaded.experiment.chunk_size)
    compile_seconds, calls = {}, {}

    def add(part, function, arguments, options=engine.options):
        lowered: list[Any] = []
        _, compile_seconds[part] = timed(lambda: lowered.append(function.lower(*arguments).compile(options)))
        calls[part] = lambda: jax.block_until_ready(lowered[0](*arguments))
        return calls[part]()

    simulation = add(
        "simulation",
        program.simulator(points=program.needs_points),
        (program.world, seed, runs),
        engine.simulator_options,
    )
    for label in loaded.experiment.filters:
        arguments = (program.world, program.filter_params[label], seed, runs, simulation.scans, simulation.truth)
        add(f"{label}, filter only", bare.scorer(label), arguments)
        add(f"{label}, with metrics", program.scorer(label), arguments)
        first = jax.tree.map(lambda leaf: leaf[:, :1], (simulation.scans, simulation.truth))
        add(f"{label}{ALONE}", bare.scorer(label), (*arguments[:3], runs[:1], *first))
    return calls, compile_seconds

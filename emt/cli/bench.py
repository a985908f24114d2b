"""`emt bench`: what a run and step costs, part by part, in one process."""

import resource
import statistics
import time
from typing import Annotated

import typer

ALONE = ", filter only, one run alone"


def bench(
    configs: Annotated[
        list[str] | None, typer.Argument(metavar="[CONFIG|PAPER]...", help="Experiments to time, or papers.")
    ] = None,
    repetitions: Annotated[int, typer.Option(min=1, help="Interleaved repetitions; the median counts.")] = 7,
) -> None:
    """Time simulation, filters, and filters with metrics, per run and step, interleaved in one process.

    Filters are timed on a whole chunk of runs and on a single run alone.

    Example: emt bench tuncer2021/trajectory_uniform
    """
    from emt.config.load import load_experiment
    from emt.config.shipped import config_names, papers
    from emt.reports.paper import published_of
    from emt.reports.table import Column, Table
    from emt.runner import build_program

    columns = [
        Column("part", "part"),
        Column("us", "µs per run and step", True),
        Column("ratio", "ratio", True),
        Column("compile", "compile s", True),
    ]
    names: list[str] = []
    for name in configs or ["tuncer2021/trajectory_uniform"]:
        published = published_of(name) if name in papers() else None
        listed = published.benchmarks if published else ()
        names += [*(listed or config_names(name))] if name in papers() else [name]
    for name in names:
        loaded = load_experiment(name)
        parts, compile_seconds = timed_parts(build_program(loaded), loaded)
        samples: dict[str, list[float]] = {part: [] for part in parts}
        for _ in range(repetitions):
            for part, call in parts.items():
                started = time.perf_counter()
                call()
                samples[part].append(time.perf_counter() - started)
        medians = {part: statistics.median(times) for part, times in samples.items()}
        n_steps, chunk = getattr(loaded.experiment.scenario, "n_steps", 1), loaded.experiment.chunk_size
        fastest = min(seconds for part, seconds in medians.items() if not part.endswith(ALONE))
        rows = [
            {
                "part": part,
                "us": f"{1e6 * seconds / (n_steps * (1 if part.endswith(ALONE) else chunk)):.2f}",
                "ratio": "" if part.endswith(ALONE) else f"{seconds / fastest:.1f}",
                "compile": f"{compile_seconds[part]:.1f}",
            }
            for part, seconds in medians.items()
        ]
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
        note = f"wall clock, median of {repetitions}, {loaded.experiment.chunk_size} runs; peak memory {peak:.0f} MiB"
        typer.echo(Table(loaded.name, columns, rows, rows, [note]).render("text"))


def timed_parts(program, loaded):
    """Calls that compute one chunk of each part and wait for it, compiled; with their compile times."""
    import dataclasses

    import jax
    import jax.numpy as jnp

    seed = jnp.asarray(loaded.experiment.monte_carlo.seed)
    runs = jnp.arange(loaded.experiment.chunk_size)
    bare = dataclasses.replace(program, metrics=())
    compile_seconds, calls = {}, {}

    def add(part, function, arguments):
        started = time.perf_counter()
        compiled = function.lower(*arguments).compile()
        compile_seconds[part] = time.perf_counter() - started
        calls[part] = lambda: jax.block_until_ready(compiled(*arguments))
        return calls[part]()

    simulation = add("simulation", program.simulator(), (program.world, seed, runs))
    for label in loaded.experiment.filters:
        arguments = (program.world, program.filter_params[label], seed, runs, simulation.scans, simulation.truth)
        add(f"{label}, filter only", bare.scorer(label), arguments)
        add(f"{label}, with metrics", program.scorer(label), arguments)
        first = jax.tree.map(lambda leaf: leaf[:1], (simulation.scans, simulation.truth))
        add(f"{label}{ALONE}", bare.scorer(label), (*arguments[:3], runs[:1], *first))
    return calls, compile_seconds

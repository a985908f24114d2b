"""`emt run`, `emt table`, `emt replay`."""

from contextlib import contextmanager
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from emt.cli.errors import CHECK_FAILED, InterruptedRunError, UnusableError, say


class TableFormat(StrEnum):
    """Formats of a table."""

    text = "text"
    markdown = "markdown"
    latex = "latex"
    csv = "csv"
    json = "json"


Config = Annotated[str, typer.Argument(help="A file, or the name of a shipped experiment (see `emt list`).")]
Overrides = Annotated[
    list[str] | None, typer.Argument(metavar="[KEY=VALUE]...", help="Settings to change, e.g. filters.vb.iterations=3.")
]


def run(
    config: Config,
    overrides: Overrides = None,
    out: Annotated[Path | None, typer.Option(help="Folder for the results; default results/NAME.")] = None,
    seed: Annotated[int | None, typer.Option(min=0, help="Seed, instead of the configuration's.")] = None,
    runs: Annotated[int | None, typer.Option(min=1, help="Runs in all, instead of the configuration's.")] = None,
    more: Annotated[int, typer.Option(min=0, help="Runs to add to a finished folder.")] = 0,
    workers: Annotated[int | None, typer.Option(min=1, help="Worker processes to start on this machine.")] = None,
    scheduler: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="A running Dask scheduler, instead: tcp://HOST:PORT.")
    ] = None,
) -> None:
    """Run an experiment, or continue it where it stopped; ends with its table.

    The folder keeps every finished chunk of runs: after an interruption the same command continues, and
    --more extends what is there. Another configuration needs another folder. With workers, or without, the
    results are the same.

    Example: emt run tuncer2021/trajectory_uniform monte_carlo.runs=200 filters.vb.iterations=5 --out results/vb5
    """
    from emt.config.load import load_experiment
    from emt.reports.published import summary_table

    changes = list(overrides or [])
    changes += [f"monte_carlo.seed={seed}"] * (seed is not None) + [f"monte_carlo.runs={runs}"] * (runs is not None)
    loaded = load_experiment(config, changes)
    folder = Path("results") / loaded.name if out is None else out
    with pool_of(workers, scheduler) as pool:
        summary = run_shown(loaded, folder, more=more, pool=pool)
    unit = loaded.experiment.length_unit
    if summary["metrics"]:
        typer.echo(summary_table(summary, unit).render("text"), nl=False)
    else:
        from emt.reports.estimates import estimates_table
        from emt.store import read_folder

        typer.echo(estimates_table(read_folder(folder), frames=(1, 2, 5, 10, 20, 50, 100, 200, 500)).render("text"))
    say(f"results: {folder}")
    lost = [label for label in summary["labels"] if summary["status"][label]["failed"] == summary["runs"]]
    if lost:
        say(f"no run survived for: {', '.join(lost)}")
        raise typer.Exit(CHECK_FAILED)


@contextmanager
def pool_of(workers: int | None, scheduler: str | None):
    """The workers asked for, None if there are none; says where to watch them."""
    if workers is None and scheduler is None:
        yield None
        return
    if workers is not None and scheduler is not None:
        raise UnusableError("give either --workers or --scheduler: a scheduler brings its own workers")
    from emt.cluster.connecting import open_pool
    from emt.cluster.pool import ClusterError

    try:
        with open_pool(workers=workers, scheduler=scheduler) as pool:
            say(f"dashboard: {pool.dashboard}" if pool.dashboard else f"scheduler: {pool.address}")
            yield pool
    except ClusterError as error:
        raise UnusableError(str(error)) from error


def run_shown(
    loaded,
    folder: Path,
    *,
    more: int = 0,
    runs: int | None = None,
    figures: bool = True,
    quick: bool = False,
    pool=None,
):
    """Runs an experiment under a live view; an interruption becomes a message that says how to go on."""
    from emt.cli.display import LiveView
    from emt.cli.interruption import remembered
    from emt.runner import run as run_experiment

    metric = loaded.experiment.metrics[0] if loaded.experiment.metrics else ""
    last = None
    try:
        with remembered() as look, LiveView(loaded.name, metric) as view:

            def update(progress):
                nonlocal last
                last = progress
                look()
                view.update(progress)

            options = {"figures": figures, "quick": quick, "on_progress": update, "pool": pool}
            return run_experiment(loaded, folder, runs=runs, more=more, **options)
    except KeyboardInterrupt:
        kept = f"{last.done} of {last.total}" if last is not None else "all finished"
        message = f"interrupted: {kept} runs are kept in {folder}; the same command continues"
        raise InterruptedRunError(message) from None


def table(
    folder: Annotated[Path, typer.Argument(help="A folder written by `emt run` or `emt reproduce`.")],
    format: Annotated[TableFormat, typer.Option("--format", "-f", help="Format.")] = TableFormat.text,
    over_time: Annotated[bool, typer.Option("--over-time", help="Every metric at every scan, instead.")] = False,
) -> None:
    """Print the table of a finished experiment; with published numbers beside it where there are any.

    Example: emt table results/tuncer2021/trajectory_uniform --format latex
    """
    from emt.reports.over_time import curves_table
    from emt.reports.paper import folder_tables
    from emt.store import read_folder

    for part in [curves_table(read_folder(folder))] if over_time else folder_tables(folder):
        typer.echo(part.render(format.value), nl=format.value in ("text", "markdown"))


def replay(
    config: Config,
    overrides: Overrides = None,
    run: Annotated[int, typer.Option("--run", min=0, help="Number of the run.")] = 0,
    seed: Annotated[int | None, typer.Option(min=0, help="Seed, instead of the configuration's.")] = None,
    out: Annotated[Path | None, typer.Option(help="Folder for figure and values; default results/replay.")] = None,
) -> None:
    """Compute one run again: a figure of truth, scans and every filter's ellipses, and every step's values.

    Example: emt replay tuncer2021/trajectory_uniform --run 17
    """
    from emt.config.load import load_experiment
    from emt.runner import replay as replay_run

    loaded = load_experiment(config, [*(overrides or []), *([f"monte_carlo.seed={seed}"] * (seed is not None))])
    result = replay_run(loaded, run)
    folder = Path("results") / "replay" if out is None else out
    try:
        folder.mkdir(parents=True, exist_ok=True)
        stem = f"{loaded.name.replace('/', '-')}-run{run}"
        (folder / f"{stem}.png").write_bytes(result.figure)
        (folder / f"{stem}.csv").write_text(result.steps.render("csv"), encoding="utf-8")
    except OSError as error:
        raise UnusableError(f"{folder}: cannot be written: {error.strerror or error}") from error
    typer.echo(result.overview.render("text"), nl=False)
    say(f"figure: {folder / f'{stem}.png'}\nvalues: {folder / f'{stem}.csv'}")

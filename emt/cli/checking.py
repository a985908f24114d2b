"""`emt verify` and `emt check`: are the filters what they should be, and did a metric move?"""

import tempfile
from pathlib import Path
from typing import Annotated

import typer

from emt.cli.errors import CHECK_FAILED, UNUSABLE, UnusableError, say


def verify(
    files: Annotated[list[Path], typer.Argument(help="Files of golden vectors (JSON).")],
    data: Annotated[Path | None, typer.Option(help="The recording, for vectors computed from one.")] = None,
) -> None:
    """Run golden vectors of other implementations through emt's own functions.

    Prints worst absolute and relative errors per quantity. Exit 0: all within tolerance; 1: some outside; 2: a file
    is unusable.

    Example: emt verify tests/golden/*.json
    """
    from emt.device import configure

    configure()
    from emt.conformance.golden import GoldenError
    from emt.conformance.golden import verify as run_golden
    from emt.conformance.kinds import KINDS
    from emt.reports.table import Column, Table

    columns = [
        Column("quantity", "quantity"),
        Column("cases", "cases", True),
        Column("absolute", "worst absolute", True),
        Column("relative", "worst relative", True),
        Column("tolerance", "tolerance", True),
        Column("verdict", ""),
    ]
    failed = unusable = 0
    for file in files:
        try:
            rows = run_golden(file, KINDS, data)
        except GoldenError as error:
            say(str(error))
            unusable += 1
            continue
        cells = [
            {
                "quantity": row.quantity,
                "cases": str(row.cases),
                "absolute": f"{row.absolute:.1e}",
                "relative": f"{row.relative:.1e}",
                "tolerance": f"{row.tolerance:.0e}",
                "verdict": "ok" if row.passed else "OUTSIDE",
            }
            for row in rows
        ]
        failed += not all(row.passed for row in rows)
        typer.echo(Table(str(file), columns, cells, cells).render("text"))
    if failed or unusable:
        raise typer.Exit(UNUSABLE if unusable else CHECK_FAILED)


def check(
    names: Annotated[
        list[str] | None, typer.Argument(metavar="[EXPERIMENT|PAPER]...", help="All shipped by default.")
    ] = None,
    baselines: Annotated[Path | None, typer.Option(help="Folder of baselines; default results/baselines.")] = None,
    update: Annotated[bool, typer.Option("--update", help="Write the present results as the new baselines.")] = False,
) -> None:
    """Run the shipped experiments at smoke scale and compare every metric with its baseline.

    On the platform of the baseline a metric may move by rounding only; elsewhere by 4 standard errors. Exit 1 if
    one moved, with a table of what moved.

    Example: emt check tuncer2021/ncv_gaussian
    """
    import json

    from emt.cli.running import run_shown
    from emt.config.load import at_smoke_scale, load_experiment
    from emt.config.shipped import SHIPPED, config_names, papers
    from emt.device import environment
    from emt.reports.baseline import BaselineError, baseline_of, changes_table, compare, read_baseline

    if baselines is None:
        baselines = SHIPPED / "results" / "baselines"
    wanted = [one for name in names or papers() for one in (config_names(name) if name in papers() else [name])]
    loaded = [at_smoke_scale(load_experiment(name)) for name in wanted]
    loaded = [item for item in loaded if item.experiment.scenario.kind != "recorded"]  # these need the user's file
    paths = {item.name: baselines / f"{item.name}.json" for item in loaded}
    try:
        stored = {} if update else {name: read_baseline(path) for name, path in paths.items()}
    except BaselineError as error:
        raise UnusableError(str(error)) from error
    changes = []
    with tempfile.TemporaryDirectory() as scratch:
        for item in loaded:
            summary = run_shown(item, Path(scratch) / item.name, figures=False, quick=True)
            now = baseline_of(summary, environment())
            if update:
                path = paths[item.name]
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_text(json.dumps(now, indent=1, sort_keys=True) + "\n", encoding="utf-8")
                typer.echo(f"{path}: written")
            else:
                changes += compare(now, stored[item.name])
    if changes:
        typer.echo(changes_table(changes).render("text"), nl=False)
        raise typer.Exit(CHECK_FAILED)
    if not update:
        typer.echo(f"{len(loaded)} experiments: every metric is where its baseline has it")

"""`emt tune`: parameters from Monte Carlo runs."""

import time
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from emt.cli.errors import UnusableError, say

QUIET_SECONDS = 5.0


class Method(StrEnum):
    """How to search."""

    grid = "grid"
    gradient = "gradient"


def tune(
    config: Annotated[str, typer.Argument(help="A file, or the name of a shipped experiment (see `emt list`).")],
    parameters: Annotated[
        list[str],
        typer.Argument(metavar="PARAM...", help="KEY, KEY=LOW:HIGH[:COUNT] or KEY=VALUE,VALUE,...; * ties several."),
    ],
    method: Annotated[Method, typer.Option(help="Try every point of a grid, or follow a gradient.")] = Method.grid,
    objective: Annotated[str | None, typer.Option(help="Metric; the experiment's first by default.")] = None,
    label: Annotated[str | None, typer.Option("--filter", help="Filter, where the parameters do not tell.")] = None,
    overrides: Annotated[list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Change a setting.")] = None,
    runs: Annotated[int, typer.Option(min=2, max=5_000, help="Tuning runs.")] = 200,
    report_runs: Annotated[int, typer.Option(min=2, max=5_000, help="Other runs, for the scores shown.")] = 500,
    steps: Annotated[int, typer.Option(min=1, max=10_000, help="Steps of the gradient method.")] = 60,
    rate: Annotated[float, typer.Option(min=1e-6, help="Its first step, in units of ln(value).")] = 0.2,
    write: Annotated[bool, typer.Option("--write", help="Write the answer into the file, marked calibrated.")] = False,
    csv: Annotated[Path | None, typer.Option(help="Also write every candidate into this file.")] = None,
) -> None:
    """Find parameters of a filter by Monte Carlo runs, and show what they are worth on other runs.

    A key may name a single number or a group of them. The gradient method works on unconstrained coordinates through
    all steps and runs at once; where the metric is the IoU it follows a smooth stand-in, soft_iou.

    Example: emt tune yao2020/linear filters.ukf_cv.moment_cov=0.5:500 --method gradient --objective iou
    """
    from emt.config.load import load_experiment
    from emt.config.shipped import config_names
    from emt.tuning.parameters import label_of, parse_parameters
    from emt.tuning.search import holds_elsewhere, plan_of, search
    from emt.tuning.writing import parameters_table, prepare_text, scores_table, tried_table, write_answer

    loaded = load_experiment(config, overrides or [])
    if write and config in config_names() and not Path(config).is_file():
        raise UnusableError(f"{config} is shipped with emt: copy {loaded.source.path} and tune the copy to --write it")
    found = parse_parameters(parameters, loaded, method == Method.grid)
    chosen = label_of(found, label, loaded)
    if write:
        prepare_text(loaded, found, [p.start for p in found])  # what cannot be written is known before the search
    plan = plan_of(
        loaded, method.value, objective, tuning_runs=runs, reporting_runs=report_runs, steps=steps, rate=rate
    )
    if csv is not None and not csv.parent.is_dir():
        raise UnusableError(f"--csv {csv}: there is no folder {csv.parent}")
    said = -QUIET_SECONDS

    def tell(text: str) -> None:
        nonlocal said
        if time.perf_counter() - said > QUIET_SECONDS:
            said = time.perf_counter()
            say(f"{loaded.name}: {text}")

    outcome = search(loaded, chosen, found, plan, tell)
    for table in (
        tried_table(outcome, plan),
        parameters_table(outcome),
        scores_table(outcome, loaded.experiment.length_unit),
    ):
        typer.echo(table.render("text"))
    notes = [f"{len(outcome.tried)} candidates in {outcome.seconds:.0f} s, compilation included."]
    if plan.followed is not plan.objective:
        notes.append(
            f"The gradient followed {plan.followed.name}, a smooth stand-in; some points of its path were scored by "
            f"{plan.objective.name}, and the best of them is the answer."
        )
    if not loaded.experiment.scenario.has_truth:
        notes.append("A recording is one run: both scores are of the data that was tuned on.")
    changed, holds = outcome.values != tuple(p.start for p in found), holds_elsewhere(outcome, plan)
    if changed and not holds:
        notes.append("The answer is no better on the reporting runs: keep the start.")
    typer.echo(" ".join(notes))
    if csv is not None:
        csv.write_text(tried_table(outcome, plan).render("csv"), encoding="utf-8")
        say(f"candidates: {csv}")
    if write and changed and holds:
        write_answer(loaded, outcome)
        say(f"written: {config}")
    elif write:
        say(f"{config}: nothing better was found, the file stays as it is")

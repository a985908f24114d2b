"""A search over parameters: candidates on tuning runs, the answer on runs that had no part in it."""

import math
import time
from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple

from emt.averaging import OF_SINGLE_RUNS
from emt.config.errors import COMMAND_LINE, ConfigError, Problem
from emt.config.load import Loaded
from emt.metrics.base import Metric
from emt.registry import UnknownName
from emt.tuning.gradient import Descent, Point
from emt.tuning.parameters import Parameter, candidate, combinations, rounded
from emt.tuning.scoring import Batch, Score
from emt.tuning.trial import build_trial

FIRST_TUNING_RUN = 1_000_000_000
"""Tuning runs are numbered from here, beyond those of any experiment."""

SCORED_POINTS = 10
"""Points of a path, about, that are scored by the objective where the gradient follows another metric."""

Method = Literal["grid", "gradient"]
OnProgress = Callable[[str], None]


class Tried(NamedTuple):
    """One candidate of a search."""

    values: tuple[Any, ...]
    objective: float
    """On the tuning runs; NaN where only the followed metric was computed."""
    error: float
    failed: int
    """Runs that failed on it."""
    followed: float
    """The metric a gradient follows; the objective itself on a grid."""


class Comparison(NamedTuple):
    """One metric of the start and of the answer on the same runs."""

    metric: Metric
    runs: Literal["tuning", "reporting"]
    start: Score
    tuned: Score


class Outcome(NamedTuple):
    """What a search found."""

    label: str
    parameters: tuple[Parameter, ...]
    values: tuple[Any, ...]
    """The answer."""
    tried: tuple[Tried, ...]
    comparisons: tuple[Comparison, ...]
    seconds: float
    """Of the search, compilation included; without the scores on reporting runs."""
    tuning_runs: int
    reporting_runs: int


def holds_elsewhere(outcome: Outcome, plan: "Plan") -> bool:
    """Whether the answer is better than the start on the reporting runs too."""
    one = next(c for c in outcome.comparisons if c.runs == "reporting" and c.metric.name == plan.objective.name)
    gap, _ = one.tuned.above(one.start)
    return gap < 0.0 if plan.objective.better == "lower" else gap > 0.0


class Plan(NamedTuple):
    """How a search is made."""

    method: Method
    objective: Metric
    followed: Metric
    """The smooth metric a gradient follows; the objective itself on a grid."""
    tuning_runs: int
    reporting_runs: int
    steps: int
    rate: float


def plan_of(loaded: Loaded, method: Method, objective: str | None, **numbers: Any) -> Plan:
    """A plan, with the first metric of the experiment that has a better and a worse as the default objective.

    Raises:
        ConfigError: the objective is unknown, cannot be tuned for, or needs a truth that is not there.
    """
    try:
        named = [loaded.experiment.metric(n) for n in ([objective] if objective else loaded.experiment.metrics)]
    except UnknownName as error:
        raise refused(str(error)) from None
    usable = [metric for metric in named if metric.better != "neither" and metric.over_runs in OF_SINGLE_RUNS]
    if not usable:
        text = f"'{objective}' has no better or worse value of a single run" if objective else "no metric to tune for"
        raise refused(f"{text}; choose for instance gw, iou, position_rmse or nll")
    chosen = usable[0]
    has_truth = loaded.experiment.scenario.has_truth
    if not has_truth and loaded.experiment.reference == "truth" and chosen.name != "nll":
        raise refused("a recording without truth can only be tuned for nll, or against a reference filter")
    followed = loaded.experiment.metric(chosen.smooth) if method == "gradient" and chosen.smooth else chosen
    if not has_truth:
        numbers |= {"tuning_runs": 1, "reporting_runs": 1}
    return Plan(method, chosen, followed, **numbers)


def refused(message: str) -> ConfigError:
    """A problem with the objective."""
    return ConfigError([Problem(COMMAND_LINE, None, "--objective", message)])


def search(
    loaded: Loaded, label: str, parameters: Sequence[Parameter], plan: Plan, on_progress: OnProgress = lambda text: None
) -> Outcome:
    """Searches and compares the answer with the start.

    An answer may not fail in more runs than the start does.

    Raises:
        ConfigError: a candidate is not valid, or the objective does not exist for this filter.
    """
    began = time.perf_counter()
    first = FIRST_TUNING_RUN if loaded.experiment.scenario.has_truth else 0
    wanted = tuple(dict.fromkeys((plan.followed, plan.objective)))
    batch = Batch(loaded, label, wanted, first, plan.tuning_runs)
    for metric in wanted:
        if label in batch.program.without(metric):
            raise refused(f"filter '{label}' does not have the metric '{metric.name}'")
    start = tuple(p.start for p in parameters)
    path = descend if plan.method == "gradient" else sweep
    tried = path(loaded, parameters, batch, plan, on_progress)
    sound = [one for one in tried if math.isfinite(one.objective) and one.failed <= tried[0].failed]
    sign = -1.0 if plan.objective.better == "higher" else 1.0
    answer = min(sound, key=lambda one: sign * one.objective).values if sound else start
    # rounded before the last comparison, so that what is written is what was scored
    values = tuple(rounded(value) for value in answer) if answer != start else start
    seconds = time.perf_counter() - began
    both = [candidate(loaded, parameters, one) for one in (start, values)]
    trials = [build_trial(one.experiment, label) for one in both]
    comparisons = compared(batch, trials, "tuning")
    on_progress(f"scoring the answer on {plan.reporting_runs} other runs")
    shown = [m for m in map(loaded.experiment.metric, loaded.experiment.metrics) if m.over_runs in OF_SINGLE_RUNS]
    shown = [m for m in dict.fromkeys((*wanted, *shown)) if label not in batch.program.without(m)]
    comparisons += compared(Batch(loaded, label, shown, 0, plan.reporting_runs), trials, "reporting")
    return Outcome(
        label,
        tuple(parameters),
        values,
        tuple(tried),
        tuple(comparisons),
        seconds,
        plan.tuning_runs,
        plan.reporting_runs,
    )


def compared(batch: Batch, trials: list[Any], runs: Literal["tuning", "reporting"]) -> list[Comparison]:
    """Every metric of a batch for start and answer."""
    start, tuned = batch.score(trials)
    return [Comparison(m, runs, a, b) for m, a, b in zip(batch.metrics, start, tuned, strict=True)]


def sweep(loaded: Loaded, parameters: Sequence[Parameter], batch: Batch, plan: Plan, tell: OnProgress) -> list[Tried]:
    """The start and every point of the grid."""
    start = tuple(p.start for p in parameters)
    points = [start, *(point for point in combinations(parameters) if point != start)]
    trials = [build_trial(candidate(loaded, parameters, values).experiment, batch.label) for values in points]
    tell(f"compiling; {len(points)} candidates on {plan.tuning_runs} runs each")
    scores = batch.score(trials, lambda done: tell(f"{done}/{len(points)} candidates"))
    column = batch.metrics.index(plan.objective)
    rows = [score[column] for score in scores]
    return [
        Tried(values, one.value, one.error, one.failed, one.value) for values, one in zip(points, rows, strict=True)
    ]


def descend(loaded: Loaded, parameters: Sequence[Parameter], batch: Batch, plan: Plan, tell: OnProgress) -> list[Tried]:
    """The path of the gradient. Where it follows a stand-in, some of its points are scored by the objective itself:
    what is better for the one need not be for the other."""

    def told(step: int, point: Point) -> None:
        tell(f"step {step}/{plan.steps}: {plan.followed.name} {point.value:.6g}")

    tell(f"compiling; at most {plan.steps} steps on {plan.tuning_runs} runs")
    path = Descent(batch, loaded, parameters).run(plan.steps, plan.rate, told)
    values = [tuple(p.value(float(t)) for p, t in zip(parameters, point.theta, strict=True)) for point in path]
    values[0] = tuple(p.start for p in parameters)
    if plan.followed is plan.objective:
        return [
            Tried(v, point.value, math.nan, point.failed, point.value) for v, point in zip(values, path, strict=True)
        ]
    chosen = scored_steps(path, plan)
    tell(f"scoring {len(chosen)} of its points by {plan.objective.name}")
    trials = [build_trial(candidate(loaded, parameters, values[k]).experiment, batch.label) for k in chosen]
    column = batch.metrics.index(plan.objective)
    scores = {k: score[column] for k, score in zip(chosen, batch.score(trials), strict=True)}
    return [
        Tried(
            values[k],
            scores[k].value if k in scores else math.nan,
            scores[k].error if k in scores else math.nan,
            point.failed,
            point.value,
        )
        for k, point in enumerate(path)
    ]


def scored_steps(path: Sequence[Point], plan: Plan) -> list[int]:
    """Points of a path that are scored by the objective: some spread evenly over it, and the one that is best for the
    followed metric."""
    sign = -1.0 if plan.followed.better == "higher" else 1.0
    finite = [k for k, point in enumerate(path) if math.isfinite(point.value)]
    best = min(finite, key=lambda k: sign * path[k].value, default=0)
    return sorted({0, best, *finite[:: max(len(finite) // SCORED_POINTS, 1)]})

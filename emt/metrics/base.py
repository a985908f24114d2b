"""What a metric is, and the catalogue of all metrics by name."""

import re
from collections.abc import Callable
from typing import Literal, NamedTuple

from emt.averaging import OverRuns, OverTime
from emt.registry import UnknownName, suggest
from emt.types import POSITION, VELOCITY, Articulated, Estimate, Info, Point, Scalar, Truth


class Ending(NamedTuple):
    """How a run ends."""

    estimate: Estimate
    truth: Truth
    lost: Scalar
    """1 if the run counts as lost by the experiment's rule, else 0."""


def of_ellipse(estimate: Estimate) -> bool:
    """Whether a filter tracks an ellipse, or a shape that an ellipse stands for."""
    return not isinstance(estimate.shape, Articulated | Point)


def of_connected(estimate: Estimate) -> bool:
    """Whether a filter tracks a connected object."""
    return isinstance(estimate.shape, Articulated)


def with_position(estimate: Estimate) -> bool:
    """Whether what a filter tracks has a position."""
    return of_ellipse(estimate) or (isinstance(estimate.shape, Point) and bool(estimate.shape.places(POSITION)))


def with_velocity(estimate: Estimate) -> bool:
    """Whether what a filter tracks has a velocity."""
    return of_ellipse(estimate) or (isinstance(estimate.shape, Point) and bool(estimate.shape.places(VELOCITY)))


def with_state(estimate: Estimate) -> bool:
    """Whether all there is to know of what a filter tracks, or of its motion, is a Gaussian state."""
    return not isinstance(estimate.shape, Articulated)


Better = Literal["lower", "higher", "neither"]
PerStep = Callable[[Estimate, Truth, Info], Scalar]


class Metric(NamedTuple):
    """A number per step, and how it is averaged.

    See `averaging` for the rules. Steps count as often as `counts` says. `per_step` is a squared error where
    `over_time` is "rms", and a normalised square of `dof` degrees of freedom where `over_runs` is "band".
    """

    name: str
    unit: str
    """Unit of the value; `L` stands for the experiment's length unit."""
    better: Better
    definition: str
    per_step: PerStep
    over_time: OverTime = "mean"
    over_runs: OverRuns = "mean"
    smooth: str | None = None
    """Metric that `emt tune` follows in its place where it needs a gradient; by default itself."""
    applies_to: Callable[[Estimate], bool] = of_ellipse
    """Whether a filter that reports such estimates has the metric."""
    counts: Callable[[Estimate, Truth, Info], Scalar] | None = None
    """How often a step counts; by default each once."""
    at_end: Callable[[Ending], Scalar] | None = None
    unit_of: Callable[[Estimate], str] | None = None
    """Unit where it depends on what is estimated."""
    reads: Literal["effective_samples", "active_models"] | None = None
    """What filters must tell of their updates to have the metric."""
    needs_mode: bool = False
    """Whether the scenario must tell the true mode."""
    dof: Callable[[Estimate], int] | None = None
    """Degrees of freedom of a normalised square."""


def has(metric: Metric, estimate: Estimate, info: Info) -> bool:
    """Whether a filter that reports such estimates and diagnostics has a metric."""
    return metric.applies_to(estimate) and (metric.reads is None or getattr(info, metric.reads) is not None)


def anything(estimate: Estimate) -> bool:
    """For metrics that every filter has."""
    return True


def of_truth(function: Callable[[Estimate, Truth], Scalar]) -> PerStep:
    """`per_step` of a metric that needs no diagnostics of the update."""
    return lambda estimate, truth, info: function(estimate, truth)


METRICS: dict[str, Metric] = {}
"""All metrics with a fixed name, by the names used in configurations and tables."""
FAMILIES: dict[str, Callable[[str], Metric]] = {}
"""Metrics with a name inside their name, written NAME: `mode_NAME_probability`."""


def register(metric: Metric) -> Metric:
    """Adds a metric to the catalogue."""
    METRICS[metric.name] = metric
    return metric


def find_metric(name: str) -> Metric:
    """The metric of that name.

    Raises:
        UnknownName: there is none.
    """
    if name in METRICS:
        return METRICS[name]
    for pattern, make in FAMILIES.items():
        if found := re.fullmatch(pattern.replace("NAME", "([A-Za-z][A-Za-z0-9_]*)"), name):
            return make(found[1])
    known = sorted({*METRICS, *FAMILIES})
    raise UnknownName(name, known, suggest(name, known), "metric")


RmseRule = Literal["per_step", "pooled"]


def under_rule(metric: Metric, rule: RmseRule) -> Metric:
    """A root-mean-square metric with the average over steps that an experiment asks for; others as they are."""
    if rule == "per_step" or metric.over_runs != "rms":
        return metric
    what = metric.definition.split(" at a step")[0].removeprefix("root over runs of the ")
    return metric._replace(over_runs="pooled", definition=f"root over runs and steps of the {what}")

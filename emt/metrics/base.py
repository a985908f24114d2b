"""What a metric is, and the catalogue of all metrics by name."""

import re
from collections.abc import Callable
from typing import Literal, NamedTuple

from emt.registry import UnknownName, suggest
from emt.types import Articulated, Estimate, Info, Scalar, Truth


class Ending(NamedTuple):
    """How a run ends."""

    estimate: Estimate
    truth: Truth
    lost: Scalar
    """1 if the run counts as lost by the experiment's rule, else 0."""


def of_ellipse(estimate: Estimate) -> bool:
    """Whether a filter tracks an ellipse, or a shape that an ellipse stands for."""
    return not isinstance(estimate.shape, Articulated)


def of_connected(estimate: Estimate) -> bool:
    """Whether a filter tracks a connected object."""
    return isinstance(estimate.shape, Articulated)


class Metric(NamedTuple):
    """A number per step, and how it is averaged.

    The value of one run is the mean over its steps, each as often as `counts` says; or the root of the mean where
    `over_time` is "rms" (then `per_step` is a squared error); or what `at_end` makes of its end where it is "end".
    The value of an experiment follows from all runs by `over_runs`:

    - "mean": mean over runs of the value of a run;
    - "std": sample standard deviation over runs of the value of a run;
    - "rms": root over runs of the mean square at each step, then the mean over steps (`per_step` is a squared error).
    """

    name: str
    unit: str
    """Unit of the value; `L` stands for the experiment's length unit."""
    better: Literal["lower", "higher", "neither"]
    definition: str
    per_step: Callable[[Estimate, Truth, Info], Scalar]
    over_time: Literal["mean", "rms", "end"] = "mean"
    over_runs: Literal["mean", "std", "rms"] = "mean"
    smooth: str | None = None
    """Metric that `emt tune` follows in its place where it needs a gradient; by default itself."""
    applies_to: Callable[[Estimate], bool] = of_ellipse
    """Whether a filter that reports such estimates has the metric."""
    counts: Callable[[Estimate, Truth, Info], Scalar] | None = None
    """How often a step counts; by default each once."""
    at_end: Callable[[Ending], Scalar] | None = None
    unit_of: Callable[[Estimate], str] | None = None
    """Unit where it depends on what is estimated."""


def anything(estimate: Estimate) -> bool:
    """For metrics that every filter has."""
    return True


def of_truth(function: Callable[[Estimate, Truth], Scalar]) -> Callable[[Estimate, Truth, Info], Scalar]:
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

"""What a metric is, and the catalogue of all metrics by name."""

from collections.abc import Callable
from typing import Literal, NamedTuple

from emt.types import Estimate, Scalar, Truth


class Metric(NamedTuple):
    """A number per step, and how it is averaged.

    The value of one run is the mean over its steps, or the root of the mean where `over_time` is "rms" (then
    `per_step` is a squared error). The value of an experiment follows from all runs by `over_runs`:

    - "mean": mean over runs of the value of a run;
    - "std": sample standard deviation over runs of the value of a run;
    - "rms": root over runs of the mean square at each step, then the mean over steps (`per_step` is a squared error).
    """

    name: str
    unit: str
    """Unit of the value; `L` stands for the experiment's length unit."""
    better: Literal["lower", "higher", "neither"]
    definition: str
    per_step: Callable[[Estimate, Truth], Scalar]
    over_time: Literal["mean", "rms"] = "mean"
    over_runs: Literal["mean", "std", "rms"] = "mean"


METRICS: dict[str, Metric] = {}
"""All metrics, by the names used in configurations and tables."""


def register(metric: Metric) -> Metric:
    """Adds a metric to the catalogue."""
    METRICS[metric.name] = metric
    return metric

"""What stands between emt and another package: the scans it is given, and how its filter is called."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from emt.config.experiment import Experiment

ELLIPSE = ("x", "y", "vx", "vy", "semi_axis_1", "semi_axis_2", "orientation")
"""Columns reported of an ellipse (m, m/s, rad); the first semi-axis lies along the orientation."""
POINT = ("x", "y", "vx", "vy")
"""Columns reported of a point (m, m/s)."""

Call = Callable[[], np.ndarray]
"""Filters all runs from the start and returns the reports (run, step, column); each call computes them anew."""


class Scans(NamedTuple):
    """What the filters of some runs are given."""

    points: np.ndarray
    """Measurements (run, step, slot, m)."""
    mask: np.ndarray
    """True in the slots that hold one (run, step, slot)."""
    prior_means: np.ndarray | None = None
    """Mean of the prior of each run (run, n), for experiments in which it is drawn."""

    def real(self) -> list[list[np.ndarray]]:
        """The measurements of each run and step, in the order of their slots, without the empty ones."""
        runs = zip(self.points, self.mask, strict=True)
        return [[points[mask] for points, mask in zip(*run, strict=True)] for run in runs]


class Peer(NamedTuple):
    """A filter of another package that does the same as one of emt's."""

    package: str
    """Name of the distribution, as it is installed."""
    name: str
    """What the package calls the filter."""
    workload: str
    """Benchmark that it takes part in: `vb` for the experiment `benchmark/vb`."""
    prepare: Callable[[Experiment, Scans], Call]
    """Imports the package and brings experiment and scans into its form, which is not timed."""
    report: tuple[str, ...]
    """Columns of the reports."""
    exact: bool
    """Whether both compute the same but for rounding; otherwise they agree in their statistics only."""


class Steps(NamedTuple):
    """A filter of another package, step by step. Each function returns the state to go on from."""

    start: Callable[[int], Any]
    """Of the number of the run among those given."""
    predict: Callable[[Any], Any]
    update: Callable[[Any, Any], Any]
    """With a scan in the package's form."""
    report: Callable[[Any], Sequence[float] | np.ndarray]


def caller(experiment: Experiment, steps: Steps, scans: Sequence[Sequence[Any]], columns: Sequence[str]) -> Call:
    """The call that filters all runs.

    Args:
        scans: in the form the package takes, by run and step; None for a scan without measurements, which is left out.
    """
    predict_first = experiment.start_with == "predict"

    def call() -> np.ndarray:
        reports = np.empty((len(scans), len(scans[0]), len(columns)))
        for run, scans_of_run in enumerate(scans):
            state = steps.start(run)
            for k, scan in enumerate(scans_of_run):
                if k or predict_first:
                    state = steps.predict(state)
                if scan is not None:
                    state = steps.update(state, scan)
                reports[run, k] = steps.report(state)
        return reports

    return call

"""Errors of single runs, as papers report them that average over time before they average over runs; particles."""

from emt.averaging import OverRuns
from emt.metrics.base import Metric, anything, of_truth, register
from emt.metrics.kinematic import gap_squared
from emt.types import POSITION, Articulated, Estimate, Info, Point, Scalar, Truth


def error_squared(estimate: Estimate, truth: Truth) -> Scalar:
    """Squared error of the position, or of the whole state of an object without one."""
    if isinstance(estimate.shape, Point):
        places = estimate.shape.places(POSITION) or tuple(range(len(estimate.shape.names)))
        return gap_squared(estimate, truth, places)
    return gap_squared(estimate, truth, (0, 1))


def unit_of(estimate: Estimate) -> str:
    """That of a length if there is a position."""
    has_position = not isinstance(estimate.shape, Point) or estimate.shape.places(POSITION)
    return "L" if has_position else "1"


def squared_unit_of(estimate: Estimate) -> str:
    """The square of that unit."""
    return "L²" if unit_of(estimate) == "L" else "1"


RULES: tuple[tuple[str, str, OverRuns], ...] = (
    ("run_rmse", "mean over runs", "mean"),
    ("run_rmse_variance", "sample variance over runs", "var"),
)
for name, what, over_runs in RULES:
    register(
        Metric(
            name,
            "L",
            "lower",
            f"{what} of the root of the mean over steps of the squared error of the position, or of the state",
            of_truth(error_squared),
            "rms",
            over_runs,
            applies_to=lambda estimate: not isinstance(estimate.shape, Articulated),
            unit_of=unit_of if name == "run_rmse" else squared_unit_of,
        )
    )
register(
    Metric(
        "run_mse",
        "L²",
        "lower",
        "mean over runs and steps of the squared error of the position, or of the state",
        of_truth(error_squared),
        applies_to=lambda estimate: not isinstance(estimate.shape, Articulated),
        unit_of=squared_unit_of,
    )
)


def effective_samples(estimate: Estimate, truth: Truth, info: Info) -> Scalar:
    """As told by a particle filter."""
    assert info.effective_samples is not None
    return info.effective_samples


register(
    Metric(
        "effective_samples",
        "1",
        "higher",
        "effective sample size of a particle filter before resampling, as a fraction of its particles, mean over steps",
        effective_samples,
        applies_to=anything,
        reads="effective_samples",
    )
)

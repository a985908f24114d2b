"""What a filter itself says of its scans: likelihood and innovations."""

from emt.metrics.base import Metric, anything, register
from emt.types import Estimate, Point

register(
    Metric(
        "nll",
        "nat",
        "lower",
        "negative log-likelihood of a scan under the filter's own prediction, mean over steps; comparable only between "
        "settings of one filter, and not where the likelihood is of a pseudo-measurement (moment_ukf)",
        lambda estimate, truth, info: -info.log_likelihood,
        applies_to=anything,
    )
)


def measured(estimate: Estimate) -> int:
    """Numbers that an innovation has."""
    return estimate.shape.measured if isinstance(estimate.shape, Point) else 2


register(
    Metric(
        "nis",
        "1",
        "neither",
        "normalised innovation squared of the scan mean, or of the measurement of a point (2, or its count of numbers, "
        "if consistent; 0 where a scan is empty), mean over steps",
        lambda estimate, truth, info: info.nis,
        applies_to=anything,
        dof=measured,
    )
)
register(
    Metric(
        "nis_in_band",
        "1",
        "higher",
        "share of steps at which the mean over runs of the NIS lies inside its 95 % chi-square band",
        lambda estimate, truth, info: info.nis,
        over_runs="band",
        applies_to=anything,
        dof=measured,
    )
)

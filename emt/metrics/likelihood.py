"""What a filter itself says of its scans: likelihood and innovations."""

from emt.metrics.base import Metric, anything, register

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
register(
    Metric(
        "nis",
        "1",
        "neither",
        "normalised innovation squared of the scan mean (2 if consistent), mean over steps",
        lambda estimate, truth, info: info.nis,
        applies_to=anything,
    )
)

"""How probable a multiple-model filter holds a mode."""

from emt.metrics.base import FAMILIES, Metric


def mode_probability(mode: str) -> Metric:
    """Probability of one mode after the update."""
    return Metric(
        f"mode_{mode}_probability",
        "1",
        "neither",
        f"probability of mode '{mode}' after the update, mean over steps",
        lambda estimate, truth, info: (estimate.modes or {})[mode],
        applies_to=lambda estimate: mode in (estimate.modes or {}),
    )


FAMILIES["mode_NAME_probability"] = mode_probability

"""How probable a multiple-model filter holds its modes, whether it finds the true one, and how many it runs."""

import jax.numpy as jnp

from emt.metrics.base import FAMILIES, Better, Metric, PerStep, anything, register
from emt.types import Estimate, Info, Point, Scalar, Truth

IDENTIFIED = 0.5
"""A mode is identified if its probability exceeds this."""


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


def identification(estimate: Estimate, truth: Truth) -> tuple[Scalar, Scalar]:
    """Probability of the true mode, or of the model closest to it, and the largest probability of any."""
    modes = estimate.modes or {}
    assert isinstance(truth.shape, Point)
    assert truth.mode is not None
    zero = jnp.zeros((), estimate.mean.dtype)
    of_true = jnp.stack([modes.get(name, zero) for name in truth.shape.modes])[truth.mode]
    return of_true, jnp.stack(list(modes.values())).max()


def correct(estimate: Estimate, truth: Truth, info: Info) -> Scalar:
    """1 if the true mode is identified."""
    of_true, _ = identification(estimate, truth)
    return (of_true > IDENTIFIED).astype(of_true.dtype)


def incorrect(estimate: Estimate, truth: Truth, info: Info) -> Scalar:
    """1 if another mode is identified."""
    of_true, largest = identification(estimate, truth)
    return ((largest > IDENTIFIED) & ~(of_true > IDENTIFIED)).astype(of_true.dtype)


def neither(estimate: Estimate, truth: Truth, info: Info) -> Scalar:
    """1 if no mode is identified."""
    of_true, largest = identification(estimate, truth)
    return (~(largest > IDENTIFIED)).astype(of_true.dtype)


IDENTIFICATIONS: tuple[tuple[str, Better, str, PerStep], ...] = (
    ("cid", "higher", "correct mode identification: the model closest to the true mode has", correct),
    ("iid", "lower", "incorrect mode identification: another model than the closest to the true mode has", incorrect),
    ("nid", "neither", "no mode identification: no model has", neither),
)
for name, better, what, per_step in IDENTIFICATIONS:
    register(
        Metric(
            name,
            "1",
            better,
            f"share of steps with {what} a probability above 0.5; comparable only between filters of the same models",
            per_step,
            applies_to=lambda estimate: bool(estimate.modes),
            needs_mode=True,
        )
    )


def active_models(estimate: Estimate, truth: Truth, info: Info) -> Scalar:
    """Models that ran."""
    assert info.active_models is not None
    return info.active_models


register(
    Metric(
        "active_models",
        "1",
        "neither",
        "filters that a multiple-model filter runs in a step, mean over steps",
        active_models,
        applies_to=anything,
        reads="active_models",
    )
)
register(
    Metric(
        "most_active_models",
        "1",
        "neither",
        "the most filters that a multiple-model filter ran in a step of any run",
        active_models,
        "max",
        "max",
        applies_to=anything,
        reads="active_models",
    )
)

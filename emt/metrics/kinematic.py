"""Errors of position, velocity and orientation, and the consistency of the reported covariance."""

import jax.numpy as jnp

from emt.linalg import Mat2, Sym2, Vec2, cholesky, forward_solve
from emt.metrics.base import Metric, of_truth, register, with_position, with_state, with_velocity
from emt.shapes.ellipse import equivalent_ellipse, major_orientation
from emt.types import POSITION, VELOCITY, Articulated, Estimate, Point, Scalar, Truth


def gap_squared(estimate: Estimate, truth: Truth, places: tuple[int, ...]) -> Scalar:
    """Squared distance between some entries of estimated and true state."""
    gaps = [estimate.mean[k] - truth.state[k] for k in places]
    return sum((gap * gap for gap in gaps[1:]), gaps[0] * gaps[0])


def position_error_squared(estimate: Estimate, truth: Truth) -> Scalar:
    """|p̂ - p|² (m²)."""
    if isinstance(estimate.shape, Point):
        return gap_squared(estimate, truth, estimate.shape.places(POSITION))
    d = Vec2.of(estimate.mean[:2]) - Vec2.of(truth.position)
    return d.x * d.x + d.y * d.y


def velocity_error_squared(estimate: Estimate, truth: Truth) -> Scalar:
    """|v̂ - v|² (m²/s²)."""
    if isinstance(estimate.shape, Point):
        return gap_squared(estimate, truth, estimate.shape.places(VELOCITY))
    d = Vec2.of(estimate.mean[2:]) - Vec2.of(truth.velocity)
    return d.x * d.x + d.y * d.y


def orientation_error_squared_deg(estimate: Estimate, truth: Truth) -> Scalar:
    """Square of the raw difference of the orientations (deg²); nothing is wrapped."""
    assert not isinstance(estimate.shape, Articulated | Point)
    d = (180.0 / jnp.pi) * (estimate.shape.orientation - truth.ellipse.orientation)
    return d * d


def wrapped_orientation_error_squared_deg(estimate: Estimate, truth: Truth) -> Scalar:
    """Square of the angle between the major axes (deg²), at most 90 degrees."""
    _, ellipse = equivalent_ellipse(estimate.shape)
    d = major_orientation(ellipse) - major_orientation(truth.ellipse)
    half_turns = jnp.round(d / jnp.pi)
    d = (180.0 / jnp.pi) * (d - half_turns * jnp.pi)
    return d * d


def nees(estimate: Estimate, truth: Truth) -> Scalar:
    """Normalised estimation error squared: eᵀ P⁻¹ e, of mean n for a consistent filter of n numbers.

    Of (x, y, vx, vy) by blocks: e_pᵀ C⁻¹ e_p + (e_v - G e_p)ᵀ S⁻¹ (e_v - G e_p), with G the regression of velocity on
    position.
    """
    if isinstance(estimate.shape, Point):
        white = forward_solve(cholesky(estimate.cov), estimate.mean - truth.state)
        return (white * white).sum()
    position_error = Vec2.of(estimate.mean[:2]) - Vec2.of(truth.position)
    velocity_error = Vec2.of(estimate.mean[2:]) - Vec2.of(truth.velocity)
    cov = Sym2.of(estimate.cov[:2, :2])
    inverse = cov.inverse()
    gain = Mat2.of(estimate.cov[2:, :2]) @ inverse
    rest = Sym2.of(estimate.cov[2:, 2:]) - gain.congruence(cov)
    return inverse.quadratic(position_error) + rest.inverse().quadratic(velocity_error - gain @ position_error)


register(
    Metric(
        "position_rmse",
        "L",
        "lower",
        "root over runs of the mean squared position error at a step, mean over steps",
        of_truth(position_error_squared),
        "rms",
        "rms",
        applies_to=with_position,
    )
)
register(
    Metric(
        "velocity_rmse",
        "L/s",
        "lower",
        "root over runs of the mean squared velocity error at a step, mean over steps",
        of_truth(velocity_error_squared),
        "rms",
        "rms",
        applies_to=with_velocity,
    )
)
register(
    Metric(
        "orientation_rmse_deg",
        "deg",
        "lower",
        "root of the mean over steps of the squared raw difference of orientations, mean over runs; not wrapped",
        of_truth(orientation_error_squared_deg),
        "rms",
    )
)
register(
    Metric(
        "orientation_rmse_deg_std",
        "deg",
        "lower",
        "standard deviation over runs of orientation_rmse_deg",
        of_truth(orientation_error_squared_deg),
        "rms",
        "std",
    )
)
register(
    Metric(
        "orientation_rmse_wrapped_deg",
        "deg",
        "lower",
        "as orientation_rmse_deg, with the angle between the major axes, wrapped to 90 degrees",
        of_truth(wrapped_orientation_error_squared_deg),
        "rms",
    )
)
register(
    Metric(
        "nees",
        "1",
        "neither",
        "normalised estimation error squared of position and velocity (4 if consistent), or of the state of a point "
        "(the number of its entries), mean over steps",
        of_truth(nees),
        applies_to=with_state,
        dof=lambda estimate: estimate.mean.shape[-1],
    )
)
register(
    Metric(
        "nees_in_band",
        "1",
        "higher",
        "share of steps at which the mean over runs of the NEES lies inside its 95 % chi-square band",
        of_truth(nees),
        over_runs="band",
        applies_to=with_state,
        dof=lambda estimate: estimate.mean.shape[-1],
    )
)
for what, of, applies, unit in (
    ("position", position_error_squared, with_position, "L"),
    ("velocity", velocity_error_squared, with_velocity, "L/s"),
):
    register(
        Metric(
            f"peak_{what}_rmse",
            unit,
            "lower",
            f"largest over steps of the root over runs of the mean squared {what} error",
            of_truth(of),
            "rms",
            "peak",
            applies_to=applies,
        )
    )
    register(
        Metric(
            f"worst_{what}_rmse",
            unit,
            "lower",
            f"largest over runs of the root of the mean over steps of the squared {what} error",
            of_truth(of),
            "rms",
            "max",
            applies_to=applies,
        )
    )

"""Errors of position, velocity and orientation, and the consistency of the reported covariance."""

import jax.numpy as jnp

from emt.linalg import Mat2, Sym2, Vec2
from emt.metrics.base import Metric, of_truth, register
from emt.shapes.ellipse import equivalent_ellipse, major_orientation
from emt.types import Articulated, Estimate, Scalar, Truth


def position_error_squared(estimate: Estimate, truth: Truth) -> Scalar:
    """|p̂ - p|² (m²)."""
    d = Vec2.of(estimate.mean[:2]) - Vec2.of(truth.position)
    return d.x * d.x + d.y * d.y


def velocity_error_squared(estimate: Estimate, truth: Truth) -> Scalar:
    """|v̂ - v|² (m²/s²)."""
    d = Vec2.of(estimate.mean[2:]) - Vec2.of(truth.velocity)
    return d.x * d.x + d.y * d.y


def orientation_error_squared_deg(estimate: Estimate, truth: Truth) -> Scalar:
    """Square of the raw difference of the orientations (deg²); nothing is wrapped."""
    assert not isinstance(estimate.shape, Articulated)
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
    """Normalised estimation error squared of (x, y, vx, vy): eᵀ P⁻¹ e, of mean 4 for a consistent filter.

    By blocks: e_pᵀ C⁻¹ e_p + (e_v - G e_p)ᵀ S⁻¹ (e_v - G e_p), G the regression of velocity on position.
    """
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
        "normalised estimation error squared of position and velocity (4 if consistent), mean over steps",
        of_truth(nees),
    )
)

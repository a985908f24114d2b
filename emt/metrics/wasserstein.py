"""Gaussian-Wasserstein distance between ellipses, and its two terms."""

import jax.numpy as jnp

from emt.linalg import Sym2
from emt.metrics.base import Metric, of_truth, register
from emt.shapes.ellipse import equivalent_ellipse, extent_matrix
from emt.types import Estimate, Scalar, Truth


def extent_distance_squared(a: Sym2, b: Sym2) -> Scalar:
    """tr(A + B - 2 (A^½ B A^½)^½) for extents of squared semi-axes (m²).

    In the plane tr (A^½ B A^½)^½ = √(tr(AB) + 2 √(det A det B)). Multiplied by the conjugate sum, the difference
    becomes (|dev A - dev B|² + 4 (√det A - √det B)²) / (tr A + tr B + 2 tr (A^½ B A^½)^½) with
    dev A = (A11 - A22, 2 A12): no cancellation, and exactly zero for equal extents.
    """
    root_det_a, root_det_b = jnp.sqrt(jnp.maximum(a.det(), 0.0)), jnp.sqrt(jnp.maximum(b.det(), 0.0))
    cross = jnp.sqrt(jnp.maximum(a.inner(b) + 2.0 * root_det_a * root_det_b, 0.0))
    d1, d2, d3 = (a.xx - a.yy) - (b.xx - b.yy), 2.0 * (a.xy - b.xy), 2.0 * (root_det_a - root_det_b)
    return (d1 * d1 + d2 * d2 + d3 * d3) / (a.trace() + b.trace() + 2.0 * cross)


def center_distance_squared(estimate: Estimate, truth: Truth) -> Scalar:
    """Squared distance between the centres (m²)."""
    offset, _ = equivalent_ellipse(estimate.shape)
    d = estimate.mean[:2] + offset - truth.position
    return d[0] * d[0] + d[1] * d[1]


def shape_distance_squared(estimate: Estimate, truth: Truth) -> Scalar:
    """Extent term of the squared distance (m²)."""
    _, ellipse = equivalent_ellipse(estimate.shape)
    return extent_distance_squared(extent_matrix(truth.ellipse), extent_matrix(ellipse))


def gaussian_wasserstein_squared(estimate: Estimate, truth: Truth) -> Scalar:
    """|c - ĉ|² + tr(X + X̂ - 2 (X^½ X̂ X^½)^½) with X of squared semi-axes (m²).

    Source: Givens and Shortt 1984; as a metric for ellipses Yang, Baum and Granström 2016.
    """
    return center_distance_squared(estimate, truth) + shape_distance_squared(estimate, truth)


def gaussian_wasserstein(estimate: Estimate, truth: Truth) -> Scalar:
    """Root of the squared distance (m)."""
    return jnp.sqrt(gaussian_wasserstein_squared(estimate, truth))


register(
    Metric("gw_center_sq", "L²", "lower", "squared centre distance, mean over steps", of_truth(center_distance_squared))
)
register(
    Metric(
        "gw_extent_sq",
        "L²",
        "lower",
        "extent term of the squared Gaussian-Wasserstein distance (semi-axes squared), mean over steps",
        of_truth(shape_distance_squared),
    )
)
register(
    Metric(
        "gw", "L", "lower", "Gaussian-Wasserstein distance, mean over steps of the root", of_truth(gaussian_wasserstein)
    )
)
register(
    Metric(
        "gw_std", "L", "lower", "standard deviation over runs of gw", of_truth(gaussian_wasserstein), over_runs="std"
    )
)

"""A smooth stand-in for the intersection over union, for tuning by gradients."""

import jax.numpy as jnp

from emt.linalg import Vec2
from emt.metrics.base import Metric, of_truth, register
from emt.shapes.ellipse import equivalent_ellipse, extent_matrix
from emt.types import Estimate, Scalar, Truth


def soft_iou(estimate: Estimate, truth: Truth) -> Scalar:
    """∫fg / (∫f² + ∫g² - ∫fg) for Gaussian bumps f, g of height 1 in place of the indicators of the ellipses.

    A bump has the covariance Σ = X/4 of a uniform ellipse with squared semi-axes X. Then ∫f² = π √|Σ| and ∫fg =
    2π √(|Σ||Σ'| / |Σ + Σ'|) exp(-½ dᵀ (Σ + Σ')⁻¹ d); with indicators the same ratio is the IoU (Tanimoto 1958). It is
    1 for equal ellipses only, falls to 0 as they part, and is smooth everywhere, unlike the IoU.
    """
    offset, ellipse = equivalent_ellipse(estimate.shape)
    ours, true = 0.25 * extent_matrix(ellipse), 0.25 * extent_matrix(truth.ellipse)
    total, d = ours + true, Vec2.of(estimate.mean[:2] + offset - truth.position)
    det_ours, det_true = ours.det(), true.det()
    both = 2.0 * jnp.sqrt(det_ours * det_true / total.det()) * jnp.exp(-0.5 * total.inverse().quadratic(d))
    return both / (jnp.sqrt(det_ours) + jnp.sqrt(det_true) - both)


register(
    Metric(
        "soft_iou",
        "1",
        "higher",
        "intersection over union of Gaussian bumps in place of the ellipses: smooth, for tuning; mean over steps",
        of_truth(soft_iou),
    )
)

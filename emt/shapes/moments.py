"""Normalised centred image moments of a filled ellipse.

For the extent X = L diag(l1², l2²) Lᵀ the moments are N = [[n20, n11], [n11, n02]] = X/4, so conversions need no angle.

Source: Yao, Saltus and Dani 2020, eqs. 5-9, in the form without its 0/0 at n11 = 0.
"""

import jax.numpy as jnp

from emt.linalg import Sym2
from emt.types import Ellipse, Scalar


def moments_of(ellipse: Ellipse) -> Sym2:
    """N of an ellipse (m²)."""
    return 0.25 * Sym2.ellipse(ellipse.semi_axes[0], ellipse.semi_axes[1], ellipse.orientation)


def ellipse_of(moments: Sym2) -> Ellipse:
    """The ellipse with these moments, the major axis first; a negative eigenvalue gives NaN."""
    larger, smaller, direction = moments.eigen()
    return Ellipse(2.0 * jnp.sqrt(jnp.stack([larger, smaller])), direction)


def project(moments: Sym2, floor: Scalar, ratio: Scalar) -> Sym2:
    """Nearest moments with the same axes whose larger eigenvalue is at least `floor` (m²) and whose smaller one is at
    least `ratio` times the larger; moments that comply are returned to the last bit."""
    mean, half = 0.5 * moments.trace(), 0.5 * (moments.xx - moments.yy)
    squared = half * half + moments.xy * moments.xy
    round_ = squared <= 0.0
    radius = jnp.where(round_, 0.0, jnp.sqrt(jnp.where(round_, 1.0, squared)))  # differentiable for circles too
    larger, smaller = jnp.maximum(mean + radius, floor), mean - radius
    smaller = jnp.where(round_, larger, jnp.maximum(smaller, ratio * larger))  # a circle has no axis to be thin along
    acts = (larger != mean + radius) | (smaller != mean - radius)
    shrink = 0.5 * (larger - smaller) / jnp.where(round_, 1.0, radius)
    centre = 0.5 * (larger + smaller)
    return Sym2(
        jnp.where(acts, centre + shrink * half, moments.xx),
        jnp.where(acts, shrink * moments.xy, moments.xy),
        jnp.where(acts, centre - shrink * half, moments.yy),
    )

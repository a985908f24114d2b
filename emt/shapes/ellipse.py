"""Ellipses: extent matrices, axes in order, and the ellipse that stands for another shape."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from emt.linalg import Mat2, Sym2, Vec2
from emt.types import Articulated, Ellipse, Point, Scalar, StarConvex


def extent_matrix(ellipse: Ellipse) -> Sym2:
    """L diag(l1², l2²) Lᵀ (m²)."""
    return Sym2.ellipse(ellipse.semi_axes[0], ellipse.semi_axes[1], ellipse.orientation)


def major_orientation(ellipse: Ellipse) -> Scalar:
    """Direction of the longer axis (rad), defined up to half a turn."""
    swapped = ellipse.semi_axes[1] > ellipse.semi_axes[0]
    return ellipse.orientation + jnp.where(swapped, 0.5 * jnp.pi, 0.0)


def equivalent_ellipse(shape: Ellipse | StarConvex | Articulated | Point) -> tuple[Float[Array, "2"], Ellipse]:
    """The ellipse with the area centroid and second moments of the shape.

    Returns:
        offset of its centre from the object's position (m), and the ellipse.

    Raises:
        TypeError: no ellipse stands for a connected object or for a point.

    For an outline r(φ): area ½∮r², centroid ⅓∮r³u / area, second moment ¼∮r⁴uuᵀ / area; an ellipse of squared
    semi-axes l² has second moment l²/4.
    """
    if isinstance(shape, Ellipse):
        return jnp.zeros_like(shape.semi_axes), shape
    if isinstance(shape, Articulated | Point):
        raise TypeError("no ellipse stands for a connected object or for a point")
    n = shape.radii.shape[0]
    angles = jnp.arange(n, dtype=shape.radii.dtype) * (2.0 * jnp.pi / n)
    step = 2.0 * jnp.pi / n
    r, c, s = shape.radii, jnp.cos(angles), jnp.sin(angles)
    area = 0.5 * step * (r**2).sum()
    area = jnp.where(area > 0.0, area, 1.0)
    centroid = Vec2((r**3 * c).sum(), (r**3 * s).sum())
    centroid = (step / (3.0 * area)) * centroid
    moment = (0.25 * step / area) * Sym2((r**4 * c * c).sum(), (r**4 * c * s).sum(), (r**4 * s * s).sum())
    larger, smaller, direction = (moment - centroid.outer()).eigen()
    axes = 2.0 * jnp.sqrt(jnp.maximum(jnp.stack([larger, smaller]), 0.0))
    offset = Mat2.rotation(shape.orientation) @ centroid
    return offset.array(), Ellipse(axes, shape.orientation + direction)

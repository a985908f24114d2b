"""Connected objects: rigid links whose placement follows from shared parameters along a kinematic chain."""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from emt.linalg import Vec2
from emt.trigonometry import sincos
from emt.types import Scalar


class Link(NamedTuple):
    """One straight link, by numbers of parameters; fixed when a program is compiled."""

    parent: int | None
    """Link at whose end this one starts, earlier in the order; None for the object's origin."""
    angle: tuple[tuple[int, float], ...]
    """(parameter, factor) of the angle against the parent, or against the x axis."""
    offset: float
    """Added to that angle (rad)."""
    length: int | float
    """Parameter (an int) or the length itself (a float)."""


class Segment(NamedTuple):
    """A link in its place."""

    start: Vec2
    direction: Scalar
    """Angle against the x axis (rad)."""
    length: Scalar
    cos: Scalar
    """Of the direction."""
    sin: Scalar

    def at(self, share: Scalar) -> Vec2:
        """The point at this share of the length from the start."""
        reach = share * self.length
        return Vec2(self.start.x + reach * self.cos, self.start.y + reach * self.sin)

    def local(self, point: Vec2) -> Vec2:
        """A point in the frame of the link: along it, and to its left."""
        x, y = point.x - self.start.x, point.y - self.start.y
        return Vec2(self.cos * x + self.sin * y, self.cos * y - self.sin * x)


class Heading(NamedTuple):
    """Where a link points."""

    direction: Scalar
    """Angle against the x axis (rad)."""
    cos: Scalar
    sin: Scalar


def headings(links: Sequence[Link], parameters: Float[Array, "n"]) -> list[Heading]:
    """Where every link points, for one vector of parameters."""
    found: list[Heading] = []
    for link in links:
        turned = sum((factor * parameters[k] for k, factor in link.angle), jnp.asarray(link.offset, parameters.dtype))
        direction = turned if link.parent is None else found[link.parent].direction + turned
        sin, cos = sincos(direction)
        found.append(Heading(direction, cos, sin))
    return found


def place(
    links: Sequence[Link], parameters: Float[Array, "n"], origin: Vec2, known: Sequence[Heading] | None = None
) -> list[Segment]:
    """Every link in its place, for one vector of parameters.

    Args:
        known: where the links point, where that is known already.
    """
    placed: list[Segment] = []
    for link, heading in zip(links, headings(links, parameters) if known is None else known, strict=True):
        length = parameters[link.length] if isinstance(link.length, int) else jnp.asarray(link.length, parameters.dtype)
        start = origin if link.parent is None else placed[link.parent].at(jnp.ones_like(length))
        placed.append(Segment(start, heading.direction, length, heading.cos, heading.sin))
    return placed


def segment_residual(segment: Segment, share: Scalar, point: Vec2) -> Vec2:
    """h = [l s; 0] - R(β)ᵀ (y - p): zero where the point lies at that share of the segment, in its own frame (m).

    The map from point to residual is a rigid motion, so densities of h are densities per area.
    """
    local = segment.local(point)
    return Vec2(segment.length * share - local.x, -local.y)


def disc_residual_moments(
    radius: Scalar, center: Vec2, noise_variance: Scalar, point: Vec2, cross_term: bool = True
) -> tuple[Scalar, Scalar]:
    """Mean and variance of h = |y - b|² - r² s² - v̄ for a point of a filled disc under isotropic noise (m², m⁴).

    With s² uniform on (0, 1), v̄ = |v|² + 2 z·v about the source z: mean r²/2 + 2σ², variance r⁴/12 + 4σ⁴ + 2σ² r². The
    cross term 2 z·v, with the last of these, is missing in Zea, Faion and Hanebeck 2014.
    """
    d = point - center
    mean = d.x * d.x + d.y * d.y - 0.5 * radius**2 - 2.0 * noise_variance
    variance = radius**4 / 12.0 + 4.0 * noise_variance**2
    return mean, variance + 2.0 * noise_variance * radius**2 if cross_term else variance

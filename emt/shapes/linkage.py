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


def angle_of(link: Link, parameters: Float[Array, "n"]) -> Scalar:
    """The angle of a link against its parent, or against the x axis (rad)."""
    return sum((factor * parameters[k] for k, factor in link.angle), jnp.asarray(link.offset, parameters.dtype))


def length_of(link: Link, parameters: Float[Array, "n"]) -> Scalar:
    """The length of a link (m)."""
    return parameters[link.length] if isinstance(link.length, int) else jnp.asarray(link.length, parameters.dtype)


def place(links: Sequence[Link], parameters: Float[Array, "n"], origin: Vec2) -> list[Segment]:
    """Every link in its place, for one vector of parameters."""
    placed: list[Segment] = []
    for link in links:
        parent = None if link.parent is None else placed[link.parent]
        turned, length = angle_of(link, parameters), length_of(link, parameters)
        start = origin if parent is None else parent.at(jnp.ones_like(length))
        direction = turned if parent is None else parent.direction + turned
        sin, cos = sincos(direction)
        placed.append(Segment(start, direction, length, cos, sin))
    return placed


class Turn(NamedTuple):
    """How far a link is turned against its parent."""

    cos: Scalar
    sin: Scalar


def turns_of(links: Sequence[Link], parameters: Float[Array, "n"]) -> list[Turn]:
    """Every link's turn against its parent, or against the x axis; links that turn oppositely share sine and cosine."""
    known: dict[tuple, Turn] = {}
    found: list[Turn] = []
    for link in links:
        opposite = known.get((tuple((k, -factor) for k, factor in link.angle), -link.offset))
        if opposite is None:
            sin, cos = sincos(angle_of(link, parameters))
            found.append(Turn(cos, sin))
        else:
            found.append(Turn(opposite.cos, -opposite.sin))
        known[link.angle, link.offset] = found[-1]
    return found


def in_frames(
    links: Sequence[Link], turns: Sequence[Turn], parameters: Float[Array, "n"], origin: Vec2, point: Vec2
) -> list[Vec2]:
    """A point in the frame of every link, along it and to its left, as `Segment.local` has it: from frame to frame, one
    turn and one length at a time."""
    found: list[Vec2] = []
    for link, turn in zip(links, turns, strict=True):
        gap = point - origin
        if link.parent is not None:
            before = found[link.parent]
            gap = Vec2(before.x - length_of(links[link.parent], parameters), before.y)
        found.append(Vec2(turn.cos * gap.x + turn.sin * gap.y, turn.cos * gap.y - turn.sin * gap.x))
    return found


def segment_residual(length: Scalar, share: Scalar, local: Vec2) -> Vec2:
    """h = [l s; 0] - R(β)ᵀ (y - p): zero where the point lies at that share of the segment, in its own frame (m).

    The map from point to residual is a rigid motion, so densities of h are densities per area.

    Args:
        local: the point y in the frame of the segment, R(β)ᵀ (y - p).
    """
    return Vec2(length * share - local.x, -local.y)


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

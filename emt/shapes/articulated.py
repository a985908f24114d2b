"""A connected object in its place: where its points are, how far points are from it, and which angles are ambiguous."""

from collections.abc import Sequence
from fractions import Fraction
from math import gcd, lcm, pi
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from emt.linalg import Mat2, Vec2
from emt.shapes.connected import Body, Connected
from emt.shapes.linkage import Segment, place
from emt.types import Articulated, Scalar


class Placed(NamedTuple):
    """A body in its place."""

    center: Vec2
    direction: Scalar
    """Of its first axis, against the x axis (rad)."""
    semi_axes: Vec2


def as_vec(pair: tuple[float, float], like: Array) -> Vec2:
    """A pair of plain numbers in the precision of an array."""
    return Vec2(jnp.asarray(pair[0], like.dtype), jnp.asarray(pair[1], like.dtype))


def links_of(plan: Connected, parameters: Float[Array, "n"]) -> list[Segment]:
    """Every link of an object in its place."""
    return place(plan.links, parameters, as_vec(plan.origin, parameters))


def semi_axes_of(body: Body, parameters: Float[Array, "n"]) -> Vec2:
    """Both semi-axes of a body (m)."""
    return Vec2(*(parameters[x] if isinstance(x, int) else jnp.asarray(x, parameters.dtype) for x in body.semi_axes))


def body_at(body: Body, links: Sequence[Segment], parameters: Float[Array, "n"]) -> Placed:
    """A body on the placed links of its object."""
    return Placed(links[body.link].start, links[body.link].direction, semi_axes_of(body, parameters))


def segments_of(shape: Articulated) -> list[Segment]:
    """The segments of an object, in the order of its components."""
    placed = links_of(shape.plan, shape.parameters)
    return [placed[link] for _, link in shape.plan.segments]


def bodies_of(shape: Articulated) -> list[Placed]:
    """The ellipses and rectangles of an object, in the order of its components."""
    placed = links_of(shape.plan, shape.parameters)
    return [body_at(body, placed, shape.parameters) for body in shape.plan.bodies]


def mirrored_parameters(plan: Connected) -> tuple[int, ...]:
    """Angles whose change of sign leaves the object as it is, with two of its components swapped."""

    def parts(flipped: int | None):
        found = []
        for k, link in enumerate(plan.links):
            angle = tuple((p, -f if p == flipped else f) for p, f in link.angle)
            kind = next((body._replace(component=0, link=0) for body in plan.bodies if body.link == k), None)
            found.append((link.parent, angle, link.offset, link.length, kind))
        return sorted(found, key=str)

    same = parts(None)
    turning = {p for link in plan.links for p, _ in link.angle}
    return tuple(angle for angle in plan.angles if angle in turning and parts(angle) == same)


def angle_period(plan: Connected, parameter: int) -> float:
    """The smallest turn of an angle that leaves every component in its place (rad)."""
    factors = [Fraction(f).limit_denominator(1000) for link in plan.links for p, f in link.angle if p == parameter]
    denominator = lcm(*(f.denominator for f in factors))
    common = gcd(*(abs(f.numerator) * (denominator // f.denominator) for f in factors))
    return 2.0 * pi * denominator / common


def sources(plan: Connected, parameters: Float[Array, "n"], u: Float[Array, "3"]) -> Float[Array, "c 2"]:
    """A point of every component, from three numbers uniform on (0, 1); surfaces are covered evenly."""
    links, found = links_of(plan, parameters), {}
    for component, link in plan.segments:
        found[component] = links[link].at(u[0])
    radius, turn = jnp.sqrt(u[0]), 2.0 * pi * u[1]
    on_disc = Vec2(radius * jnp.cos(turn), radius * jnp.sin(turn))
    for component, reach, center in plan.discs:
        at = as_vec(center, parameters)
        found[component] = Vec2(at.x + reach * on_disc.x, at.y + reach * on_disc.y)
    for body in plan.bodies:
        placed = body_at(body, links, parameters)
        local = _unit_point(body, placed.semi_axes, u, on_disc)
        turned = Mat2.rotation(placed.direction) @ Vec2(placed.semi_axes.x * local.x, placed.semi_axes.y * local.y)
        found[body.component] = placed.center + turned
    return jnp.stack([found[k].array() for k in range(len(plan.components))])


def _unit_point(body: Body, axes: Vec2, u: Float[Array, "3"], on_disc: Vec2) -> Vec2:
    """A point of the unit disc, circle, square or its outline."""
    if not body.is_rectangle:
        return on_disc if body.is_filled else Vec2(jnp.cos(2.0 * pi * u[1]), jnp.sin(2.0 * pi * u[1]))
    x, y = 2.0 * u[0] - 1.0, 2.0 * u[1] - 1.0
    if body.is_filled:
        return Vec2(x, y)
    along_x = u[2] * (axes.x + axes.y) < axes.x  # sides along the first axis are as long as that axis
    side = jnp.where(y > 0.0, 1.0, -1.0)
    return Vec2(jnp.where(along_x, x, side), jnp.where(along_x, side, x))


def distances(
    plan: Connected,
    parameters: Float[Array, "n"],
    point: Vec2,
    outlines: bool = False,
    links: Sequence[Segment] | None = None,
) -> Float[Array, "c"]:
    """Euclidean distance of a point to every component (m); zero on a surface, unless outlines are asked for.

    The distance to an ellipse is taken along the ray from its centre. With outlines, discs are infinitely far away.

    Args:
        links: those of the object in their places, where they are known already.
    """
    links, found = links_of(plan, parameters) if links is None else links, {}
    for component, link in plan.segments:
        segment = links[link]
        local = segment.local(point)
        beyond = local.x - jnp.clip(local.x, 0.0, jnp.maximum(segment.length, 0.0))
        found[component] = jnp.hypot(beyond, local.y)
    for component, radius, center in plan.discs:
        gap = point - as_vec(center, parameters)
        reach = jnp.maximum(jnp.hypot(gap.x, gap.y) - radius, 0.0)
        found[component] = jnp.full_like(reach, jnp.inf) if outlines else reach
    for body in plan.bodies:
        placed = body_at(body, links, parameters)
        local = Mat2.rotation(placed.direction).T @ (point - placed.center)
        if body.is_rectangle:
            x, y = jnp.abs(local.x) - placed.semi_axes.x, jnp.abs(local.y) - placed.semi_axes.y
            outside = jnp.hypot(jnp.maximum(x, 0.0), jnp.maximum(y, 0.0))
            inside = jnp.minimum(jnp.maximum(x, y), 0.0)
        else:  # along the ray from the centre
            reach = jnp.hypot(local.x, local.y)
            level = jnp.hypot(local.x / placed.semi_axes.x, local.y / placed.semi_axes.y)
            gap = reach - reach / jnp.maximum(level, jnp.finfo(reach.dtype).tiny)
            outside, inside = jnp.maximum(gap, 0.0), jnp.minimum(gap, 0.0)
        found[body.component] = outside if body.is_filled and not outlines else outside - inside
    return jnp.stack([found[k] for k in range(len(plan.components))])


SHARES = (0.0625, 0.1875, 0.3125, 0.4375, 0.5625, 0.6875, 0.8125, 0.9375)
"""Shares of a segment, or of the outline of a body, at which it stands for itself."""


def boundary_points(
    plan: Connected, parameters: Float[Array, "n"], links: Sequence[Segment] | None = None
) -> tuple[Float[Array, "k 2"], Float[Array, "k"]]:
    """Points along segments and the outlines of bodies, and the length that each stands for (m).

    Args:
        links: those of the object in their places, where they are known already.
    """
    links, points, weights = links_of(plan, parameters) if links is None else links, [], []
    shares, count = jnp.asarray(SHARES, parameters.dtype), len(SHARES)
    for _, link in plan.segments:
        segment, reach = links[link], shares * links[link].length
        points.append(jnp.stack([segment.start.x + reach * segment.cos, segment.start.y + reach * segment.sin], axis=1))
        weights.append(jnp.broadcast_to(jnp.abs(segment.length) / count, (count,)))
    for body in plan.bodies:
        placed = body_at(body, links, parameters)
        a, b = jnp.abs(placed.semi_axes.x), jnp.abs(placed.semi_axes.y)
        around = 4.0 * (a + b) if body.is_rectangle else pi * jnp.sqrt(2.0 * (a * a + b * b))
        x, y = jnp.cos(2.0 * pi * shares), jnp.sin(2.0 * pi * shares)
        if body.is_rectangle:
            larger = jnp.maximum(jnp.abs(x), jnp.abs(y))
            x, y = x / larger, y / larger
        turned = Mat2.rotation(placed.direction) @ Vec2(placed.semi_axes.x * x, placed.semi_axes.y * y)
        points.append(jnp.stack([placed.center.x + turned.x, placed.center.y + turned.y], axis=1))
        weights.append(jnp.broadcast_to(around / count, (count,)))
    return jnp.concatenate(points), jnp.concatenate(weights)

"""What is kept of shapes for tables and figures, by name."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from emt.shapes.articulated import bodies_of, segments_of
from emt.shapes.ellipse import equivalent_ellipse
from emt.types import Articulated, Estimate, Point, StarConvex, Truth

Fields = dict[str, Float[Array, "..."]]


def connected_fields(shape: Articulated) -> Fields:
    """Both ends `starts`, `ends` of every segment (segment, 2), and `bodies` (body, 6), in metres.

    A body is x, y, both semi-axes, direction (rad), and whether it is a rectangle.
    """
    fields, zero = {}, jnp.zeros((), shape.parameters.dtype)
    if segments := segments_of(shape):
        fields["starts"] = jnp.stack([segment.start.array() for segment in segments])
        fields["ends"] = jnp.stack([segment.at(jnp.ones_like(segment.length)).array() for segment in segments])
    bodies = [
        jnp.stack([b.center.x, b.center.y, b.semi_axes.x, b.semi_axes.y, b.direction, zero + float(body.is_rectangle)])
        for b, body in zip(bodies_of(shape), shape.plan.bodies, strict=True)
    ]
    return fields | ({"bodies": jnp.stack(bodies)} if bodies else {})


def disc_fields(shape: Articulated) -> Fields:
    """`discs` (disc, 3) of a connected object: x, y and radius (m)."""
    discs = [[*center, radius] for _, radius, center in shape.plan.discs]
    return {"discs": jnp.asarray(discs, shape.parameters.dtype)} if discs else {}


def estimate_fields(estimate: Estimate, full: bool) -> Fields:
    """The shape of one estimate.

    Of an ellipse or a star-convex shape: `center` (2,), `semi_axes` (2,) and `orientation` of the shape or of the
    ellipse that stands for it, and `radii` if `full`. Of a connected object: see `connected_fields`. Of a point:
    nothing.
    """
    if isinstance(estimate.shape, Articulated):
        return connected_fields(estimate.shape)
    if isinstance(estimate.shape, Point):
        return {}
    offset, ellipse = equivalent_ellipse(estimate.shape)
    fields = {
        "center": estimate.mean[:2] + offset,
        "semi_axes": ellipse.semi_axes,
        "orientation": ellipse.orientation,
    }
    if full and isinstance(estimate.shape, StarConvex):
        fields["radii"] = estimate.shape.radii
    return fields


def truth_fields(truth: Truth) -> Fields:
    """One step of the truth."""
    if isinstance(truth.shape, Articulated):
        return {"state": truth.state, **connected_fields(truth.shape), **disc_fields(truth.shape)}
    if isinstance(truth.shape, Point):
        return {"state": truth.state} | ({} if truth.mode is None else {"mode": truth.mode})
    return {
        "position": truth.position,
        "velocity": truth.velocity,
        "semi_axes": truth.shape.semi_axes,
        "orientation": truth.shape.orientation,
    }

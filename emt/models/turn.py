"""Coordinated turn of position and velocity, regular at a turn rate of zero."""

import jax.numpy as jnp

from emt.linalg import Vec2
from emt.types import Scalar


def coordinated_turn(position: Vec2, velocity: Vec2, turn_rate: Scalar, dt: Scalar) -> tuple[Vec2, Vec2]:
    """Position and velocity after `dt` seconds on a circle at constant speed.

    Args:
        turn_rate: anticlockwise (rad/s).

    Source: Bar-Shalom, Li and Kirubarajan 2001, eq. 11.7.1-4, with sin(a)/w = T sinc a and
    (1 - cos a)/w = T (a/2) sinc²(a/2) for a = w T.
    """
    angle = turn_rate * dt
    along = dt * jnp.sinc(angle / jnp.pi)
    half = jnp.sinc(0.5 * angle / jnp.pi)
    across = dt * (0.5 * angle) * half * half
    c, s = jnp.cos(angle), jnp.sin(angle)
    return (
        Vec2(
            position.x + along * velocity.x - across * velocity.y, position.y + across * velocity.x + along * velocity.y
        ),
        Vec2(c * velocity.x - s * velocity.y, s * velocity.x + c * velocity.y),
    )

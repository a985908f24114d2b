"""Uniform and Gaussian random numbers in pairs, one pair from each 64-bit block of the generator.

`jax.random.normal` inverts the error function for each number, which takes a CPU longer.
"""

import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from emt.linalg import Vec2
from emt.logarithm import log_positive
from emt.trigonometry import sincos_turns


def uniform_pairs(key: PRNGKeyArray, n: int, dtype) -> tuple[Float[Array, "n"], Float[Array, "n"]]:
    """Two independent uniforms on (0, 1) each: odd multiples of 2⁻³³, in single precision rounded and so up to 1.

    A longer draw begins with a shorter one.
    """
    bits = jax.random.bits(key, (n,), jnp.uint64)
    halves = (bits >> 32).astype(jnp.uint32), bits.astype(jnp.uint32)
    first, second = ((half.astype(dtype) + 0.5) * 2.0**-32 for half in halves)
    return first, second


def polar(radius: Float[Array, "n"], turns: Float[Array, "n"]) -> Vec2:
    """The points at these distances, at angles in turns."""
    sine, cosine = sincos_turns(turns)
    return Vec2(radius * cosine, radius * sine)


def unit_disc(key: PRNGKeyArray, n: int, dtype) -> Vec2:
    """Points uniform in the unit disc."""
    u, turns = uniform_pairs(key, n, dtype)
    return polar(jnp.sqrt(u), turns)


def gaussian_radius(u):
    """Distance of a point of the standard Gaussian in the plane from a number uniform on (0, 1)."""
    return jnp.sqrt(-2.0 * log_positive(u))


def normal_pairs(key: PRNGKeyArray, n: int, dtype) -> Vec2:
    """Points of the standard Gaussian in the plane, none beyond 6.8 standard deviations.

    Source: Box and Muller 1958.
    """
    u, turns = uniform_pairs(key, n, dtype)
    return polar(gaussian_radius(u), turns)


def normals(key: PRNGKeyArray, shape: tuple[int, ...], dtype) -> Float[Array, "..."]:
    """Independent standard normal numbers: the coordinates of `normal_pairs`, the first ones first."""
    n = math.prod(shape)
    half = (n + 1) // 2
    # one radius too many: else XLA on CPUs writes coordinates over the radii, and such a loop takes them one by one
    u, turns = uniform_pairs(key, half + 1, dtype)
    pairs = polar(gaussian_radius(u)[:half], turns[:half])
    return jnp.concatenate([pairs.x, pairs.y])[:n].reshape(shape)

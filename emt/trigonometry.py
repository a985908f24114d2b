"""Sine, cosine and direction of many angles at once.

On CPU, XLA calls the C library for every double; this is the same to the last bit or two in plain arithmetic, which
the compiler spreads over vector lanes: five times faster where angles are many (`emt bench zea2014/scenario_a`).
"""

from math import factorial, pi, tan

import jax
import jax.numpy as jnp

HIGH, MIDDLE, LOW = 1.5707963267341256, 6.077100506303966e-11, 2.0222662487959506e-21
"""A quarter turn in three parts, the first two with trailing zeros: multiples up to 2²⁰ of them are exact."""
TERMS = 9
"""Of the Taylor series about 0; on ±π/4 the next one is below 1e-17."""
ATAN_TERMS = 8
"""Of the series of the arc tangent; on slopes below tan(π/32) the next one is below 1e-17."""


def sincos(angle):
    """(sin, cos) of angles up to a million in size; beyond, the last digits fade."""
    if angle.dtype != jnp.float64:
        return jnp.sin(angle), jnp.cos(angle)
    quarters = jnp.round(angle * (1.0 / (HIGH + MIDDLE)))
    rest = ((angle - quarters * HIGH) - quarters * MIDDLE) - quarters * LOW
    return _from_quadrant(rest, quarters)


def sincos_turns(turns):
    """(sin, cos) of angles given in whole turns, which need no reduction."""
    if turns.dtype != jnp.float64:
        angle = 2.0 * pi * turns
        return jnp.sin(angle), jnp.cos(angle)
    quarters = jnp.round(4.0 * turns)
    return _from_quadrant((turns - 0.25 * quarters) * (2.0 * pi), quarters)


@jax.custom_jvp
def arctan2(y, x):
    """Direction of (x, y) (rad): `jnp.arctan2` to the last bit or two, with its signs of zero."""
    return _direction(y, x) if y.dtype == jnp.float64 else jnp.arctan2(y, x)


@arctan2.defjvp
def _turning(point, motion):
    """Both coordinates count wherever the point lies, which the selections of `_direction` do not know."""
    (y, x), (dy, dx) = point, motion
    return arctan2(y, x), (x * dy - y * dx) / (x * x + y * y)


def _direction(y, x):
    """`arctan2`: the slope is taken against the nearest of five directions π/16 apart, after which eight terms of the
    series are enough."""
    rise, run = jnp.abs(y), jnp.abs(x)
    low, high = jnp.minimum(rise, run), jnp.maximum(rise, run)
    is_far = high == jnp.inf
    low, high = jnp.where(is_far, jnp.where(low == high, 1.0, 0.0), low), jnp.where(is_far, 1.0, high)
    slope, near = jnp.zeros_like(low), jnp.zeros_like(low)
    for k in range(1, 5):
        beyond = low > tan((2 * k - 1) * pi / 32) * high
        slope = jnp.where(beyond, tan(k * pi / 16) if k < 4 else 1.0, slope)
        near = jnp.where(beyond, k * pi / 16, near)
    below = high + slope * low
    rest = (low - slope * high) / jnp.where(below > 0.0, below, 1.0)
    square, total = rest * rest, 0.0
    for k in range(ATAN_TERMS - 1, 0, -1):
        total = (1.0 / (2 * k + 1) - total) * square
    angle = near + (rest - rest * total)
    angle = jnp.where(rise > run, 0.5 * pi - angle, angle)
    angle = jnp.where(jnp.signbit(x), pi - angle, angle)
    return jnp.copysign(angle, y)


def _from_quadrant(rest, quarters):
    """(sin, cos) of an angle of so many quarter turns and a rest within ±π/4."""
    square = rest * rest
    sine = rest * _series(square, 1)
    cosine = _series(square, 0)
    quadrant = quarters - 4.0 * jnp.floor(0.25 * quarters)
    is_odd = (quadrant == 1.0) | (quadrant == 3.0)
    first, second = jnp.where(is_odd, cosine, sine), jnp.where(is_odd, sine, cosine)
    return (
        jnp.where(quadrant >= 2.0, -first, first),
        jnp.where((quadrant == 1.0) | (quadrant == 2.0), -second, second),
    )


def _series(square, first: int):
    """Σ (-1)^k x^2k / (2k + first)!, by Horner's rule."""
    total = jnp.full_like(square, 1.0 / factorial(2 * (TERMS - 1) + first))
    for k in range(TERMS - 2, -1, -1):
        total = 1.0 / factorial(2 * k + first) - square * total
    return total

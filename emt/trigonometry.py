"""Sine, cosine and direction of many angles at once.

On CPU, XLA calls the C library for every double; this is the same to the last bit or two in plain arithmetic, which
the compiler spreads over vector lanes: five times faster where angles are many (`emt bench zea2014/scenario_a`).
"""

from fractions import Fraction
from functools import partial
from math import factorial, pi, tan

import jax
import jax.numpy as jnp

from emt.series import economised

traced_once = partial(jax.jit, inline=True)
"""Traced once for each shape, and then written out where it is used: the program is the same, and made sooner."""

HIGH, MIDDLE, LOW = 1.5707963267341256, 6.077100506303966e-11, 2.0222662487959506e-21
"""A quarter turn in three parts, the first two with trailing zeros: multiples up to 2²⁰ of them are exact."""
SINE = economised([Fraction((-1) ** k, factorial(2 * k + 1)) for k in range(15)], Fraction(pi / 2) ** 2, 9)
"""Of sin(x)/x as a series of x², on ±π/2 to 1e-18 and the rounding of coefficients."""
ARC = economised([Fraction((-1) ** k, 2 * k + 1) for k in range(12)], Fraction(tan(pi / 32)) ** 2, 7)
"""Of arctan(x)/x as a series of x², for slopes up to tan(π/32) to 1e-18."""


@traced_once
def sincos(angle):
    """(sin, cos) of angles up to a million in size; beyond, the last digits fade.

    Both are sines of what is left after a number of quarter turns, even for the sine and odd for the cosine: one series
    each, and no choice between two.
    """
    if angle.dtype != jnp.float64:
        return jnp.sin(angle), jnp.cos(angle)
    turns = angle * (0.5 / (HIGH + MIDDLE))

    def rest(quarters):
        return ((angle - quarters * HIGH) - quarters * MIDDLE) - quarters * LOW

    half, past = jnp.round(turns), jnp.floor(turns)
    return _sign(half) * _sine(rest(2.0 * half)), -_sign(past) * _sine(rest(2.0 * past + 1.0))


@traced_once
def sincos_turns(turns):
    """(sin, cos) of angles given in whole turns, which need no reduction."""
    if turns.dtype != jnp.float64:
        angle = 2.0 * pi * turns
        return jnp.sin(angle), jnp.cos(angle)
    half, past = jnp.round(2.0 * turns), jnp.floor(2.0 * turns)
    sine = _sign(half) * _sine((turns - 0.5 * half) * (2.0 * pi))
    return sine, -_sign(past) * _sine((turns - (0.5 * past + 0.25)) * (2.0 * pi))


def _sign(half_turns):
    """Of the sine after so many half turns: 1 for an even number of them, -1 for an odd one."""
    return 1.0 - 2.0 * (half_turns - 2.0 * jnp.floor(0.5 * half_turns))


def _sine(angle):
    """On ±π/2, by Horner's rule."""
    square = angle * angle
    total = jnp.full_like(square, SINE[-1])
    for coefficient in SINE[-2:0:-1]:
        total = coefficient + square * total
    return angle + angle * (square * total)


@jax.custom_jvp
def arctan2(y, x):
    """Direction of (x, y) (rad): `jnp.arctan2` to the last bit or two, with its signs of zero."""
    return _direction(y, x) if y.dtype == jnp.float64 else jnp.arctan2(y, x)


@arctan2.defjvp
def _turning(point, motion):
    """Both coordinates count wherever the point lies, which the selections of `_direction` do not know."""
    (y, x), (dy, dx) = point, motion
    return arctan2(y, x), (x * dy - y * dx) / (x * x + y * y)


@traced_once
def _direction(y, x):
    """`arctan2`: the slope is taken against the nearest of five directions π/16 apart, after which seven terms of
    the series are enough."""
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
    for coefficient in ARC[:0:-1]:
        total = (coefficient + total) * square
    angle = near + (rest + rest * total)
    angle = jnp.where(rise > run, 0.5 * pi - angle, angle)
    angle = jnp.where(jnp.signbit(x), pi - angle, angle)
    return jnp.copysign(angle, y)

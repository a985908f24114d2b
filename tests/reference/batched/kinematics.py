"""Position and velocity of many runs, with their covariance in blocks, at nearly constant velocity.

Mean (4, ..., run) of x, y, vx, vy; covariance (10, ..., run): of the position (3), of velocity and position (4), and
of the velocity (3), with their entries in the order of `plane`.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tests.reference.batched import plane

Array = NDArray[np.float64]
POSITION, CROSS, VELOCITY = slice(0, 3), slice(3, 7), slice(7, 10)


class Noise(NamedTuple):
    """Process noise that is alike on both axes and independent between them; numbers, or arrays that broadcast."""

    position: Array | float
    """Variance [length^2]."""
    cross: Array | float
    """Covariance of position and velocity [length^2/time]."""
    velocity: Array | float
    """Variance [length^2/time^2]."""


def white_acceleration(psd: float, dt: float) -> Noise:
    """psd [[T^3/3, T^2/2], [T^2/2, T]] on each axis."""
    return Noise(psd * dt**3 / 3.0, psd * dt**2 / 2.0, psd * dt)


def piecewise_acceleration(variance: Array, dt: float) -> Noise:
    """G variance G^T with G = (T^2/2, T) on each axis."""
    return Noise(variance * dt**4 / 4.0, variance * dt**3 / 2.0, variance * dt**2)


def blocks(cov: Array) -> Array:
    """The ten entries of a covariance (4, 4) of x, y, vx, vy."""
    pp, vp, vv = cov[:2, :2], cov[2:, :2], cov[2:, 2:]
    both = [pp[0, 0], pp[1, 1], pp[0, 1], vp[0, 0], vp[1, 1], vp[0, 1], vp[1, 0], vv[0, 0], vv[1, 1], vv[0, 1]]
    return np.array(both)


def predict(mean: Array, cov: Array, dt: float, noise: Noise) -> None:
    """Time update in place: p <- p + T v, v <- v, and F P F^T + Q."""
    mean[:2] += dt * mean[2:]
    position, cross, velocity = cov[POSITION], cov[CROSS], cov[VELOCITY]
    scaled = dt * velocity
    # P_pp + T (P_vp + P_vp^T) + T^2 P_vv, with the cross covariance of before
    position[:2] += 2.0 * dt * cross[:2]
    position[2] += dt * (cross[2] + cross[3])
    position += dt * scaled
    cross[:3] += scaled
    cross[3] += scaled[2]
    position[:2] += noise.position
    cross[:2] += noise.cross
    velocity[:2] += noise.velocity


def regress(mean: Array, cov: Array, shift: Array, position_cov: Array) -> None:
    """In place: the position has moved by `shift` (2, run) and has a new covariance (3, run); the velocity follows.

    With G = P_vp P_pp^-1 the velocity moves by G shift; P_vp becomes G P_pp', and P_vv loses G (P_pp - P_pp') G^T.
    """
    gain = plane.times(cov[CROSS], plane.inverse(cov[POSITION]))
    mean[:2] += shift
    mean[2:] += plane.apply_general(gain, shift)
    lost = plane.times(gain, cov[POSITION] - position_cov)
    cov[VELOCITY] -= plane.times_transposed(lost, gain)
    cov[CROSS] = plane.times(gain, position_cov)
    cov[POSITION] = position_cov

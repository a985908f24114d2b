"""The bootstrap filter of one run in arrays over its particles, with random numbers of a generator.

N. J. Gordon, D. J. Salmond and A. F. M. Smith, IEE Proc. F 140 (1993) 107-113; G. Kitagawa, J. Comput. Graph. Statist.
5 (1996) 1-25 for systematic resampling. The steps are those of `tests.reference.particle`, which takes one particle
after the other.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class RangeBearingWorld(NamedTuple):
    """A point x <- F x + v, v ~ N(0, Q), whose range and bearing from a sensor are measured."""

    F: Array
    Q: Array
    """Motion of x, y, vx, vy over a step (4, 4)."""
    sensor: Array
    """(2,) [length]"""
    range_std: float
    """[length]"""
    bearing_std: float
    """[rad]"""
    mean: Array
    cov: Array
    """Prior of x, y, vx, vy (4,), (4, 4)."""


def wrapped(angle: Array) -> Array:
    """The same angles [rad] in [-pi, pi)."""
    return angle - 2.0 * np.pi * np.floor(angle / (2.0 * np.pi) + 0.5)


def log_likelihood(x: Array, z: Array, world: RangeBearingWorld) -> Array:
    """log p(z|x) of particles x (4, N), less a constant."""
    dx, dy = x[:2] - world.sensor[:, None]
    range_gap = (z[0] - np.hypot(dx, dy)) / world.range_std
    bearing_gap = wrapped(z[1] - np.arctan2(dy, dx)) / world.bearing_std
    return -0.5 * (range_gap**2 + bearing_gap**2)


def ancestors_of(weights: Array, u: float) -> NDArray[np.int64]:
    """Systematic resampling: of the positions (i + u) / N, the first particle whose cumulative weight exceeds each."""
    N = len(weights)
    found = np.searchsorted(np.cumsum(weights), (np.arange(N) + u) / N, side="right")
    return np.minimum(found, N - 1)


def track(
    points: Array, rng: np.random.Generator, world: RangeBearingWorld, count: int, fraction: float
) -> list[Array]:  # fmt: skip
    """Weighted means after each of the scans `points` (step, 2).

    Draws normals (4, count) for the start, and a uniform and normals (4, count) for each step; resamples if fewer than
    fraction * count particles are effective.
    """
    root = np.linalg.cholesky(world.Q)
    x = world.mean[:, None] + np.linalg.cholesky(world.cov) @ rng.standard_normal((4, count))
    weights, means = np.full(count, 1.0 / count), []
    for z in points:
        u, noise = rng.random(), rng.standard_normal((4, count))
        if 1.0 / (weights**2).sum() < fraction * count:
            x, weights = x[:, ancestors_of(weights, u)], np.full(count, 1.0 / count)
        x = world.F @ x + root @ noise
        gains = log_likelihood(x, z, world)
        weights = weights * np.exp(gains - gains.max())
        weights = weights / weights.sum()
        means.append(x @ weights)
    return means

"""The bootstrap particle filter, all runs at once (see `tests.reference.particle`).

N. J. Gordon, D. J. Salmond and A. F. M. Smith, IEE Proc. F 140 (1993) 107-113. Arrays of particles are
(component, run, particle). Every run has a generator of its own, so that its random numbers do not depend on the other
runs; drawing is the only loop over runs.
"""

import numpy as np
from numpy.typing import NDArray

from tests.reference.particle_cloud import RangeBearingWorld, wrapped

Array = NDArray[np.float64]


def log_likelihood(x: Array, z: Array, world: RangeBearingWorld) -> Array:
    """log p(z|x) (run, particle), less a constant, of measurements z (run, 2)."""
    dx, dy = x[0] - world.sensor[0], x[1] - world.sensor[1]
    gap = np.arctan2(dy, dx)
    np.subtract(z[:, 1:], gap, out=gap)
    gap = wrapped(gap)
    gap /= world.bearing_std
    gap *= gap
    # not hypot, which guards against overflow and takes four times as long
    dx *= dx
    dy *= dy
    dx += dy
    np.sqrt(dx, out=dx)
    dx -= z[:, :1]
    dx /= world.range_std
    dx *= dx
    dx += gap
    dx *= -0.5
    return dx


def ancestors_of(weights: Array, u: Array) -> NDArray[np.int64]:
    """Systematic resampling of weights (run, particle) with uniforms (run,): offspring are counted, not searched for.

    Gives places (run * particle,) in the flattened weights.
    """
    N = weights.shape[1]
    below = np.cumsum(weights, axis=1)
    below *= N
    below -= u[:, None]
    np.ceil(below, out=below)
    np.clip(below, 0.0, N, out=below)
    below[:, -1] = N  # the last particle takes what rounding of the sum leaves
    offspring = np.diff(below, axis=1, prepend=0.0).astype(int)
    return np.repeat(np.arange(weights.size), offspring.ravel())


def track(
    points: Array, mask: NDArray[np.bool_], generators: list[np.random.Generator], world: RangeBearingWorld, count: int,
    fraction: float,
) -> Array:  # fmt: skip
    """Weighted means (run, step, 4), from one measurement per scan, points (run, step, 1, 2).

    Each run draws normals (4, count) for the start, and a uniform and normals (4, count) for each step; it resamples if
    fewer than fraction * count particles are effective.

    Raises:
        ValueError: a scan is empty.
    """
    if not mask.all():
        raise ValueError("every scan must hold a measurement")
    runs, n_steps = mask.shape[:2]
    root = np.linalg.cholesky(world.Q)
    noise, u = np.empty((runs, 4, count)), np.empty(runs)

    def draw() -> None:
        for rng, row in zip(generators, noise, strict=True):
            rng.standard_normal(out=row)

    def steps(root: Array) -> Array:
        return (root @ noise).transpose(1, 0, 2)

    draw()
    x = world.mean[:, None, None] + steps(np.linalg.cholesky(world.cov))
    weights, reports = np.full((runs, count), 1.0 / count), np.empty((n_steps, runs, 4))
    for k in range(n_steps):
        u[:] = [rng.random() for rng in generators]
        draw()
        poor = 1.0 / np.einsum("rp,rp->r", weights, weights) < fraction * count
        if poor.all():
            x = x.reshape(4, -1).take(ancestors_of(weights, u), axis=1).reshape(x.shape)
            weights[:] = 1.0 / count
        elif poor.any():
            some = x[:, poor]
            x[:, poor] = some.reshape(4, -1).take(ancestors_of(weights[poor], u[poor]), axis=1).reshape(some.shape)
            weights[poor] = 1.0 / count
        x = (world.F @ x.reshape(4, -1)).reshape(x.shape)
        x += steps(root)
        gains = log_likelihood(x, points[:, k, 0], world)
        gains -= gains.max(axis=1, keepdims=True)
        np.exp(gains, out=gains)
        weights *= gains
        weights /= weights.sum(axis=1, keepdims=True)
        np.einsum("crp,rp->rc", x, weights, out=reports[k])
    return reports.transpose(1, 0, 2)

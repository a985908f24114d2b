"""Slow textbook arithmetic of particle filters, with every random number given from outside.

N. J. Gordon, D. J. Salmond and A. F. M. Smith, IEE Proc. F 140 (1993) 107-113 for the bootstrap filter; R. van der
Merwe, A. Doucet, N. de Freitas and E. Wan, "The Unscented Particle Filter", CUED/F-INFENG/TR 380 (2000) for Gaussian
proposals; G. Kitagawa, J. Comput. Graph. Statist. 5 (1996) 1-25 for systematic resampling; H. Azimian, "A Survey on
Visual Object Tracking Algorithms" (2005), section 3.

A step resamples first, if the weights it was given call for it, then draws and weighs; its estimate is therefore that
of the weighted particles, before any resampling.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tests.reference.kalman import log_gaussian

Array = NDArray[np.float64]


class Result(NamedTuple):
    """What a step leaves: N particles (N, n), log-weights (N,), proposal covariances (N, n, n), and the estimate."""

    particles: Array
    log_weights: Array
    covariances: Array | None
    mean: Array
    cov: Array
    ancestors: NDArray[np.int64]


def normalised(log_weights: Array) -> Array:
    """Log-weights whose exponentials sum to 1."""
    top = np.max(log_weights)
    return log_weights - top - np.log(np.sum(np.exp(log_weights - top)))


def effective_samples(weights: Array) -> float:
    """1 / sum w^2 of normalised weights."""
    return float(1.0 / np.sum(weights**2))


def systematic_resample(weights: Array, u: float) -> NDArray[np.int64]:
    """Ancestors at the positions (i + u) / N, u in [0, 1): the first k whose cumulative weight exceeds the position."""
    N, ancestors = len(weights), []
    cumulative = np.cumsum(weights)
    for i in range(N):
        k = 0
        while k < N - 1 and cumulative[k] <= (i + u) / N:
            k += 1
        ancestors.append(k)
    return np.array(ancestors)


def estimate(particles: Array, weights: Array) -> tuple[Array, Array]:
    """Weighted mean, and covariance sum w x x' - m m'."""
    mean = sum(w * x for w, x in zip(weights, particles, strict=True))
    return mean, sum(w * np.outer(x, x) for w, x in zip(weights, particles, strict=True)) - np.outer(mean, mean)


def selected(log_weights: Array, u: float, fraction: float) -> tuple[NDArray[np.int64], Array]:
    """Ancestors and log-weights to go on with; resampled if fewer than fraction * N particles are effective."""
    N = len(log_weights)
    if effective_samples(np.exp(log_weights)) < fraction * N:
        return systematic_resample(np.exp(log_weights), u), np.full(N, -np.log(N))
    return np.arange(N), log_weights


def bootstrap_step(
    particles: Array, log_weights: Array, z: Array, u: float, noise: Array, propagate: Callable[[Array, Array], Array],
    log_likelihood: Callable[[Array, Array], float], fraction: float = 0.5,
) -> Result:  # fmt: skip
    """One scan with the prior as proposal: only the likelihood enters the weights.

    u resamples; particle i becomes propagate(x_i, noise_i); log_likelihood(z, x) is log p(z|x).
    """
    ancestors, log_w = selected(log_weights, u, fraction)
    moved = np.stack([propagate(particles[a], v) for a, v in zip(ancestors, noise, strict=True)])
    log_w = normalised(np.array([w + log_likelihood(z, x) for w, x in zip(log_w, moved, strict=True)]))
    return Result(moved, log_w, None, *estimate(moved, np.exp(log_w)), ancestors)


def proposal_step(
    particles: Array, covariances: Array, log_weights: Array, z: Array, u: float, noise: Array,
    proposal: Callable[[Array, Array, Array], tuple[Array, Array]], log_transition: Callable[[Array, Array], float],
    log_likelihood: Callable[[Array, Array], float], fraction: float = 0.5,
) -> Result:  # fmt: skip
    """One scan with a Gaussian proposal of every particle's own.

    proposal(x, P, z) gives mean and covariance of one EKF or UKF scan from a particle and the covariance it carries
    (which it may ignore); the particle becomes mean + L noise_i, L the lower Cholesky factor, and carries the
    proposal's covariance on. log_transition(x, x_previous) is log p(x|x_previous).
    """
    ancestors, log_w = selected(log_weights, u, fraction)
    moved, carried, log_new = [], [], []
    for a, w, v in zip(ancestors, log_w, noise, strict=True):
        mean, P = proposal(particles[a], covariances[a], z)
        x = mean + np.linalg.cholesky(P) @ v
        log_q = log_gaussian(x - mean, P)
        log_new.append(w + log_likelihood(z, x) + log_transition(x, particles[a]) - log_q)
        moved.append(x)
        carried.append(P)
    log_w = normalised(np.array(log_new))
    moved = np.stack(moved)
    return Result(moved, log_w, np.stack(carried), *estimate(moved, np.exp(log_w)), ancestors)

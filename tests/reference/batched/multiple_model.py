"""Interacting multiple models of a point, all runs at once (see `tests.reference.multiple_model`).

H. A. P. Blom and Y. Bar-Shalom, IEEE Trans. Autom. Control 33 (1988) 780-783. Arrays are (component, model, run). All
models have nearly constant velocity and differ in a known acceleration and in the noise; all share z = p + n.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tests.reference.batched import kinematics, plane
from tests.reference.batched.kinematics import CROSS, POSITION, VELOCITY

Array = NDArray[np.float64]


class Models(NamedTuple):
    """The motions."""

    push: Array
    """What a step adds to x, y, vx, vy (4, model)."""
    noise: kinematics.Noise
    """Process noise per axis, arrays (model, 1)."""
    pi: Array
    """[i, j]: probability of model j next, given i now."""


class Bank(NamedTuple):
    """What the runs believe."""

    mean: Array
    """(4, model, run)"""
    cov: Array
    """(10, model, run), in the order of `kinematics`."""
    mu: Array
    """Probabilities (model, run)."""


def mixed(bank: Bank, pi: Array) -> Bank:
    """Each model starts from the mixture of all models as they may have preceded it.

    Moments are taken about the overall mean and mixed, all of them, by one product with pi. A model without
    predecessor has probability 0, and what it holds is arbitrary.
    """
    predicted = pi.T @ bank.mu
    center = np.einsum("imr,mr->ir", bank.mean, bank.mu)[:, None]
    gap = bank.mean - center
    moments = np.concatenate([gap, bank.cov])
    second = moments[4:]
    add_outer(second, gap, gap)
    moments *= bank.mu
    moments = pi.T @ moments
    moments /= np.where(predicted > 0.0, predicted, 1.0)
    shift, cov = moments[:4], moments[4:]
    add_outer(cov, shift, -shift)
    shift += center
    return Bank(shift, cov, predicted)


def add_outer(cov: Array, v: Array, w: Array) -> None:
    """Adds v w^T, where that is symmetric, to a covariance in blocks; v, w (4, ..., run)."""
    cov[0:2] += v[:2] * w[:2]
    cov[2] += v[0] * w[1]
    cov[3:5] += v[2:] * w[:2]
    cov[5] += v[2] * w[1]
    cov[6] += v[3] * w[0]
    cov[7:9] += v[2:] * w[2:]
    cov[9] += v[2] * w[3]


def update(bank: Bank, z: Array, R: Array) -> Bank:
    """Kalman update of every model with the measurement z (2, run) of covariance R (2, 2), and Bayes' rule."""
    mean, cov, mu = bank
    pp, vp = cov[POSITION], cov[CROSS]
    S = pp + plane.entries(R)[:, None]
    det_S = plane.det(S)
    S_inv = plane.inverse(S, det_S)
    e = z[:, None] - mean[:2]
    weighed = plane.apply(S_inv, e)
    log_likelihood = -0.5 * (plane.dot(e, weighed) + np.log(det_S))

    gain = plane.times(vp, S_inv)
    mean[:2] += plane.apply(pp, weighed)
    mean[2:] += plane.apply_general(vp, weighed)
    cov[VELOCITY] -= plane.times_transposed(gain, vp)
    vp -= plane.times(gain, pp)
    pp -= plane.sandwich(pp, S_inv)

    # relative to the best model that can be in effect, so that not all underflow
    largest = np.where(mu > 0.0, log_likelihood, -np.inf).max(axis=0)
    mu = mu * np.exp(np.minimum(log_likelihood - largest, 0.0))
    return Bank(mean, cov, mu / mu.sum(axis=0))


def track(
    points: Array, mask: NDArray[np.bool_], prior_mean: Array, prior_cov: Array, start: Array, dt: float,
    models: Models, R: Array,
) -> Array:  # fmt: skip
    """Means (run, step, 4) of the mixture, from one measurement per scan, points (run, step, 1, 2).

    prior_mean (run, 4), prior_cov (4, 4); start (model,) probabilities before the first prediction.

    Raises:
        ValueError: a scan is empty.
    """
    if not mask.all():
        raise ValueError("every scan must hold a measurement")
    runs, n_steps, n = *mask.shape[:2], len(start)
    mean = np.tile(prior_mean.T[:, None], (1, n, 1))
    cov = np.tile(kinematics.blocks(prior_cov)[:, None, None], (1, n, runs))
    bank = Bank(mean, cov, np.tile(start[:, None], runs))
    reports = np.empty((n_steps, 4, runs))
    for k in range(n_steps):
        bank = mixed(bank, models.pi)
        kinematics.predict(bank.mean, bank.cov, dt, models.noise)
        bank.mean[:] += models.push[:, :, None]
        bank = update(bank, points[:, k, 0].T, R)
        np.einsum("imr,mr->ir", bank.mean, bank.mu, out=reports[k])
    return reports.transpose(2, 0, 1)

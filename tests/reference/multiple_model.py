"""Slow textbook arithmetic of multiple-model filters with a fixed set of linear models, one function a step.

Y. Bar-Shalom, X. R. Li and T. Kirubarajan, Estimation with Applications to Tracking and Navigation (2001), section
11.6; H. A. P. Blom and Y. Bar-Shalom, IEEE Trans. Autom. Control 33 (1988) 780-783; H. Azimian, "A Survey on Visual
Object Tracking Algorithms" (2005), section 4.2. Model i moves x <- F_i x + b_i + v, v ~ N(0, Q_i); all share
z = H x + n, n ~ N(0, R). pi[i, j] is the probability of model j next, given i now (rows sum to 1).

Probabilities are logarithms throughout, so that a model that explains nothing keeps a finite one. -inf is left to
models that cannot be in effect for want of a predecessor; what they hold (their own state, not mixed) is arbitrary.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tests.reference import kalman

Array = NDArray[np.float64]
Models = list[tuple[Array, Array, Array]]


class State(NamedTuple):
    """Means (r, n), covariances (r, n, n) and log-probabilities (r,) of the models, after a scan."""

    x: Array
    P: Array
    log_mu: Array


Step = tuple[State, Array, Array]


def log(p: Array) -> Array:
    """Logarithm that takes 0 to -inf without complaint."""
    with np.errstate(divide="ignore"):
        return np.log(p)


def log_sum_exp(a: Array) -> float:
    """log sum exp(a), -inf if every term is."""
    top = np.max(a)
    return float(top) if top == -np.inf else float(top + np.log(np.sum(np.exp(a - top))))


def merged(weights: Array, x: Array, P: Array) -> tuple[Array, Array]:
    """Mean and covariance of a mixture, with the spread of the means."""
    mean = sum(w * m for w, m in zip(weights, x, strict=True))
    cov = sum(w * (C + np.outer(m - mean, m - mean)) for w, m, C in zip(weights, x, P, strict=True))
    return mean, cov


def filtered(x: Array, P: Array, z: Array, model: tuple[Array, Array, Array], H: Array, R: Array) -> kalman.Update:
    """Kalman prediction and update with one model."""
    return kalman.update(*kalman.predict(x, P, *model), z, H, R)


def run(x: Array, P: Array, log_predicted: Array, z: Array, models: Models, H: Array, R: Array) -> Step:
    """Filter model i from x_i and P_i, weigh by predicted probability times likelihood, fuse."""
    results = [filtered(x_i, P_i, z, model, H, R) for x_i, P_i, model in zip(x, P, models, strict=True)]
    new_x, new_P = np.stack([r[0] for r in results]), np.stack([r[1] for r in results])
    log_mu = log_predicted + np.array([r[2] for r in results])
    log_mu = log_mu - log_sum_exp(log_mu)
    return State(new_x, new_P, log_mu), *merged(np.exp(log_mu), new_x, new_P)


def predicted_probabilities(log_mu: Array, pi: Array) -> Array:
    """log sum_j pi_ji mu_j for every model i."""
    return np.array([log_sum_exp(log(pi[:, i]) + log_mu) for i in range(len(log_mu))])


def mixing_weights(log_mu: Array, pi: Array) -> Array:
    """[j, i]: probability of model j before, given i now; a model without predecessor keeps its own state."""
    predicted = predicted_probabilities(log_mu, pi)
    columns = []
    for i in range(len(log_mu)):
        possible = predicted[i] > -np.inf
        columns.append(np.exp(log(pi[:, i]) + log_mu - predicted[i]) if possible else np.eye(len(log_mu))[i])
    return np.stack(columns, axis=1)


def static_step(state: State, z: Array, models: Models, H: Array, R: Array, floor: float = 0.0) -> Step:
    """Static bank: the models never exchange anything.

    floor: lowest probability a model enters the update with; all are raised to it and renormalised before the scan.
    """
    mu = np.maximum(np.exp(state.log_mu), floor)
    log_predicted = log(mu / np.sum(mu)) if floor > 0.0 else state.log_mu
    return run(state.x, state.P, log_predicted, z, models, H, R)


def gpb1_step(
    x: Array, P: Array, log_mu: Array, z: Array, models: Models, H: Array, R: Array, pi: Array
) -> tuple[Array, Array, Array]:  # fmt: skip
    """GPB1: every model starts from the one fused mean and covariance, which are all that is kept besides log_mu."""
    r = len(models)
    new, mean, cov = run(np.stack([x] * r), np.stack([P] * r), predicted_probabilities(log_mu, pi), z, models, H, R)
    return mean, cov, new.log_mu


def imm_step(state: State, z: Array, models: Models, H: Array, R: Array, pi: Array) -> Step:
    """IMM: model i starts from the mixture of all models as they may have preceded it."""
    W = mixing_weights(state.log_mu, pi)
    starts = [merged(W[:, i], state.x, state.P) for i in range(len(models))]
    x, P = np.stack([s[0] for s in starts]), np.stack([s[1] for s in starts])
    return run(x, P, predicted_probabilities(state.log_mu, pi), z, models, H, R)


def gpb2_step(state: State, z: Array, models: Models, H: Array, R: Array, pi: Array) -> Step:
    """GPB2: a filter for every pair (j before, i now), merged over j afterwards."""
    r = len(models)
    log_pair = np.zeros((r, r))
    pairs = [[filtered(state.x[j], state.P[j], z, models[i], H, R) for i in range(r)] for j in range(r)]
    for j in range(r):
        for i in range(r):
            log_pair[j, i] = state.log_mu[j] + float(log(pi[j, i])) + pairs[j][i][2]
    log_pair = log_pair - log_sum_exp(log_pair)
    log_mu = np.array([log_sum_exp(log_pair[:, i]) for i in range(r)])
    x, P = np.zeros_like(state.x), np.zeros_like(state.P)
    for i in range(r):
        possible = log_mu[i] > -np.inf
        weights = np.exp(log_pair[:, i] - log_mu[i]) if possible else np.eye(r)[i]
        x[i], P[i] = merged(weights, np.stack([pairs[j][i][0] for j in range(r)]), [pairs[j][i][1] for j in range(r)])
    return State(x, P, log_mu), *merged(np.exp(log_mu), x, P)

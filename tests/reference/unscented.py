"""Slow textbook arithmetic of the unscented Kalman filter, in the three forms that are in use.

S. J. Julier and J. K. Uhlmann, Proc. IEEE 92 (2004) 401-422; E. A. Wan and R. van der Merwe, AS-SPCC (2000) for the
scaled points; H. Azimian, "A Survey on Visual Object Tracking Algorithms" (2005), eqs. 2.11-2.23. The forms differ
in what the measurement function sees, and for nonlinear functions in their results:

* ``redrawn_step``: Q is added to the predicted covariance, and new points are drawn from it;
* ``kept_step``: Q is added likewise, but the propagated points, which lack it, are used again;
* ``augmented_step``: the process noise is a part of the points; they are propagated with it and used again.

R is added to the covariance of the predicted measurement in all three. The points are the mean and the mean plus or
minus the columns of the lower Cholesky factor, one point a row.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tests.reference.kalman import Function, Update, log_gaussian, wrapped

Array = NDArray[np.float64]


class Scaling(NamedTuple):
    """Spread of the points, weight of the centre in covariances, and the second scaling parameter."""

    alpha: float = 1.0
    beta: float = 0.0
    kappa: float = 0.0


class Moments(NamedTuple):
    """Mean, and deviations of the points from it, one a row."""

    mean: Array
    deviations: Array


def lower_root(P: Array) -> Array:
    """Lower Cholesky factor; a direction without variance has a column of zeros."""
    L = np.zeros_like(P)
    for j in range(len(P)):
        pivot = P[j, j] - L[j, :j] @ L[j, :j]
        if pivot > 0.0:
            L[j:, j] = (P[j:, j] - L[j:, :j] @ L[j, :j]) / np.sqrt(pivot)
    return L


def weights(n: int, scaling: Scaling) -> tuple[Array, Array]:
    """Weights of the 2n + 1 points in means and in covariances."""
    alpha, beta, kappa = scaling
    lam = alpha**2 * (n + kappa) - n
    w_mean = np.full(2 * n + 1, 0.5 / (n + lam))
    w_mean[0] = lam / (n + lam)
    w_cov = w_mean.copy()
    w_cov[0] += 1.0 - alpha**2 + beta
    return w_mean, w_cov


def sigma_points(x: Array, P: Array, scaling: Scaling) -> Array:
    """The 2n + 1 points, one a row; n + lambda = alpha^2 (n + kappa)."""
    n = len(x)
    root = np.sqrt(scaling.alpha**2 * (n + scaling.kappa)) * lower_root(P)
    return np.vstack([x, x + root.T, x - root.T])


def moments(points: Array, w_mean: Array, angles: tuple[bool, ...] = ()) -> Moments:
    """Mean and deviations, both by way of the differences from the central point, wrapped where they are angles.

    Neither the mean nor the deviations are wrapped again afterwards.
    """
    differences = np.stack([wrapped(p - points[0], angles) for p in points])
    shift = w_mean @ differences
    return Moments(points[0] + shift, differences - shift)


def covariance(a: Array, b: Array, w_cov: Array) -> Array:
    """Weighted sum of the outer products of deviations."""
    return sum(w * np.outer(d, e) for w, d, e in zip(w_cov, a, b, strict=True))


def corrected(
    P: Array, states: Moments, measured: Array, z: Array, R: Array, n: int, scaling: Scaling, angles: tuple[bool, ...]
) -> Update:
    """Mean, covariance, log-likelihood and NIS, given the predicted covariance and the measurements of the points."""
    w_mean, w_cov = weights(n, scaling)
    predicted = moments(measured, w_mean, angles)
    S = covariance(predicted.deviations, predicted.deviations, w_cov) + R
    K = covariance(states.deviations, predicted.deviations, w_cov) @ np.linalg.inv(S)
    e = wrapped(z - predicted.mean, angles)
    return states.mean + K @ e, P - K @ S @ K.T, log_gaussian(e, S), float(e @ np.linalg.solve(S, e))


def propagate(x: Array, P: Array, f: Function, Q: Array, scaling: Scaling) -> tuple[Moments, Array]:
    """Moments of the propagated points, and the predicted covariance with Q."""
    w_mean, w_cov = weights(len(x), scaling)
    states = moments(np.stack([f(p) for p in sigma_points(x, P, scaling)]), w_mean)
    return states, covariance(states.deviations, states.deviations, w_cov) + Q


def predict(x: Array, P: Array, f: Function, Q: Array, scaling: Scaling) -> tuple[Array, Array]:
    """Time update with additive noise."""
    states, P = propagate(x, P, f, Q, scaling)
    return states.mean, P


def update(
    x: Array, P: Array, z: Array, h: Function, R: Array, scaling: Scaling, angles: tuple[bool, ...] = ()
) -> Update:  # fmt: skip
    """Measurement update with points drawn from the predicted mean and covariance."""
    points = sigma_points(x, P, scaling)
    states = Moments(x, points - x)
    return corrected(P, states, np.stack([h(p) for p in points]), z, R, len(x), scaling, angles)


def redrawn_step(
    x: Array, P: Array, z: Array, f: Function, Q: Array, h: Function, R: Array, scaling: Scaling,
    angles: tuple[bool, ...] = (),
) -> Update:  # fmt: skip
    """One scan with additive noise; the points are drawn anew after Q is added."""
    return update(*predict(x, P, f, Q, scaling), z, h, R, scaling, angles)


def kept_step(
    x: Array, P: Array, z: Array, f: Function, Q: Array, h: Function, R: Array, scaling: Scaling,
    angles: tuple[bool, ...] = (),
) -> Update:  # fmt: skip
    """One scan with additive noise; the propagated points are measured, as they are."""
    states, P = propagate(x, P, f, Q, scaling)
    measured = np.stack([h(p) for p in states.mean + states.deviations])
    return corrected(P, states, measured, z, R, len(x), scaling, angles)


def augmented_step(
    x: Array, P: Array, z: Array, f: Callable[[Array, Array], Array], Q: Array, h: Function, R: Array, scaling: Scaling,
    angles: tuple[bool, ...] = (),
) -> Update:  # fmt: skip
    """One scan with f(x, v), the state and the process noise v ~ N(0, Q) stacked in the points."""
    n, n_all = len(x), len(x) + len(Q)
    stacked = np.zeros((n_all, n_all))
    stacked[:n, :n], stacked[n:, n:] = P, Q
    points = sigma_points(np.concatenate([x, np.zeros(len(Q))]), stacked, scaling)
    moved = np.stack([f(p[:n], p[n:]) for p in points])
    w_mean, w_cov = weights(n_all, scaling)
    states = moments(moved, w_mean)
    P = covariance(states.deviations, states.deviations, w_cov)
    return corrected(P, states, np.stack([h(p) for p in moved]), z, R, n_all, scaling, angles)

"""Slow textbook arithmetic of the Kalman filter and of its first-order extension to nonlinear models.

R. E. Kalman, J. Basic Eng. 82 (1960) 35-45; A. H. Jazwinski, Stochastic Processes and Filtering Theory (1970) for the
extended filter; H. Azimian, "A Survey on Visual Object Tracking Algorithms" (2005), sections 1 and 2. The models are
x <- F x + b + v, v ~ N(0, Q), and z = H x + n, n ~ N(0, R); the nonlinear ones have f(x) and h(x) in place of the
linear terms.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Function = Callable[[Array], Array]
Update = tuple[Array, Array, float, float]


def wrap(angle: float) -> float:
    """The same angle [rad] in (-pi, pi]; one that lies there already is returned as it is."""
    return angle if -np.pi < angle <= np.pi else np.pi - (np.pi - angle) % (2.0 * np.pi)


def wrapped(v: Array, angles: tuple[bool, ...]) -> Array:
    """A vector with the marked components wrapped; without marks nothing is."""
    return np.array([wrap(a) if marked else a for a, marked in zip(v, angles or (False,) * len(v), strict=True)])


def log_gaussian(e: Array, S: Array) -> float:
    """Logarithm of the density N(e; 0, S)."""
    return float(-0.5 * (e @ np.linalg.solve(S, e) + np.linalg.slogdet(S)[1] + len(e) * np.log(2.0 * np.pi)))


def predict(x: Array, P: Array, F: Array, b: Array, Q: Array) -> tuple[Array, Array]:
    """Time update."""
    return F @ x + b, F @ P @ F.T + Q


def corrected(x: Array, P: Array, e: Array, H: Array, R: Array) -> Update:
    """Mean, covariance (Joseph form), log-likelihood and NIS, given the innovation e."""
    S = H @ P @ H.T + R
    K = P @ H.T @ np.linalg.inv(S)
    A = np.eye(len(x)) - K @ H
    return x + K @ e, A @ P @ A.T + K @ R @ K.T, log_gaussian(e, S), float(e @ np.linalg.solve(S, e))


def update(x: Array, P: Array, z: Array, H: Array, R: Array) -> Update:
    """Measurement update: mean, covariance, log-likelihood and NIS."""
    return corrected(x, P, z - H @ x, H, R)


def predictor_step(
    x: Array, P: Array, z: Array, F: Array, b: Array, Q: Array, H: Array, R: Array
) -> tuple[Array, Array]:  # fmt: skip
    """From the prediction for this scan, and its measurement, straight to the prediction for the next scan.

    The form of the survey's section 1, with gain K = F P H' S^-1 and P <- Q + (F - K H) P F'.
    """
    K = F @ P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
    return F @ x + b + K @ (z - H @ x), Q + (F - K @ H) @ P @ F.T


def numerical_jacobian(function: Function, x: Array, angles: tuple[bool, ...] = (), step: float = 1e-6) -> Array:
    """Central differences; the error is about 1e-10 of the scale of the function. Marked components are angles."""
    columns = []
    for i in range(len(x)):
        d = np.zeros(len(x))
        d[i] = step * max(1.0, abs(x[i]))
        columns.append(wrapped(function(x + d) - function(x - d), angles) / (2.0 * d[i]))
    return np.stack(columns, axis=1)


def extended_predict(x: Array, P: Array, f: Function, jacobian_f: Function, Q: Array) -> tuple[Array, Array]:
    """Time update with f linearised at the filtered mean."""
    F = jacobian_f(x)
    return f(x), F @ P @ F.T + Q


def extended_update(
    x: Array, P: Array, z: Array, h: Function, jacobian_h: Function, R: Array, angles: tuple[bool, ...] = ()
) -> Update:  # fmt: skip
    """Measurement update with h linearised at the predicted mean.

    angles: which components of the measurement are angles; their residuals are wrapped to (-pi, pi].
    """
    return corrected(x, P, wrapped(z - h(x), angles), jacobian_h(x), R)

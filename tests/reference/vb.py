"""Slow textbook arithmetic of the variational Bayes tracker with explicit orientation.

B. Tuncer and E. Özkan, "Random Matrix Based Extended Target Tracking With Orientation: A New Model and
Inference", IEEE Trans. Signal Process. 69 (2021) 1910-1923, doi:10.1109/TSP.2021.3065136: the model of
Sec. II, the mean-field measurement update with Lemma 1 of Sec. III and the time update of Sec. IV.

Model, with L(theta) the rotation and X = diag(X1, X2) the squared semi-axes,

    y_j | z_j ~ N(z_j, R),    z_j | x, X, theta ~ N(H x, s L X L^T),    H = [I2 0],
    x ~ N(x0, P0),  theta ~ N(theta0, S0),  X_i ~ IG(a0_i, b0_i).

Every measurement keeps its own noise-free point z_j; all factors are recomputed from the previous iterate
(Jacobi order), so none sees another's fresh value.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
State = tuple[Array, Array, float, float, Array, Array]

H = np.hstack([np.eye(2), np.zeros((2, 2))])


def rotation(theta: float) -> Array:
    """Rotation matrix L(theta) [theta in rad]."""
    return np.array([[np.cos(theta), -np.sin(theta)], [np.sin(theta), np.cos(theta)]])


def rotation_derivative(theta: float) -> Array:
    """Derivative dL/dtheta [1/rad]."""
    return np.array([[-np.sin(theta), -np.cos(theta)], [np.cos(theta), -np.sin(theta)]])


def expected_rotation(M: Array, mean: float, variance: float) -> Array:
    """Lemma 1: E[L(t) M L(t)^T] for t ~ N(mean [rad], variance [rad^2]) and any fixed 2x2 M."""
    (p, q), (r, w) = M
    C = np.exp(-2.0 * variance) * np.cos(2.0 * mean)
    D = np.exp(-2.0 * variance) * np.sin(2.0 * mean)
    return 0.5 * np.array(
        [
            [p * (1 + C) + w * (1 - C) - (q + r) * D, q * (1 + C) - r * (1 - C) + (p - w) * D],
            [r * (1 + C) - q * (1 - C) + (p - w) * D, w * (1 + C) + p * (1 - C) + (q + r) * D],
        ]
    )


def expected_back_rotation(M: Array, mean: float, variance: float) -> Array:
    """Lemma 1 with the angle reversed: E[L(t)^T M L(t)] for t ~ N(mean, variance)."""
    return expected_rotation(M, -mean, variance)


def update(
    x: Array, P: Array, theta: float, S: float, a: Array, b: Array, y: Array, R: Array, s: float,
    n_iterations: int,
) -> State:  # fmt: skip
    """Measurement update of the predicted density by mean-field fixed-point iterations.

    x (4,) position and velocity with covariance P; theta [rad] with variance S [rad^2]; a, b (2,) shapes and
    scales [length^2] of the squared semi-axes; y (m, 2) measurements with noise covariance R; s the spread
    factor. Without measurements the prediction is returned.
    """
    m = len(y)
    if m == 0:
        return x, P, theta, S, a, b

    x0, P0, theta0, S0, a0, b0 = x, P, theta, S, a, b
    P0_inv = np.linalg.inv(P0)
    R_inv = np.linalg.inv(R)

    z = list(y)
    Sz = s * np.diag(b0 / (a0 - 1.0))

    for _ in range(n_iterations):
        # Expectations under the previous iterate.
        D = np.diag(a / (s * b))
        A = expected_rotation(D, theta, S)
        z_bar = sum(z) / m
        Psi = np.zeros((2, 2))
        for z_j in z:
            Psi = Psi + np.outer(z_j - H @ x, z_j - H @ x) + H @ P @ H.T + Sz
        L = rotation(theta)
        dL = rotation_derivative(theta)

        # Kinematics.
        P_new = np.linalg.inv(P0_inv + m * H.T @ A @ H)
        x_new = P_new @ (P0_inv @ x0 + m * H.T @ A @ z_bar)

        # Extent.
        a_new = a0 + 0.5 * m
        b_new = b0 + np.diag(expected_back_rotation(Psi, theta, S)) / (2.0 * s)

        # Noise-free points.
        Sz_new = np.linalg.inv(A + R_inv)
        z_new = [Sz_new @ (A @ H @ x + R_inv @ y_j) for y_j in y]

        # Orientation, linearised about its previous mean.
        G = np.trace(D @ dL.T @ Psi @ dL)
        g = G * theta - np.trace(D @ L.T @ Psi @ dL)
        S_new = 1.0 / (1.0 / S0 + G)
        theta_new = S_new * (theta0 / S0 + g)

        x, P, theta, S = x_new, P_new, float(theta_new), float(S_new)
        a, b, z, Sz = a_new, b_new, z_new, Sz_new

    return x, P, theta, S, a, b


def predict(
    x: Array, P: Array, theta: float, S: float, a: Array, b: Array, F: Array, Q: Array, theta_var: float,
    forgetting: float,
) -> State:  # fmt: skip
    """Time update: linear motion, random-walk orientation, exponential forgetting of shapes and scales."""
    return F @ x, F @ P @ F.T + Q, theta, S + theta_var, forgetting * a, forgetting * b


def semi_axes(a: Array, b: Array) -> Array:
    """Semi-axes [length], the roots of the inverse-gamma means; the first lies along theta. Needs a > 1."""
    return np.sqrt(b / (a - 1.0))

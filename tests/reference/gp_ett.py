"""Slow textbook arithmetic of the Gaussian process tracker of star-convex contours.

N. Wahlström and E. Özkan, "Extended Target Tracking Using Gaussian Processes", IEEE Trans. Signal Process. 63
(2015) 4165-4178, doi:10.1109/TSP.2015.2424194: the periodic kernel, its state-space form, the contour
measurement model and the extended Kalman filter.

State [cx, cy, psi, vx, vy, psi_rate, f_1 .. f_N]: centre, orientation, their rates, and the radii [length] at
N basis angles of the body frame (zero prior mean). Two habits of the authors' public code are kept on
purpose:

* the angular derivative multiplies the whole kernel, its constant std_radius^2 included;
* the inverse of the jittered kernel matrix is made once (``kernel_inverse``) and handed on to every update.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def kernel(u: Array, v: Array, std_prior: float, std_radius: float, length_scale: float) -> Array:
    """Radius covariance [length^2] of every angle in u (rows) with every angle in v (columns) [rad]."""
    K = np.zeros((len(u), len(v)))
    for i, u_i in enumerate(u):
        for j, v_j in enumerate(v):
            exponent = -2.0 * np.sin(0.5 * (u_i - v_j)) ** 2 / length_scale**2
            K[i, j] = std_prior**2 * np.exp(exponent) + std_radius**2
    return K


def kernel_inverse(K: Array, eps: float) -> Array:
    """Inverse of the jittered prior covariance, (K + eps I)^-1."""
    return np.linalg.inv(K + eps * np.eye(len(K)))


def predict(
    x: Array, P: Array, K: Array, T: float, forgetting_alpha: float, std_center: float, std_psi: float
) -> tuple[Array, Array]:  # fmt: skip
    """Time update over T [time]: nearly constant velocity, radii forgetting towards their prior.

    K (N, N) prior covariance of the radii, without jitter; forgetting_alpha [1/time]; std_center and std_psi
    the process noise of centre and orientation.
    """
    n = len(K)
    F = np.zeros((6 + n, 6 + n))
    Q = np.zeros((6 + n, 6 + n))
    F[:6, :6] = np.kron(np.array([[1.0, T], [0.0, 1.0]]), np.eye(3))
    noise = np.diag([std_center**2, std_center**2, std_psi**2])
    Q[:6, :6] = np.kron(np.array([[T**3 / 3.0, T**2 / 2.0], [T**2 / 2.0, T]]), noise)
    F[6:, 6:] = np.exp(-forgetting_alpha * T) * np.eye(n)
    Q[6:, 6:] = (1.0 - np.exp(-2.0 * forgetting_alpha * T)) * K
    return F @ x, F @ P @ F.T + Q


def update(
    x: Array, P: Array, y: Array, basis_angles: Array, K_inv: Array, std_prior: float, std_radius: float,
    length_scale: float, std_meas: float,
) -> tuple[Array, Array]:  # fmt: skip
    """One extended Kalman update with all contour points y (m, 2), linearised at the prediction.

    K_inv is the result of ``kernel_inverse`` for the basis angles [rad]; std_meas [length] is the measurement
    noise. Without measurements the prediction is returned.
    """
    m = len(y)
    if m == 0:
        return x, P

    centre, psi, radii = x[:2], x[2], x[6:]
    H = np.zeros((2 * m, len(x)))
    R = np.zeros((2 * m, 2 * m))
    y_hat = np.zeros(2 * m)
    for j, y_j in enumerate(y):
        rows = slice(2 * j, 2 * j + 2)
        d = y_j - centre
        distance = np.linalg.norm(d)
        o = (d / distance).reshape(2, 1)
        u = np.array([(np.arctan2(d[1], d[0]) - psi) % (2.0 * np.pi)])

        kb = kernel(u, basis_angles, std_prior, std_radius, length_scale)
        ku = kernel(u, u, std_prior, std_radius, length_scale)
        Hf = kb @ K_inv
        dHf = (-np.sin(u - basis_angles) / length_scale**2 * kb) @ K_inv
        radius = float((Hf @ radii)[0])
        slope = float((dHf @ radii)[0])

        y_hat[rows] = centre + o[:, 0] * radius
        R[rows, rows] = std_meas**2 * np.eye(2) + o @ (ku - kb @ K_inv @ kb.T) @ o.T

        d_o = np.outer(d, d) / distance**3 - np.eye(2) / distance
        d_angle = np.array([[d[1], -d[0]]]) / distance**2
        H[rows, 0:2] = np.eye(2) + d_o * radius + o @ d_angle * slope
        H[rows, 2:3] = -o * slope
        H[rows, 6:] = o @ Hf

    S = H @ P @ H.T + R
    gain = P @ H.T @ np.linalg.inv(S)
    x_new = x + gain @ (y.reshape(2 * m) - y_hat)
    P_new = (np.eye(len(x)) - gain @ H) @ P
    return x_new, 0.5 * (P_new + P_new.T)

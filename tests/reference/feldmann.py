"""Slow textbook arithmetic of the random matrix tracker with measurement noise.

M. Feldmann, D. Fränken and W. Koch, "Tracking of Extended Objects and Group Targets Using Random Matrices",
IEEE Trans. Signal Process. 59 (2011) 1409-1420, doi:10.1109/TSP.2010.2101064: measurement and time update,
in the form with an extent estimate X and a scalar weight alpha. The filter is Algorithm 2 of B. Tuncer and
E. Özkan, IEEE Trans. Signal Process. 69 (2021) 1910-1923, where a forgetting factor acts instead of the time
constant; two such rules are offered besides.

X is the extent matrix whose eigenvalues are the squared semi-axes [length^2]; the measurements spread about
the centre with covariance z X + R. All matrix roots are the symmetric principal ones.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import sqrtm

Array = NDArray[np.float64]
State = tuple[Array, Array, Array, float]

H = np.hstack([np.eye(2), np.zeros((2, 2))])


def symmetric_root(M: Array) -> Array:
    """Symmetric principal square root of a symmetric positive definite matrix."""
    return np.real(sqrtm(M))


def update(x: Array, P: Array, X: Array, alpha: float, y: Array, R: Array, z: float) -> State:
    """Measurement update with all of y (m, 2); X and P are the predicted ones throughout.

    x (4,) position and velocity with covariance P; X (2, 2) extent estimate [length^2] of weight alpha;
    R measurement noise covariance; z spread factor. Without measurements the prediction is returned.
    """
    m = len(y)
    if m == 0:
        return x, P, X, alpha

    y_bar = np.zeros(2)
    for y_j in y:
        y_bar = y_bar + y_j / m
    Y_bar = np.zeros((2, 2))
    for y_j in y:
        Y_bar = Y_bar + np.outer(y_j - y_bar, y_j - y_bar)

    Y = z * X + R
    S = H @ P @ H.T + Y / m
    K = P @ H.T @ np.linalg.inv(S)
    x_new = x + K @ (y_bar - H @ x)
    P_new = P - K @ S @ K.T

    X_root = symmetric_root(X)
    u = X_root @ np.linalg.inv(symmetric_root(S)) @ (y_bar - H @ x)
    N = np.outer(u, u)
    B = X_root @ np.linalg.inv(symmetric_root(Y))
    alpha_new = alpha + m
    X_new = (alpha * X + N + B @ Y_bar @ B.T) / alpha_new
    return x_new, P_new, X_new, alpha_new


def predict(x: Array, P: Array, X: Array, alpha: float, F: Array, Q: Array, T: float, tau: float) -> State:
    """Time update over T [time]; the weight decays towards 2 with time constant tau, X is kept."""
    return F @ x, F @ P @ F.T + Q, X, 2.0 + np.exp(-T / tau) * (alpha - 2.0)


def predict_weight_decay(x: Array, P: Array, X: Array, alpha: float, F: Array, Q: Array, g: float) -> State:
    """Time update with plain forgetting of the weight, alpha <- g alpha; X is kept."""
    return F @ x, F @ P @ F.T + Q, X, g * alpha


def predict_inverse_wishart_decay(
    x: Array, P: Array, X: Array, alpha: float, F: Array, Q: Array, g: float, c: float = 6.0,
    minimum_weight: float = 1.0,
) -> State:  # fmt: skip
    """Time update with forgetting of the inverse-Wishart parameters nu = alpha + c and V = (nu - c) X.

    Both are multiplied by g, so that X = V / (nu - c) grows a little. nu is kept at c + minimum_weight or
    more; a prediction that would pass below leaves X as it is.
    """
    nu = alpha + c
    V = (nu - c) * X
    nu_new = g * nu
    V_new = g * V
    if nu_new < c + minimum_weight:
        nu_new = c + minimum_weight
        V_new = (nu_new - c) * X
    return F @ x, F @ P @ F.T + Q, V_new / (nu_new - c), nu_new - c


def gottingen_read_out(X: Array) -> tuple[float, Array]:
    """Angle [rad] of the one axis that lies in (0, pi/2), and semi-axes [length], the first along that angle.

    The angle is that of an axis, not of the major one. Undefined (nan) or limiting for axis-parallel
    ellipses, as the formula divides by X12.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        rho = np.divide(X[0, 0] - X[1, 1], 2.0 * X[0, 1])
        phi = np.arctan(-rho + np.sqrt(1.0 + rho**2))
    L = np.array([[np.cos(phi), -np.sin(phi)], [np.sin(phi), np.cos(phi)]])
    return float(phi), np.sqrt(np.diag(L.T @ X @ L))


def major_axis_read_out(X: Array) -> tuple[float, Array]:
    """Angle [rad] of the major axis in (-pi/2, pi/2], and semi-axes [length], the major one first."""
    eigenvalues, eigenvectors = np.linalg.eigh(X)
    direction = eigenvectors[:, 1]
    if direction[0] < 0.0 or (direction[0] == 0.0 and direction[1] < 0.0):
        direction = -direction
    angle = np.arctan2(direction[1], direction[0])
    if angle <= -0.5 * np.pi:
        angle = angle + np.pi
    return float(angle), np.sqrt(eigenvalues[::-1])

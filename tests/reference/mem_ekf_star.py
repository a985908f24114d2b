"""Slow textbook arithmetic of the MEM-EKF* ellipse tracker.

S. Yang and M. Baum, "Tracking the Orientation and Axes Lengths of an Elliptical Extended Object", IEEE Trans.
Signal Process. 67 (2019) 4720-4729, doi:10.1109/TSP.2019.2929462: the multiplicative error model and the
sequential measurement update. It is Algorithm 1 of B. Tuncer and E. Özkan, IEEE Trans. Signal Process. 69
(2021) 1910-1923.

Model, with shape p = [theta, l1, l2] and L(theta) the rotation,

    y = H r + L(theta) diag(l1, l2) h + v,    h ~ (0, Ch),  v ~ N(0, Cv),    H = [I2 0].

Measurements are used one after the other, each with statistics evaluated at the newest shape; the result
depends on their order.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
State = tuple[Array, Array, Array, Array]

H = np.hstack([np.eye(2), np.zeros((2, 2))])
PICK = np.array([[1.0, 0, 0, 0], [0, 0, 0, 1.0], [0, 1.0, 0, 0]])
PICK_MIRRORED = np.array([[1.0, 0, 0, 0], [0, 0, 0, 1.0], [0, 0, 1.0, 0]])


def shape_matrix(p: Array) -> Array:
    """S(p) = L(theta) diag(l1, l2) [length]."""
    theta, l1, l2 = p
    L = np.array([[np.cos(theta), -np.sin(theta)], [np.sin(theta), np.cos(theta)]])
    return L @ np.diag([l1, l2])


def row_jacobians(p: Array) -> tuple[Array, Array]:
    """Derivatives (2x3) of the first and of the second row of S(p) with respect to p."""
    theta, l1, l2 = p
    cos, sin = np.cos(theta), np.sin(theta)
    J1 = np.array([[-l1 * sin, cos, 0.0], [-l2 * cos, 0.0, -sin]])
    J2 = np.array([[l1 * cos, sin, 0.0], [-l2 * sin, 0.0, cos]])
    return J1, J2


def update_with_one(r: Array, Cr: Array, p: Array, Cp: Array, y_j: Array, Ch: Array, Cv: Array) -> State:
    """Update kinematics and shape with one measurement y_j (2,)."""
    S = shape_matrix(p)
    S1, S2 = S[0:1, :], S[1:2, :]
    J = row_jacobians(p)
    J1, J2 = J

    C_I = S @ Ch @ S.T
    C_II = np.zeros((2, 2))
    for row in range(2):
        for column in range(2):
            C_II[row, column] = np.trace(Cp @ J[column].T @ Ch @ J[row])
    Cy = H @ Cr @ H.T + C_I + C_II + Cv
    Cy_inv = np.linalg.inv(Cy)
    e = y_j - H @ r

    r_new = r + Cr @ H.T @ Cy_inv @ e
    Cr_new = Cr - Cr @ H.T @ Cy_inv @ H @ Cr

    # Pseudo-measurement of the shape: the products of the centred measurement with itself.
    Y = PICK @ np.kron(e, e)
    Y_bar = PICK @ Cy.reshape(4)
    M = np.vstack([2.0 * S1 @ Ch @ J1, 2.0 * S2 @ Ch @ J2, S1 @ Ch @ J2 + S2 @ Ch @ J1])
    C_Y = PICK @ np.kron(Cy, Cy) @ (PICK + PICK_MIRRORED).T
    C_Y_inv = np.linalg.inv(C_Y)

    p_new = p + Cp @ M.T @ C_Y_inv @ (Y - Y_bar)
    Cp_new = Cp - Cp @ M.T @ C_Y_inv @ M @ Cp

    return r_new, 0.5 * (Cr_new + Cr_new.T), p_new, 0.5 * (Cp_new + Cp_new.T)


def update(r: Array, Cr: Array, p: Array, Cp: Array, y: Array, Ch: Array, Cv: Array) -> State:
    """Measurement update with all of y (m, 2) in the order given.

    r (4,) position and velocity with covariance Cr; p (3,) orientation [rad] and semi-axes [length] with
    covariance Cp; Ch covariance of the multiplicative noise, Cv of the measurement noise [length^2].
    Without measurements the prediction is returned.
    """
    for y_j in y:
        r, Cr, p, Cp = update_with_one(r, Cr, p, Cp, y_j, Ch, Cv)
    return r, Cr, p, Cp


def predict(r: Array, Cr: Array, p: Array, Cp: Array, Ar: Array, Cwr: Array, Cwp: Array) -> State:
    """Time update: linear motion of r with noise Cwr, random walk of the shape with noise Cwp."""
    return Ar @ r, Ar @ Cr @ Ar.T + Cwr, p, Cp + Cwp


def ellipse_read_out(p: Array) -> tuple[float, Array]:
    """Orientation [rad] and semi-axes [length]; the modulus is taken as nothing keeps them positive."""
    return float(p[0]), np.abs(p[1:])

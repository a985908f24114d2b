"""Slow textbook arithmetic of the Gaussian-Wasserstein distance between two ellipses.

S. Yang, M. Baum and K. Granström, "Metrics for Performance Evaluation of Elliptic Extended Object Tracking
Methods", IEEE Int. Conf. Multisensor Fusion and Integration for Intelligent Systems (2016) 523-528; used by
B. Tuncer and E. Özkan, IEEE Trans. Signal Process. 69 (2021) 1910-1923, Sec. VI. The extent matrix has the
squared semi-axes as eigenvalues.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import sqrtm

Array = NDArray[np.float64]


def extent_matrix(theta: float, semi_axes: Array) -> Array:
    """Extent L(theta) diag(semi_axes^2) L(theta)^T [length^2]; the first axis lies along theta [rad]."""
    L = np.array([[np.cos(theta), -np.sin(theta)], [np.sin(theta), np.cos(theta)]])
    return L @ np.diag(np.asarray(semi_axes) ** 2) @ L.T


def centre_term(c1: Array, c2: Array) -> float:
    """Squared distance of the centres [length^2]."""
    return float((c1 - c2) @ (c1 - c2))


def extent_term(X1: Array, X2: Array) -> float:
    """tr(X1 + X2 - 2 (X1^1/2 X2 X1^1/2)^1/2) [length^2]."""
    root = np.real(sqrtm(X1))
    return float(np.trace(X1 + X2 - 2.0 * np.real(sqrtm(root @ X2 @ root))))


def squared_distance(c1: Array, X1: Array, c2: Array, X2: Array) -> float:
    """Squared Gaussian-Wasserstein distance [length^2] of the ellipses (c1, X1) and (c2, X2)."""
    return centre_term(c1, c2) + extent_term(X1, X2)

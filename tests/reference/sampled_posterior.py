"""Brute-force posterior of the elliptic target with explicit orientation, by importance sampling.

The model is that of B. Tuncer and E. Özkan, IEEE Trans. Signal Process. 69 (2021) 1910-1923, Sec. II
(Gaussian kinematics and orientation, inverse-gamma squared semi-axes, independent measurements
y_j ~ N(H x, s L(theta) X L(theta)^T + R)); no variational or linearising step is used here. Orientation and
squared semi-axes are drawn from the prior; for each draw a Kalman filter integrates out the kinematics.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

H = np.hstack([np.eye(2), np.zeros((2, 2))])


class SampledPosterior(NamedTuple):
    """Posterior moments from weighted samples.

    x (4,) and P (4, 4) mean and covariance of the kinematics; theta [rad] circular mean, within pi of the
    prior mean; extent (2, 2) mean of L X L^T [length^2]; effective_sample_size of the normalised weights.
    """

    x: Array
    P: Array
    theta: float
    extent: Array
    effective_sample_size: float


def rotations(theta: Array) -> Array:
    """Rotation matrices (n, 2, 2) of the angles theta (n,) [rad]."""
    cos, sin = np.cos(theta), np.sin(theta)
    return np.stack([np.stack([cos, -sin], axis=-1), np.stack([sin, cos], axis=-1)], axis=-2)


def extents(theta: Array, X: Array) -> Array:
    """Extent matrices L diag(X1, X2) L^T (n, 2, 2) of orientations (n,) and squared semi-axes (n, 2)."""
    L = rotations(theta)
    return L @ (X[:, :, None] * np.eye(2)) @ L.transpose(0, 2, 1)


def condition_on_extent(x: Array, P: Array, C: Array, y: Array) -> tuple[Array, Array, Array]:
    """Kalman filter over the measurements y (m, 2), for each of the n spread covariances C (n, 2, 2) at once.

    Returns conditional means (n, 4), covariances (n, 4, 4) and log likelihoods log p(y | theta, X) (n,).
    """
    n = len(C)
    means = np.tile(x, (n, 1))
    covariances = np.tile(P, (n, 1, 1))
    log_likelihood = np.zeros(n)
    for y_j in y:
        innovation = y_j - means @ H.T
        S = H @ covariances @ H.T + C
        S_inv = np.linalg.inv(S)
        distance = np.einsum("ni,nij,nj->n", innovation, S_inv, innovation)
        log_likelihood = log_likelihood - 0.5 * (distance + np.log(np.linalg.det(2.0 * np.pi * S)))
        gain = covariances @ H.T @ S_inv
        means = means + np.einsum("nij,nj->ni", gain, innovation)
        covariances = covariances - gain @ H @ covariances
    return means, covariances, log_likelihood


def sampled_posterior(
    x: Array, P: Array, theta: float, S: float, a: Array, b: Array, y: Array, R: Array, s: float,
    n_samples: int, seed: int,
) -> SampledPosterior:  # fmt: skip
    """Self-normalised importance sampling of p(x, theta, X | y) with the prior as proposal.

    The arguments are the predicted density, measurements, noise and spread factor of the variational update;
    the error falls as one over the root of the effective sample size.
    """
    generator = np.random.default_rng(seed)
    thetas = theta + np.sqrt(S) * generator.standard_normal(n_samples)
    X = np.stack([b[i] / generator.gamma(a[i], size=n_samples) for i in range(2)], axis=1)
    E = extents(thetas, X)
    means, covariances, log_likelihood = condition_on_extent(x, P, s * E + R, y)

    weights = np.exp(log_likelihood - np.max(log_likelihood))
    weights = weights / np.sum(weights)

    x_mean = np.einsum("n,ni->i", weights, means)
    deviations = means - x_mean
    spread = np.einsum("n,ni,nj->ij", weights, deviations, deviations)
    P_mean = np.einsum("n,nij->ij", weights, covariances) + spread
    theta_mean = theta + np.angle(np.sum(weights * np.exp(1j * (thetas - theta))))
    extent_mean = np.einsum("n,nij->ij", weights, E)
    return SampledPosterior(x_mean, P_mean, float(theta_mean), extent_mean, float(1.0 / np.sum(weights**2)))

"""The image-moment filter of one run as it is used: moments kept apart from zero, the covariance by a square root.

G. Yao, R. Saltus and A. Dani, IEEE Sensors J. 20 (2020), as in `tests.reference.moment_ukf`, with three differences.

* Moments are projected wherever they are used: their larger eigenvalue to a floor at least, the smaller one to a ratio
  of it. The printed filter divides by determinants that may vanish.
* s^2 and f are additive, so that the transform over (p, s^2, f) is one over p with the step of dimension n + 2; the
  same holds for the noise of the turn.
* A point changes the square root of the covariance by Potter's formula (J. E. Potter 1963), and the sigma points of the
  next one come from that root, which is not a Cholesky factor. Sigma points from another root of the same covariance
  give another answer for a function that is not linear.

States are n11, n20, n02, x, vx, y, vy[, turn rate]. All sigma points of a state are one array (n, 2n + 1).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tests.reference.moment_ukf import join
from tests.reference.worlds import EllipseWorld

Array = NDArray[np.float64]
JITTER = 1e-10
"""Added to correlations before they are factored: a covariance may be singular."""

KINEMATIC = np.array([3, 5, 4, 6])
"""Rows of x, y, vx, vy."""


class Rules(NamedTuple):
    """What both modes share."""

    noise_cov: Array
    """Of a point (2, 2) [length^2]."""
    gamma: float
    kappa: float
    beta: float
    """Constants of the scaled unscented transform."""
    floor: float
    """Least larger eigenvalue of the moments [length^2]."""
    ratio: float
    """Least ratio of the smaller to the larger one."""
    dt: float

    def squared_step(self, dimension: int) -> float:
        """Of the sigma points, in the space of this dimension, noise included."""
        return self.gamma**2 * (dimension + self.kappa)


class Straight(NamedTuple):
    """Mode with constant moments and velocity (7 states)."""

    moment_noise: Array
    """Covariance added per step (3, 3) [length^4]."""
    psd: float
    """Of the acceleration on each axis [length^2/time^3]."""


class Turning(NamedTuple):
    """Mode with a coordinated turn (8 states)."""

    moment_noise: Array
    """Covariance added per step (3, 3) [length^4]."""
    acceleration_variance: float
    """Of the acceleration that is held over a step, on each axis [length^2/time^4]."""
    turn_acceleration_variance: float
    """[rad^2/time^4]"""


def started(world: EllipseWorld, moment_cov: Array) -> tuple[Array, Array]:
    """Mean (8,) and covariance (8, 8) of the prior, turn rate included; moment_cov (3, 3) that of the moments."""
    c, s = np.cos(world.orientation), np.sin(world.orientation)
    turn = np.array([[c, -s], [s, c]])
    N = 0.25 * turn @ np.diag(world.semi_axes**2) @ turn.T
    mean = np.array([N[0, 1], N[0, 0], N[1, 1], 0.0, 0.0, 0.0, 0.0, world.turn_rate])
    mean[KINEMATIC] = world.mean
    cov = np.zeros((8, 8))
    cov[:3, :3], cov[np.ix_(KINEMATIC, KINEMATIC)], cov[7, 7] = moment_cov, world.cov, world.turn_rate_variance
    return mean, cov


def root_of(cov: Array) -> Array:
    """Lower Cholesky factor."""
    return np.linalg.cholesky(cov + JITTER * np.diag(np.diag(cov)))


def project(states: Array, rules: Rules) -> Array:
    """States (n, k) with their moments projected; those that comply are left as they are. A circle stays one."""
    n11, n20, n02 = states[:3]
    values, vectors = np.linalg.eigh(np.array([[n20, n11], [n11, n02]]).transpose(2, 0, 1))
    larger = np.maximum(values[:, 1], rules.floor)
    smaller = np.where(values[:, 0] == values[:, 1], larger, np.maximum(values[:, 0], rules.ratio * larger))
    new = np.stack([smaller, larger], axis=1)
    N = (vectors * new[:, None]) @ vectors.transpose(0, 2, 1)
    acts = (new != values).any(axis=1)
    moments = np.where(acts, np.stack([N[:, 0, 1], N[:, 0, 0], N[:, 1, 1]]), states[:3])
    return np.concatenate([moments, states[3:]])


def sigma_points(mean: Array, root: Array, c: float, rules: Rules) -> tuple[Array, Array, Array]:
    """Points (n, 2n + 1), the mean first, and their weights in means and in covariances."""
    n, step = len(mean), np.sqrt(c) * root
    w_mean = np.full(2 * n + 1, 0.5 / c)
    w_mean[0] = 1.0 - n / c
    w_cov = w_mean.copy()
    w_cov[0] += 1.0 - rules.gamma**2 + rules.beta
    return np.column_stack([mean, mean[:, None] + step, mean[:, None] - step]), w_mean, w_cov


def squared_scale(states: Array, z: Array, rules: Rules) -> Array:
    """q = 1/4 d' N^-1 d of states (n, k): 1 on the ellipse through z, 0 at its centre."""
    n11, n20, n02 = project(states, rules)[:3]
    dx, dy = z[0] - states[3], z[1] - states[5]
    return 0.25 * (n02 * dx * dx - 2.0 * n11 * dx * dy + n20 * dy * dy) / (n20 * n02 - n11 * n11)


def expected(mean: Array, root: Array, z: Array, rules: Rules) -> tuple[float, float, Array]:
    """Mean and variance of the pseudo-measurement q - s^2 - f, and u: root @ u is its covariance with the state."""
    n, c, R = len(mean), rules.squared_step(len(mean) + 2), rules.noise_cov
    points, w_mean, w_cov = sigma_points(mean, root, c, rules)
    values = squared_scale(points, z, rules)
    q = w_mean @ values
    u = (values[1 : n + 1] - values[n + 1 :]) / (2.0 * np.sqrt(c))
    n11, n20, n02 = project(mean[:, None], rules)[:3, 0]
    M = 0.25 * np.linalg.inv(np.array([[n20, n11], [n11, n02]]))
    d = z - mean[[3, 5]]
    f_var = 2.0 * np.trace(M @ R @ M @ R) + 4.0 * d @ M @ R @ M @ d
    return q - 0.5 - np.trace(M @ R), w_cov @ (values - q) ** 2 + 1.0 / 12.0 + f_var, u


def update(mean: Array, root: Array, points: Array, rules: Rules) -> tuple[Array, Array, float]:
    """Update by points (m, 2) in their order, and the average log-likelihood of a point under the prediction."""
    if len(points) == 0:
        return mean, root, 0.0
    terms = [expected(mean, root, z, rules)[:2] for z in points]
    average = np.mean([-0.5 * (phi**2 / S + np.log(2.0 * np.pi * S)) for phi, S in terms])
    for z in points:
        phi, S, u = expected(mean, root, z, rules)
        gain = root @ u
        mean = project((mean - gain * phi / S)[:, None], rules)[:, 0]
        root = root - np.outer(gain, u) / (S * (1.0 + np.sqrt(max(1.0 - u @ u / S, 0.0))))
    return mean, root, float(average)


def predict_straight(mean: Array, root: Array, mode: Straight, rules: Rules) -> tuple[Array, Array]:
    """Kalman prediction."""
    dt = rules.dt
    axis = np.array([[1.0, dt], [0.0, 1.0]])
    F = join(np.eye(3), axis, axis)
    W = mode.psd * np.array([[dt**3 / 3.0, dt**2 / 2.0], [dt**2 / 2.0, dt]])
    moved = F @ root
    return F @ mean, root_of(moved @ moved.T + join(mode.moment_noise, W, W))


def turned(states: Array, dt: float) -> Array:
    """Coordinated turn of states (8, k)."""
    n11, n20, n02, x, vx, y, vy, rate = states
    angle = rate * dt
    c, s = np.cos(angle), np.sin(angle)
    along = dt * np.sinc(angle / np.pi)
    across = dt * 0.5 * angle * np.sinc(0.5 * angle / np.pi) ** 2
    moments = [
        (c * c - s * s) * n11 + c * s * (n20 - n02),
        c * c * n20 - 2.0 * c * s * n11 + s * s * n02,
        s * s * n20 + 2.0 * c * s * n11 + c * c * n02,
    ]
    position = [x + along * vx - across * vy, c * vx - s * vy, y + across * vx + along * vy, s * vx + c * vy]
    return np.array([*moments, *position, rate])


def predict_turn(mean: Array, root: Array, mode: Turning, rules: Rules) -> tuple[Array, Array]:
    """Unscented prediction."""
    dt = rules.dt
    points, w_mean, w_cov = sigma_points(mean, root, rules.squared_step(8 + 6), rules)
    moved = turned(points, dt)
    new = moved @ w_mean
    gaps = moved - new[:, None]
    W = mode.acceleration_variance * np.outer([dt**2 / 2.0, dt], [dt**2 / 2.0, dt])
    noise = join(mode.moment_noise, W, W, np.array([[mode.turn_acceleration_variance * dt**2]]))
    return new, root_of((w_cov * gaps) @ gaps.T + noise)


def ellipse_read_out(mean: Array) -> tuple[Array, float]:
    """Semi-axes [length], the major one first, and its direction [rad] in (-pi/2, pi/2]."""
    n11, n20, n02 = mean[:3]
    values = np.linalg.eigvalsh(np.array([[n20, n11], [n11, n02]]))[::-1]
    return 2.0 * np.sqrt(values), float(0.5 * np.arctan2(2.0 * n11, n20 - n02))

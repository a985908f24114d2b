"""Slow textbook arithmetic of the image-moment unscented Kalman filter: every noise is a component of the sigma points.

G. Yao, R. Saltus and A. Dani, IEEE Sensors J. 20 (2020): Algorithm 1 for the update by one point, eqs. 15-20 for the
turn; E. A. Wan and R. van der Merwe 2000 for the weights. States are n11, n20, n02, x, vx, y, vy[, turn rate].
"""

import numpy as np


def sigma_points(mean, cov, gamma, kappa, beta):
    """Points as columns, weights of mean and covariance."""
    n = len(mean)
    lam = gamma**2 * (n + kappa) - n
    root = np.linalg.cholesky((n + lam) * cov)
    points = np.column_stack([mean, mean[:, None] + root, mean[:, None] - root])
    w_mean = np.full(2 * n + 1, 0.5 / (n + lam))
    w_mean[0] = lam / (n + lam)
    w_cov = w_mean.copy()
    w_cov[0] += 1.0 - gamma**2 + beta
    return points, w_mean, w_cov


def join(*blocks):
    """Block-diagonal matrix."""
    n = sum(len(block) for block in blocks)
    result, at = np.zeros((n, n)), 0
    for block in blocks:
        result[at : at + len(block), at : at + len(block)] = block
        at += len(block)
    return result


def squared_scale(state, z):
    """g: 1/4 d' N^-1 d at one state."""
    N = np.array([[state[1], state[0]], [state[0], state[2]]])
    d = z - state[[3, 5]]
    return 0.25 * d @ np.linalg.solve(N, d)


def update(mean, cov, z, R, gamma, kappa, beta):
    """Update by one point with (p, s^2, f) augmented; the sensor noise R is diagonal. Also mean and variance of g."""
    n11, n20, n02 = mean[:3]
    dx, dy = z - mean[[3, 5]]
    sx2, sy2 = R[0, 0], R[1, 1]
    rho = 1.0 / (4.0 * (n20 * n02 - n11**2))
    f_mean = rho * (n02 * sx2 + n20 * sy2)
    f_var = rho**2 * (
        2 * n02**2 * sx2**2 + 2 * n20**2 * sy2**2 + 4 * n11**2 * sx2 * sy2
        + 4 * (n02 * dx - n11 * dy) ** 2 * sx2 + 4 * (n20 * dy - n11 * dx) ** 2 * sy2
    )  # fmt: skip
    n = len(mean)
    points, w_mean, w_cov = sigma_points(
        np.concatenate([mean, [0.5, f_mean]]), join(cov, np.diag([1.0 / 12.0, f_var])), gamma, kappa, beta
    )
    values = np.array([squared_scale(p[:n], z) - p[n] - p[n + 1] for p in points.T])
    phi = w_mean @ values
    S = w_cov @ (values - phi) ** 2
    K = (points[:n] - mean[:, None]) @ (w_cov * (values - phi)) / S
    return mean - K * phi, cov - S * np.outer(K, K), phi, S


def turned(state, noise, dt):
    """Coordinated turn of one state with noise of moments (3), accelerations (2) and turn acceleration."""
    n11, n20, n02, x, vx, y, vy, w = state
    a = w * dt
    C = np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]])
    N = C @ np.array([[n20, n11], [n11, n02]]) @ C.T
    s, c = (np.sin(a) / w, (1.0 - np.cos(a)) / w) if abs(w) > 1e-9 else (dt, 0.0)
    v = C @ [vx, vy]
    moved = np.array([N[0, 1], N[0, 0], N[1, 1], x + s * vx - c * vy, v[0], y + c * vx + s * vy, v[1], w])
    half = 0.5 * dt**2
    gain = [*noise[:3], half * noise[3], dt * noise[3], half * noise[4], dt * noise[4], dt * noise[5]]
    return moved + np.array(gain)


def predict_turn(mean, cov, noise_cov, dt, gamma, kappa, beta):
    """Unscented prediction with the six noises augmented; noise_cov (6, 6)."""
    points, w_mean, w_cov = sigma_points(np.concatenate([mean, np.zeros(6)]), join(cov, noise_cov), gamma, kappa, beta)
    moved = np.stack([turned(p[:8], p[8:], dt) for p in points.T], axis=1)
    new = moved @ w_mean
    gaps = moved - new[:, None]
    return new, (w_cov * gaps) @ gaps.T


def predict_straight(mean, cov, moment_noise, psd, dt):
    """Kalman prediction with constant moments and velocity."""
    axis = np.array([[1.0, dt], [0.0, 1.0]])
    F = join(np.eye(3), axis, axis)
    W = psd * np.array([[dt**3 / 3.0, dt**2 / 2.0], [dt**2 / 2.0, dt]])
    return F @ mean, F @ cov @ F.T + join(moment_noise, W, W)


def merge(mu, means, covs, n):
    """Moment-matched Gaussian of n components; a missing last component is zero, known exactly."""
    m, C = [], []
    for mean, cov in zip(means, covs, strict=True):
        full, wide = np.zeros(8), np.zeros((8, 8))
        full[: len(mean)], wide[: len(mean), : len(mean)] = mean, cov
        m.append(full[:n]), C.append(wide[:n, :n])
    center = sum(w * x for w, x in zip(mu, m, strict=True))
    spread = sum(w * (P + np.outer(x - center, x - center)) for w, x, P in zip(mu, m, C, strict=True))
    return center, spread

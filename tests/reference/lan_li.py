"""Slow textbook arithmetic of the random matrix with rotation and agility, and of two of them as modes.

J. Lan and X. R. Li, IEEE Trans. Aerosp. Electron. Syst. 52 (2016) 2973-2989, as used by Yao, Saltus and Dani 2020.
State: x (4,) as x, y, vx, vy; P (2, 2) on one axis in units of the extent; nu degrees of freedom; V scale matrix of the
inverse Wishart, mean V / (nu - 6).
"""

import numpy as np
from scipy.linalg import sqrtm
from scipy.special import multigammaln


def predict(x, P, nu, V, dt, psd, delta, angle):
    """Time update over dt."""
    F = np.array([[1.0, dt], [0.0, 1.0]])
    D = psd * np.array([[dt**3 / 3.0, dt**2 / 2.0], [dt**2 / 2.0, dt]])
    lam = nu - 6.0
    A = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]) / np.sqrt(delta)
    mean = delta * A @ (V / lam) @ A.T
    nu = 2.0 * delta * (lam + 1.0) * (lam - 1.0) * (lam - 2.0) / (lam**2 * (lam + delta)) + 8.0
    return np.kron(F, np.eye(2)) @ x, F @ P @ F.T + D, nu, (nu - 6.0) * mean


def update(x, P, nu, V, y, R, z):
    """Measurement update by all of y (m, 2), and the log-likelihood of the scan."""
    n = len(y)
    if n == 0:
        return (x, P, nu, V), 0.0
    mean = V / (nu - 6.0)
    B = np.real(sqrtm(z * mean + R)) @ np.linalg.inv(np.real(sqrtm(mean)))
    H = np.array([[1.0, 0.0]])
    S = (H @ P @ H.T).item() + abs(np.linalg.det(B)) / n
    K = P @ H.T / S
    center = y.mean(axis=0)
    G = center - np.kron(H, np.eye(2)) @ x
    scatter = sum(np.outer(p - center, p - center) for p in y)
    B_inv = np.linalg.inv(B)
    V_new = V + np.outer(G, G) / S + B_inv @ scatter @ B_inv.T
    nu_new = nu + n
    a, b = 0.5 * (nu - 3.0), 0.5 * (nu_new - 3.0)
    log_likelihood = (
        -n * np.log(np.pi)
        - np.log(n)
        - np.log(S)
        - (n - 1) * np.log(abs(np.linalg.det(B)))
        + multigammaln(b, 2)
        - multigammaln(a, 2)
        + a * np.log(np.linalg.det(V))
        - b * np.log(np.linalg.det(V_new))
    )
    return (x + np.kron(K, np.eye(2)) @ G, P - S * (K @ K.T), nu_new, V_new), log_likelihood


def merge(mu, states):
    """One state for a mixture: total variance of the extent by its second moments."""
    means = [V / (nu - 6.0) for _, _, nu, V in states]
    X0 = sum(m * X for m, X in zip(mu, means, strict=True))
    x0 = sum(m * s[0] for m, s in zip(mu, states, strict=True))
    P0 = np.zeros((2, 2))
    for a in range(2):
        for b in range(2):
            inner = np.zeros((2, 2))
            for m, s, X in zip(mu, states, means, strict=True):
                d = (s[0] - x0).reshape(2, 2)
                inner = inner + m * (s[1][a, b] * X + np.outer(d[a], d[b]))
            P0[a, b] = 0.5 * np.trace(np.linalg.inv(X0) @ inner)
    P0 = 0.5 * (P0 + P0.T)
    total = -np.trace(X0 @ X0)
    for m, s, X in zip(mu, states, means, strict=True):
        lam, square, trace = s[2] - 6.0, np.trace(X @ X), np.trace(X)
        own = ((lam + 2.0) * square + lam * trace**2) / ((lam + 1.0) * (lam - 2.0))
        total = total + m * (own + square)
    A, b = np.trace(X0 @ X0), np.trace(X0) ** 2
    c = total + A + b
    lam = (c + np.sqrt(c**2 + 8.0 * total * (total + A))) / (2.0 * total)
    return x0, P0, lam + 6.0, lam * X0

"""Interacting shape models in plain NumPy, component by component, written from the equations.

Source: Zea, Faion and Hanebeck 2014; the object is the paper's arm, its state (l_a, α_a, ω_a, l_b, α_b, ω_b, α_c, ω_c).
"""

import numpy as np
from scipy.stats import chi2, multivariate_normal

FINGER, RADIUS = 0.75, 0.3
MOVE = np.eye(8)
MOVE[[1, 4, 6], [2, 5, 7]] = 1.0


def frames(x):
    """Start, direction and length of the four segments."""
    beta_1 = x[1]
    beta_2 = beta_1 + x[4] - np.pi
    elbow = x[0] * np.array([np.cos(beta_1), np.sin(beta_1)])
    hand = elbow + x[3] * np.array([np.cos(beta_2), np.sin(beta_2)])
    return [
        (np.zeros(2), beta_1, x[0]),
        (elbow, beta_2, x[3]),
        (hand, beta_2 + x[6] / 2, FINGER),
        (hand, beta_2 - x[6] / 2, FINGER),
    ]


def residual(x, k, s, y):
    start, beta, length = frames(x)[k]
    turn = np.array([[np.cos(beta), -np.sin(beta)], [np.sin(beta), np.cos(beta)]])
    return np.array([length * s, 0.0]) - turn.T @ (y - start)


def component(x, cov, y, sigma2, samples, m, augmented=False):
    """(updated mean, covariance, log density per area, squared distance) for component m, 0 the disc."""
    if m == 0:
        h = y @ y - RADIUS**2 / 2 - 2 * sigma2
        variance = RADIUS**4 / 12 + 4 * sigma2**2 + 2 * sigma2 * RADIUS**2
        return x, cov, -0.5 * (h * h / variance + np.log(2 * np.pi * variance)) - np.log(np.pi), h * h / variance
    steps = samples[:, :8] @ np.linalg.cholesky(cov).T
    shares = 0.5 + samples[:, 8] / np.sqrt(12.0)
    noise = np.sqrt(sigma2) * samples[:, 9:11] if augmented else np.zeros((len(samples), 2))
    h = np.array([residual(x + d, m - 1, s, y - v) for d, s, v in zip(steps, shares, noise, strict=True)])
    center = h.mean(axis=0)
    spread = (h - center).T @ (h - center) / len(h) + (0.0 if augmented else sigma2) * np.eye(2)
    cross = steps.T @ (h - center) / len(h)
    gain = cross @ np.linalg.inv(spread)
    log_density = multivariate_normal(np.zeros(2), spread).logpdf(center)
    distance = center @ np.linalg.solve(spread, center)
    return x - gain @ center, cov - gain @ spread @ gain.T, log_density, distance


def matched(weights, means, covs):
    mean = sum(w * x for w, x in zip(weights, means, strict=True))
    return mean, sum(w * (p + np.outer(x - mean, x - mean)) for w, x, p in zip(weights, means, covs, strict=True))


def normalised(logs):
    w = np.exp(np.asarray(logs) - np.max(logs))
    return w / w.sum()


def random_switch(points, x, cov, sigma2, q, samples, gate=None, clutter=None, **options):
    """Means after every point."""
    found = []
    for y in points:
        x, cov = MOVE @ x, MOVE @ cov @ MOVE.T + q * np.eye(8)
        means, covs, logs, distances = map(
            list, zip(*(component(x, cov, y, sigma2, samples, m, **options) for m in range(5)), strict=True)
        )
        prior = np.full(5, 0.2)
        if clutter is not None:
            prior = np.append(0.2 * (1 - clutter[0]) * np.ones(5), clutter[0])
            means, covs, logs = [*means, x], [*covs, cov], [*logs, -np.log(clutter[1])]
        bounds = chi2.ppf(gate, [1, 2, 2, 2, 2]) if gate else np.full(5, np.inf)
        if (np.array(distances) < bounds).any():
            x, cov = matched(normalised(np.array(logs) + np.log(prior)), means, covs)
        found.append(x)
    return np.array(found)


def markov(points, x, cov, sigma2, q, samples, transition, second_order):
    """Means after every point, of IMM or GPB2; rows of the transition matrix: from."""
    n = len(transition)
    states, mu, found = [(x, cov)] * n, np.full(n, 1.0 / n), []

    def predicted(state):
        return MOVE @ state[0], MOVE @ state[1] @ MOVE.T + q * np.eye(8)

    for y in points:
        joint = mu[:, None] * transition
        if second_order:
            pairs = [[component(*predicted(states[i]), y, sigma2, samples, j) for j in range(n)] for i in range(n)]
            with np.errstate(divide="ignore"):  # a pair may be impossible
                logs = np.log(joint) + np.array([[p[2] for p in row] for row in pairs])
            states = []
            for j in range(n):
                weights = normalised(logs[:, j])
                states.append(matched(weights, [pairs[i][j][0] for i in range(n)], [pairs[i][j][1] for i in range(n)]))
            mu = normalised(logs).sum(axis=0)
        else:
            c = joint.sum(axis=0)
            mixed = [matched(joint[:, j] / c[j], [s[0] for s in states], [s[1] for s in states]) for j in range(n)]
            updates = [component(*predicted(s), y, sigma2, samples, j) for j, s in enumerate(mixed)]
            mu = normalised(np.log(c) + np.array([u[2] for u in updates]))
            states = [u[:2] for u in updates]
        found.append(matched(mu, [s[0] for s in states], [s[1] for s in states])[0])
    return np.array(found)

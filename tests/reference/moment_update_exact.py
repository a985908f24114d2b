"""The image-moment update by one point as printed, in 50-digit arithmetic; run as a program it writes its golden file.

Yao, Saltus and Dani 2020, Algorithm 1: sigma points of (p, s², f), weighted moments, gain. Nothing is collapsed.
"""

import json
from pathlib import Path

import mpmath
import numpy as np
from mpmath import mpf

mpmath.mp.dps = 50
FILE = Path(__file__).parents[1] / "golden" / "moment_update.json"
SPREADS = ((1.0, 0.0, 2.0), (1.0, -6.0, 2.0), (0.5, 0.0, 2.0), (0.9, 0.5, 0.81), (1.5, 1.0, 2.25))


def squared_scale(state, point):
    """1/4 d' N^-1 d."""
    n11, n20, n02 = state[:3]
    dx, dy = point[0] - state[3], point[1] - state[5]
    return (n02 * dx * dx - 2 * n11 * dx * dy + n20 * dy * dy) / (4 * (n20 * n02 - n11 * n11))


def update(mean, root, point, variances, spread):
    """Posterior mean and covariance, predicted pseudo-measurement and its variance.

    Args:
        root: lower Cholesky factor of the covariance.
        variances: of the sensor noise along x and y.
        spread: gamma, kappa, beta.
    """
    mean, point, (sx2, sy2) = [mpf(x) for x in mean], [mpf(x) for x in point], map(mpf, variances)
    gamma, kappa, beta = map(mpf, spread)
    n = len(mean)
    (n11, n20, n02), dx, dy = mean[:3], point[0] - mean[3], point[1] - mean[5]
    rho = 1 / (4 * (n20 * n02 - n11 * n11))
    f_mean = rho * (n02 * sx2 + n20 * sy2)
    f_variance = rho**2 * (
        2 * n02**2 * sx2**2 + 2 * n20**2 * sy2**2 + 4 * n11**2 * sx2 * sy2
        + 4 * (n02 * dx - n11 * dy) ** 2 * sx2 + 4 * (n20 * dy - n11 * dx) ** 2 * sy2
    )  # fmt: skip
    size = n + 2
    center = [*mean, mpf(1) / 2, f_mean]
    columns = [[mpf(float(root[i][j])) for i in range(n)] + [mpf(0), mpf(0)] for j in range(n)]
    columns += [[mpf(0)] * n + [mpmath.sqrt(mpf(1) / 12), mpf(0)], [mpf(0)] * (n + 1) + [mpmath.sqrt(f_variance)]]
    c = gamma**2 * (size + kappa)
    step = mpmath.sqrt(c)
    points = [center]
    for sign in (1, -1):
        points += [[a + sign * step * b for a, b in zip(center, column, strict=True)] for column in columns]
    w_mean = [1 - size / c] + [1 / (2 * c)] * (2 * size)
    w_cov = [w_mean[0] + 1 - gamma**2 + beta, *w_mean[1:]]
    values = [squared_scale(p, point) - p[n] - p[n + 1] for p in points]
    phi = mpmath.fsum(w * g for w, g in zip(w_mean, values, strict=True))
    S = mpmath.fsum(w * (g - phi) ** 2 for w, g in zip(w_cov, values, strict=True))
    gain = [
        mpmath.fsum(w * (p[i] - mean[i]) * (g - phi) for w, p, g in zip(w_cov, points, values, strict=True)) / S
        for i in range(n)
    ]
    cov = [
        [mpmath.fsum(columns[k][i] * columns[k][j] for k in range(n)) - S * gain[i] * gain[j] for j in range(n)]
        for i in range(n)
    ]
    return [m - k * phi for m, k in zip(mean, gain, strict=True)], cov, phi, S


def plain(value):
    """Nested lists of floats."""
    return [plain(v) for v in value] if isinstance(value, list) else float(value)


def cases():
    """Random updates: round and slender objects, points inside and far outside, every spread."""
    rng = np.random.default_rng(20)
    for k in range(30):
        n = 7 + k % 2
        axes, angle = np.sort(rng.uniform(1.0, 40.0, 2))[::-1], rng.uniform(0.0, np.pi)
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        N = turn @ np.diag(axes**2 / 4.0) @ turn.T
        place = rng.normal(0.0, 100.0, 2)
        mean = [N[0, 1], N[0, 0], N[1, 1], place[0], rng.normal(), place[1], rng.normal(), rng.normal(0.0, 0.1)][:n]
        scale = np.array([0.03 * N[0, 0]] * 3 + [2.0, 0.5, 2.0, 0.5, 0.05])[:n]
        root = np.linalg.cholesky(np.eye(n) + 0.2 * np.ones((n, n))) * scale[:, None]
        point = place + turn @ (axes * rng.normal(0.0, 1.0, 2))
        variances = rng.uniform(0.1, 4.0, 2)
        spread = SPREADS[k % len(SPREADS)]
        new, cov, phi, S = update(mean, root.tolist(), point.tolist(), variances.tolist(), spread)
        given = {"mean": mean, "root": root.tolist(), "point": point.tolist(), "R": np.diag(variances).tolist()}
        given |= dict(zip(("gamma", "kappa", "beta"), spread, strict=True))
        yield given | {"mean_upd": new, "cov_upd": cov, "phi": phi, "S": S}


def main():
    """Writes the golden file."""
    content = {
        "kind": "moment_update",
        "source": "tests/reference/moment_update_exact.py: the equations of Yao, Saltus and Dani 2020, Algorithm 1",
        "produced_by": "50-digit arithmetic (mpmath)",
        "fields": {
            "mean": "(n11, n20, n02, x, vx, y, vy[, turn rate])",
            "root": "lower Cholesky factor of the covariance: sigma points depend on it",
            "phi, S": "predicted pseudo-measurement of the point and its variance",
        },
        "cases": [{key: plain(value) for key, value in case.items()} for case in cases()],
    }
    FILE.write_text(json.dumps(content, separators=(",", ":")) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()

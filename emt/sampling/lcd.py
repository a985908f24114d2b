"""Deterministic samples of a standard normal density by the localised cumulative distribution (LCD).

The distance between N(0, I) and a set of equally weighted points compares Gaussian-weighted masses at every place and
every width b up to b_max; it has a closed form but for one-dimensional integrals over b. Sets are point-symmetric, so
all odd moments are exact, and are standardised, so the covariance is exact too.

Source: U. D. Hanebeck, M. F. Huber and V. Klumpp 2009; J. Steinbring and U. D. Hanebeck 2013 for the symmetric sets.
"""

from functools import cache
from typing import NamedTuple

import numpy as np
from scipy.special import expi

RESTARTS = 8
OPTIONS = {"gtol": 1e-9, "ftol": 1e-15, "maxiter": 10_000, "maxcor": 30}
NODES = 40
"""Of the Gauss-Legendre rule on each panel; to double precision."""


class Parts(NamedTuple):
    """D = normal - 2 mixed + points, without the common factor π^(d/2)."""

    normal: float
    mixed: float
    points: float

    @property
    def distance(self) -> float:
        """The squared distance D."""
        return self.normal - 2.0 * self.mixed + self.points


def widest(dimension: int) -> float:
    """b_max, the largest width that is compared."""
    return 5.0 if dimension == 1 else 10.0 if dimension <= 10 else 50.0


@cache
def widths(dimension: int) -> tuple[np.ndarray, np.ndarray]:
    """Widths b and weights of the integrals over (0, b_max): Gauss-Legendre on panels that double in length."""
    edges, last = [0.0, 0.25], widest(dimension)
    while edges[-1] < last:
        edges.append(min(2.0 * edges[-1], last))
    x, w = np.polynomial.legendre.leggauss(NODES)
    low, high = np.array(edges[:-1])[:, None], np.array(edges[1:])[:, None]
    return (0.5 * (high + low) + 0.5 * (high - low) * x).ravel(), (0.5 * (high - low) * w).ravel()


def parts(points: np.ndarray) -> Parts:
    """The distance of equally weighted points (count, dimension) to N(0, I)."""
    count, dimension = points.shape
    b, w = widths(dimension)
    normal = float(np.sum(w * b * (b * b / (1.0 + b * b)) ** (0.5 * dimension)))
    mixed, _ = _mixed(points)
    among, _ = _among(points)
    return Parts(normal, mixed / count, among / count**2)


def _mixed(points: np.ndarray) -> tuple[float, np.ndarray]:
    """Sum over points of the mixed integral, and its gradient."""
    b, w = widths(points.shape[1])
    scale = 1.0 + 2.0 * b * b
    factor = w * b * (1.0 - 1.0 / scale) ** (0.5 * points.shape[1])
    terms = factor * np.exp(-0.5 * (points**2).sum(axis=1)[:, None] / scale)
    return float(terms.sum()), -points * (terms / scale).sum(axis=1)[:, None]


def _among(points: np.ndarray) -> tuple[float, np.ndarray]:
    """Sum over pairs of points of their integral, and its gradient; the exponentials cancel in the gradient."""
    b_max = widest(points.shape[1])
    gaps = points[:, None, :] - points[None, :, :]
    squares = (gaps**2).sum(axis=-1)
    q = squares / (4.0 * b_max**2)
    tail = expi(-np.where(q > 0.0, q, 1.0)) * (q > 0.0)
    total = (0.5 * b_max**2 * np.exp(-q) + 0.125 * squares * tail).sum()
    return float(total), 0.5 * (gaps * tail[:, :, None]).sum(axis=1)


def mirrored(half: np.ndarray, count: int) -> np.ndarray:
    """x, -x for every point, and the origin if the count is odd."""
    pairs = np.stack([half, -half], axis=1).reshape(-1, half.shape[1])
    return np.vstack([pairs, np.zeros((count - len(pairs), half.shape[1]))])


def symmetric_set(dimension: int, count: int, seed: int = 0, restarts: int = RESTARTS) -> np.ndarray:
    """The symmetric set of least distance, before standardising (count, dimension).

    Raises:
        ValueError: fewer points than twice the dimension cannot have covariance I.
    """
    from scipy.optimize import minimize  # takes a while to load, and sets are computed once

    if count < 2 * dimension:
        raise ValueError(f"{count} samples are too few for dimension {dimension}: at least {2 * dimension} are needed")
    free = count // 2

    def objective(flat):
        points = mirrored(flat.reshape(free, dimension), count)
        mixed, mixed_slope = _mixed(points)
        among, among_slope = _among(points)
        slope = among_slope / count**2 - 2.0 * mixed_slope / count
        return among / count**2 - 2.0 * mixed / count, 2.0 * slope[: 2 * free : 2].ravel()  # x and -x move together

    rng = np.random.default_rng([seed, dimension, count])
    found = [
        minimize(objective, rng.normal(size=free * dimension), jac=True, method="L-BFGS-B", options=OPTIONS)
        for _ in range(restarts)
    ]
    best = min(found, key=lambda result: result.fun)
    return mirrored(best.x.reshape(free, dimension), count)


def standardised(points: np.ndarray) -> np.ndarray:
    """The set with covariance I, by the symmetric inverse root of its own."""
    values, vectors = np.linalg.eigh(points.T @ points / len(points))
    return points @ (vectors / np.sqrt(values)) @ vectors.T

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
ALIKE = 1e-8
"""Sets whose distances differ less count as equally good, most often one set turned: the first of them is taken, so
that rounding does not choose."""
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
    from scipy.spatial.distance import pdist

    count, dimension = points.shape
    b, w = widths(dimension)
    normal = float(np.sum(w * b * (b * b / (1.0 + b * b)) ** (0.5 * dimension)))
    mixed, _ = _mixed((points**2).sum(axis=1), dimension)
    among, _ = _among(pdist(points, "sqeuclidean"), dimension)
    alone, _ = _among(np.zeros(1), dimension)
    return Parts(normal, float(mixed.sum()) / count, float(2.0 * among.sum() + count * alone[0]) / count**2)


def _mixed(squares: np.ndarray, dimension: int) -> tuple[np.ndarray, np.ndarray]:
    """The mixed integral of points at these squared distances from the origin, and its derivatives by them."""
    b, w = widths(dimension)
    scale = 1.0 + 2.0 * b * b
    factor = w * b * (1.0 - 1.0 / scale) ** (0.5 * dimension)
    terms = factor * np.exp(-0.5 * squares[:, None] / scale)
    return terms.sum(axis=1), -0.5 * (terms / scale).sum(axis=1)


def _among(squares: np.ndarray, dimension: int) -> tuple[np.ndarray, np.ndarray]:
    """The integral of pairs of points at these squared distances, and its derivatives by them, in which the
    exponentials cancel; that of a point with itself, which no move changes, is given as 0."""
    b_max = widest(dimension)
    q = squares / (4.0 * b_max**2)
    tail = expi(-np.where(q > 0.0, q, 1.0)) * (q > 0.0)
    return 0.5 * b_max**2 * np.exp(-q) + 0.125 * squares * tail, 0.125 * tail


def mirrored(half: np.ndarray, count: int) -> np.ndarray:
    """x, -x for every point, and the origin if the count is odd."""
    pairs = np.stack([half, -half], axis=1).reshape(-1, half.shape[1])
    return np.vstack([pairs, np.zeros((count - len(pairs), half.shape[1]))])


def of_half(half: np.ndarray, count: int) -> tuple[float, np.ndarray]:
    """The distance of a symmetric set less its constant terms, and the gradient by the points of one half.

    The pairs x, x' and x, -x' of one half, and those of x with the origin if the set holds it, stand for all.
    """
    from scipy.spatial.distance import cdist, pdist, squareform

    dimension, origin = half.shape[1], count % 2
    squares = (half**2).sum(axis=1)
    mixed, mixed_slope = _mixed(squares, dimension)
    near, near_slope = _among(pdist(half, "sqeuclidean"), dimension)
    far, far_slope = _among(cdist(half, -half, "sqeuclidean"), dimension)
    middle, middle_slope = _among(squares, dimension)
    value = (4.0 * near.sum() + 2.0 * far.sum() + 4.0 * origin * middle.sum()) / count**2 - 4.0 * mixed.sum() / count
    near_slope = squareform(near_slope)
    own = (near_slope + far_slope).sum(axis=1) + origin * middle_slope
    pull = own[:, None] * half - (near_slope - far_slope) @ half
    return float(value), 8.0 / count**2 * pull - 8.0 / count * mixed_slope[:, None] * half


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
        value, slope = of_half(flat.reshape(free, dimension), count)
        return value, slope.ravel()

    rng = np.random.default_rng([seed, dimension, count])
    found = [
        minimize(objective, rng.normal(size=free * dimension), jac=True, method="L-BFGS-B", options=OPTIONS)
        for _ in range(restarts)
    ]
    least = min(result.fun for result in found)
    best = next(result for result in found if result.fun - least < ALIKE)
    return mirrored(best.x.reshape(free, dimension), count)


def standardised(points: np.ndarray) -> np.ndarray:
    """The set with covariance I, by the symmetric inverse root of its own."""
    values, vectors = np.linalg.eigh(points.T @ points / len(points))
    return points @ (vectors / np.sqrt(values)) @ vectors.T

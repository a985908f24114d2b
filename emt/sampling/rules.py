"""Points and weights that stand for a standard normal density, by name of the rule."""

import hashlib
import json
import os
import tempfile
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from emt.device import cache_folder
from emt.sampling.lcd import RESTARTS, parts, standardised, symmetric_set

VERSION = 2
"""Of stored LCD sets; sets of another version are computed anew."""
Rule = Literal["lcd", "unscented", "cubature"]


class StandardPoints(NamedTuple):
    """Weighted points of mean 0 and covariance I."""

    points: np.ndarray
    """(count, dimension)"""
    weights: np.ndarray
    """(count,), of sum 1."""


def standard_points(
    rule: Rule, dimension: int, count: int | None = None, seed: int = 0, kappa: float | None = None
) -> StandardPoints:
    """The points of a rule.

    Args:
        count: number of LCD samples, at least twice the dimension; the other rules have their own.
        seed: of the starts of the LCD optimisation.
        kappa: of the unscented rule, 3 - dimension by default, greater than -dimension.

    Raises:
        ValueError: the count is too small, or a weight would not be finite.
    """
    if rule == "lcd":
        count = 2 * dimension if count is None else count
        return StandardPoints(lcd_set(dimension, count, seed), np.full(count, 1.0 / count))
    if rule == "cubature":
        points = np.sqrt(dimension) * np.eye(dimension)
        return StandardPoints(np.vstack([points, -points]), np.full(2 * dimension, 0.5 / dimension))
    kappa = 3.0 - dimension if kappa is None else kappa
    if kappa <= -dimension:
        raise ValueError(f"kappa must be greater than -{dimension}, or a weight is not finite")
    points = np.sqrt(dimension + kappa) * np.eye(dimension)
    weights = np.full(2 * dimension + 1, 0.5 / (dimension + kappa))
    weights[0] = kappa / (dimension + kappa)
    return StandardPoints(np.vstack([np.zeros((1, dimension)), points, -points]), weights)


def lcd_set(dimension: int, count: int, seed: int = 0) -> np.ndarray:
    """The standardised symmetric LCD set, from the cache if a sound one is there; else optimised and stored.

    Raises:
        ValueError: the count is smaller than twice the dimension.
    """
    folder = cache_folder()
    path = None if folder is None else folder / "lcd" / f"v{VERSION}-d{dimension}-n{count}-s{seed}.json"
    stored = None if path is None else _read(path, dimension, count)
    if stored is not None:
        return stored
    points = standardised(symmetric_set(dimension, count, seed, RESTARTS))
    if path is not None:
        _store(path, points)
    return points


def is_sound(points: np.ndarray, dimension: int, count: int) -> bool:
    """Whether an array is a standardised symmetric set of this size."""
    if points.shape != (count, dimension) or not np.isfinite(points).all():
        return False
    off = points.T @ points / count - np.eye(dimension)
    return bool(np.abs(points.mean(axis=0)).max() < 1e-12 and np.abs(off).max() < 1e-9)


def _read(path: Path, dimension: int, count: int) -> np.ndarray | None:
    """A stored set; None if there is none, or not the one that was written."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        points = np.array(content["points"], float)
    except (OSError, ValueError, KeyError, TypeError):
        return None
    sound = content.get("sha256") == _digest(points) and is_sound(points, dimension, count)
    return points if sound else None


def _store(path: Path, points: np.ndarray) -> None:
    """Writes a set whole or not at all; a folder that cannot be written costs only the time to compute it again."""
    content = {"points": points.tolist(), "sha256": _digest(points), "distance": parts(points).distance}
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, temporary = tempfile.mkstemp(dir=path.parent)
        with os.fdopen(handle, "w", encoding="utf-8") as stream:
            json.dump(content, stream)
        os.replace(temporary, path)
    except OSError:
        return


def _digest(points: np.ndarray) -> str:
    return hashlib.sha256(np.ascontiguousarray(points, np.float64).tobytes()).hexdigest()

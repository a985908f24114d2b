"""How far the reports of another package are from emt's own."""

from collections.abc import Mapping, Sequence

import numpy as np

from emt.benchmark.peers.base import ELLIPSE


def own_reports(arrays: Mapping[str, np.ndarray], label: str, columns: Sequence[str]) -> np.ndarray:
    """emt's reports in the columns of a peer (run, step, column).

    Args:
        arrays: of a chunk of runs (`montecarlo.chunks.Engine.run_chunk`), with their tracks.
    """
    track = f"{label}/track"
    mean = arrays[f"{track}/mean"][..., :4]
    if tuple(columns) != ELLIPSE:
        return mean
    return np.concatenate([mean, arrays[f"{track}/semi_axes"], arrays[f"{track}/orientation"][..., None]], axis=-1)


def largest_difference(found: np.ndarray, expected: np.ndarray) -> float:
    """Largest difference in any column, relative to the largest value in that column; NaN if there is one."""
    scale = np.abs(expected).max(axis=(0, 1))
    return float((np.abs(found - expected).max(axis=(0, 1)) / np.where(scale > 0.0, scale, 1.0)).max())


def error_difference(found: np.ndarray, own: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    """Difference of position errors, another package's minus emt's, and its standard error (m).

    The error of a run is the root of its mean square over steps; runs are compared in pairs.

    Args:
        found, own, truth: of the same runs (run, step, column), beginning with x and y.
    """

    def error(reports: np.ndarray) -> np.ndarray:
        return np.sqrt(((reports[..., :2] - truth[..., :2]) ** 2).sum(axis=-1).mean(axis=1))

    gaps = error(found) - error(own)
    return float(gaps.mean()), float(gaps.std(ddof=1) / np.sqrt(len(gaps)))

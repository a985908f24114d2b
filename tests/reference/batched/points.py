"""Points of a scan of all runs: (2, slot, run), as many slots as the fullest scan of the step needs."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def counts_of(mask: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Points per scan (run, step) of a mask (run, step, slot).

    Raises:
        ValueError: some slot before the last point of its scan is empty.
    """
    if (mask[..., 1:] > mask[..., :-1]).any():
        raise ValueError("the points of a scan must fill its first slots")
    return np.count_nonzero(mask, axis=-1)


def points_about(points: Array, counts: NDArray[np.int64], center: Array) -> Array:
    """The points (run, slot, 2) of one step less a centre (2, run); zero where there is none."""
    used = counts.max()
    about = np.subtract(points[:, :used].T, center[:, None], out=np.empty((2, used, len(counts))))
    about *= np.arange(used)[:, None] < counts
    return about


def statistics(about: Array, counts: NDArray[np.int64]) -> tuple[Array, Array]:
    """Mean (2, run) and scatter about it (3, run) of the points of a scan, given about some point nearby.

    Both are zero for an empty scan.
    """
    total = about.sum(axis=1)
    scatter = np.empty((3, len(counts)))
    np.einsum("isr,isr->ir", about, about, out=scatter[:2])
    np.einsum("sr,sr->r", about[0], about[1], out=scatter[2])
    mean = total / np.maximum(counts, 1)
    scatter[:2] -= total * mean
    scatter[2] -= total[0] * mean[1]
    return mean, scatter

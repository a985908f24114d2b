"""Cholesky factors of small covariances, one column after the other for all runs."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def cholesky(cov: Array) -> Array:
    """Lower factors (n, n, run) of covariances (n, n, run)."""
    n, rest = len(cov), cov.copy()
    root = np.zeros_like(cov)
    for j in range(n):
        column = rest[j:, j] / np.sqrt(rest[j, j])
        root[j:, j] = column
        if j + 1 < n:
            rest[j + 1 :, j + 1 :] -= column[1:, None] * column[1:]
    return root

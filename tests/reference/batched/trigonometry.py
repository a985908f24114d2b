"""Sine and cosine of many angles: NumPy's tangent of doubles is vectorised, its sine and cosine are not."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def sincos_of_double(angle: Array) -> tuple[Array, Array]:
    """Sine and cosine of twice the angle: 2 t / (1 + t^2) and (1 - t^2) / (1 + t^2) with t its tangent."""
    t = np.tan(angle)
    square = t * t
    share = 1.0 / (1.0 + square)
    t += t
    t *= share
    return t, (1.0 - square) * share

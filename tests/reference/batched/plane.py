"""Vectors and 2x2 matrices of the plane for many runs at once, in closed forms.

A vector is an array (2, ..., run). A symmetric matrix is its entries xx, yy, xy, an array (3, ..., run), and a general
one its entries xx, yy, xy, yx, an array (4, ..., run): diagonals and off-diagonals are slices then, and most operations
take two calls.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def entries(s: Array) -> Array:
    """A symmetric matrix (2, 2), the same for all runs."""
    return np.array([s[0][0], s[1][1], s[0][1]])[:, None]


def det(s: Array) -> Array:
    """Determinant of a symmetric matrix."""
    return s[0] * s[1] - s[2] * s[2]


def adjugate(s: Array) -> Array:
    """det(S) S^-1."""
    out = np.empty_like(s)
    out[1::-1] = s[:2]
    np.negative(s[2], out=out[2])
    return out


def inverse(s: Array, det_s: Array | None = None) -> Array:
    """Inverse of a symmetric matrix, whose determinant may be known."""
    det_s = det(s) if det_s is None else det_s
    out = np.empty_like(s)
    np.divide(s[:2], det_s, out=out[1::-1])
    np.divide(s[2], -det_s, out=out[2])
    return out


def outer(v: Array) -> Array:
    """v v^T."""
    out = np.empty((3, *v.shape[1:]))
    np.multiply(v, v, out=out[:2])
    np.multiply(v[0], v[1], out=out[2])
    return out


def inner(s: Array, t: Array) -> Array:
    """tr(S T)."""
    products = s * t
    return products[0] + products[1] + 2.0 * products[2]


def dot(v: Array, w: Array) -> Array:
    """v^T w."""
    products = v * w
    return products[0] + products[1]


def apply(s: Array, v: Array) -> Array:
    """S v of a symmetric matrix."""
    return s[:2] * v + s[2] * v[::-1]


def sandwich(s: Array, t: Array) -> Array:
    """S T S of two symmetric matrices, which is tr(S T) S - det(S) adj(T) by Cayley and Hamilton."""
    return inner(s, t) * s - det(s) * adjugate(t)


def apply_general(m: Array, v: Array) -> Array:
    """M v of a general matrix."""
    return m[:2] * v + m[2:] * v[::-1]


def times(m: Array, s: Array) -> Array:
    """M S of a general and a symmetric matrix."""
    out = np.empty(np.broadcast_shapes(m.shape, (4, *s.shape[1:])))
    np.add(m[:2] * s[:2], m[2:] * s[2], out=out[:2])
    np.add(m[:2] * s[2], m[2:] * s[1::-1], out=out[2:])
    return out


def times_transposed(m: Array, n: Array) -> Array:
    """M N^T of two general matrices, where that is symmetric."""
    out = np.empty((3, *m.shape[1:]))
    np.add(m[:2] * n[:2], m[2:] * n[2:], out=out[:2])
    np.add(m[0] * n[3], m[2] * n[1], out=out[2])
    return out

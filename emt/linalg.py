"""Vectors and matrices of the plane, and symmetric 3x3 factors, as named scalars with closed forms.

Under `vmap` every scalar becomes one vector over runs, the layout in which XLA on CPUs is fastest; the equations stay
readable because the closed forms have names. Symmetric matrices hold their triangle, so they cannot lose symmetry, and
`fuse` and the sums used by the filters add positive terms only, so they cannot lose definiteness either.
"""

from dataclasses import dataclass
from functools import partial
from typing import Any, overload

import jax
import jax.numpy as jnp
from jax.tree_util import register_dataclass

# Scalars: arrays of shape () in a step of one run; left unchecked because JAX also builds these with placeholders.
Real = Any


@register_dataclass
@dataclass(frozen=True)
class Vec2:
    """A vector of the plane."""

    x: Real
    y: Real

    @staticmethod
    def of(array) -> "Vec2":
        """From an array of shape (2,)."""
        return Vec2(array[0], array[1])

    def array(self):
        """As an array of shape (2,)."""
        return jnp.stack([self.x, self.y])

    def __add__(self, other: "Vec2") -> "Vec2":
        return Vec2(self.x + other.x, self.y + other.y)

    def __sub__(self, other: "Vec2") -> "Vec2":
        return Vec2(self.x - other.x, self.y - other.y)

    def __rmul__(self, scale: Real) -> "Vec2":
        return Vec2(scale * self.x, scale * self.y)

    def outer(self) -> "Sym2":
        """v vᵀ."""
        return Sym2(self.x * self.x, self.x * self.y, self.y * self.y)


@register_dataclass
@dataclass(frozen=True)
class Mat2:
    """A 2x2 matrix, row by row."""

    xx: Real
    xy: Real
    yx: Real
    yy: Real

    @staticmethod
    def of(array) -> "Mat2":
        """From an array of shape (2, 2)."""
        return Mat2(array[0, 0], array[0, 1], array[1, 0], array[1, 1])

    @staticmethod
    def rotation(angle: Real) -> "Mat2":
        """Anticlockwise rotation by `angle` (rad)."""
        c, s = jnp.cos(angle), jnp.sin(angle)
        return Mat2(c, -s, s, c)

    def array(self):
        """As an array of shape (2, 2)."""
        return jnp.stack([jnp.stack([self.xx, self.xy]), jnp.stack([self.yx, self.yy])])

    @property
    def T(self) -> "Mat2":  # noqa: N802 - the field's own sign for the transpose
        """Transpose."""
        return Mat2(self.xx, self.yx, self.xy, self.yy)

    def __add__(self, other: "Mat2") -> "Mat2":
        return Mat2(self.xx + other.xx, self.xy + other.xy, self.yx + other.yx, self.yy + other.yy)

    def __sub__(self, other: "Mat2") -> "Mat2":
        return Mat2(self.xx - other.xx, self.xy - other.xy, self.yx - other.yx, self.yy - other.yy)

    def __rmul__(self, scale: Real) -> "Mat2":
        return Mat2(scale * self.xx, scale * self.xy, scale * self.yx, scale * self.yy)

    @overload
    def __matmul__(self, other: Vec2) -> Vec2: ...
    @overload
    def __matmul__(self, other: "Mat2 | Sym2") -> "Mat2": ...
    def __matmul__(self, other: "Vec2 | Mat2 | Sym2") -> "Vec2 | Mat2":
        """Product with a vector or a matrix."""
        if isinstance(other, Vec2):
            return Vec2(self.xx * other.x + self.xy * other.y, self.yx * other.x + self.yy * other.y)
        b = other.full() if isinstance(other, Sym2) else other
        return Mat2(
            self.xx * b.xx + self.xy * b.yx,
            self.xx * b.xy + self.xy * b.yy,
            self.yx * b.xx + self.yy * b.yx,
            self.yx * b.xy + self.yy * b.yy,
        )

    def plus_identity(self) -> "Mat2":
        """I + M."""
        return Mat2(1.0 + self.xx, self.xy, self.yx, 1.0 + self.yy)

    def congruence(self, s: "Sym2") -> "Sym2":
        """M S Mᵀ."""
        m = self @ s
        return Sym2(m.xx * self.xx + m.xy * self.xy, m.xx * self.yx + m.xy * self.yy, m.yx * self.yx + m.yy * self.yy)


@register_dataclass
@dataclass(frozen=True)
class Sym2:
    """A symmetric 2x2 matrix, held as its triangle."""

    xx: Real
    xy: Real
    yy: Real

    @staticmethod
    def of(array) -> "Sym2":
        """From the upper triangle of an array of shape (2, 2)."""
        return Sym2(array[0, 0], array[0, 1], array[1, 1])

    @staticmethod
    def ellipse(semi_axis_1: Real, semi_axis_2: Real, orientation: Real) -> "Sym2":
        """L diag(l1², l2²) Lᵀ with L the rotation by `orientation`."""
        a, b = semi_axis_1 * semi_axis_1, semi_axis_2 * semi_axis_2
        return rotated_diagonal(a, b, jnp.cos(2.0 * orientation), jnp.sin(2.0 * orientation))

    def array(self):
        """As an array of shape (2, 2)."""
        return jnp.stack([jnp.stack([self.xx, self.xy]), jnp.stack([self.xy, self.yy])])

    def full(self) -> Mat2:
        """As a general matrix."""
        return Mat2(self.xx, self.xy, self.xy, self.yy)

    def __add__(self, other: "Sym2") -> "Sym2":
        return Sym2(self.xx + other.xx, self.xy + other.xy, self.yy + other.yy)

    def __sub__(self, other: "Sym2") -> "Sym2":
        return Sym2(self.xx - other.xx, self.xy - other.xy, self.yy - other.yy)

    def __rmul__(self, scale: Real) -> "Sym2":
        return Sym2(scale * self.xx, scale * self.xy, scale * self.yy)

    @overload
    def __matmul__(self, other: Vec2) -> Vec2: ...
    @overload
    def __matmul__(self, other: "Mat2 | Sym2") -> Mat2: ...
    def __matmul__(self, other: "Vec2 | Mat2 | Sym2") -> Vec2 | Mat2:
        """Product with a vector or a matrix."""
        return self.full() @ other

    def trace(self) -> Real:
        return self.xx + self.yy

    def det(self) -> Real:
        return self.xx * self.yy - self.xy * self.xy

    def adjugate(self) -> "Sym2":
        """det(S) S⁻¹, defined for singular S too."""
        return Sym2(self.yy, -self.xy, self.xx)

    def inverse(self) -> "Sym2":
        return (1.0 / self.det()) * self.adjugate()

    def sqrt(self) -> "Sym2":
        """Principal square root of a positive semi-definite matrix: (S + √det I) / √(tr + 2 √det)."""
        s = jnp.sqrt(jnp.maximum(self.det(), 0.0))
        t = jnp.sqrt(self.trace() + 2.0 * s)
        return (1.0 / t) * Sym2(self.xx + s, self.xy, self.yy + s)

    def quadratic(self, v: Vec2) -> Real:
        """vᵀ S v."""
        return self.xx * v.x * v.x + 2.0 * self.xy * v.x * v.y + self.yy * v.y * v.y

    def inner(self, other: "Sym2") -> Real:
        """tr(S T)."""
        return self.xx * other.xx + 2.0 * self.xy * other.xy + self.yy * other.yy

    def eigen(self) -> tuple[Real, Real, Real]:
        """(larger eigenvalue, smaller eigenvalue, direction of the larger one in (-π/2, π/2])."""
        mean, half = 0.5 * self.trace(), 0.5 * (self.xx - self.yy)
        radius = jnp.hypot(half, self.xy)
        larger = mean + radius
        # det / larger keeps the digits that mean - radius cancels in thin ellipses
        smaller = self.det() / jnp.where(larger > 0.0, larger, 1.0)
        return larger, smaller, 0.5 * jnp.arctan2(self.xy, half)


def rotated_diagonal(a: Real, b: Real, cos2: Real, sin2: Real) -> Sym2:
    """L diag(a, b) Lᵀ for a rotation L whose double angle has cosine `cos2` and sine `sin2`.

    With (cos2, sin2) shrunk by exp(-2 S) it is the expectation of that matrix over an angle of variance S.
    """
    mean, half = 0.5 * (a + b), 0.5 * (a - b)
    return Sym2(mean + half * cos2, half * sin2, mean - half * cos2)


def fuse(cov: Sym2, information: Sym2) -> Sym2:
    """(C⁻¹ + J)⁻¹ = (C + det(C) adj(J)) / (1 + tr(C J) + det(C) det(J)).

    Sums of positive terms: definite for every positive definite C and semi-definite J, and exactly C for J = 0.
    """
    det = cov.det()
    scale = 1.0 / (1.0 + cov.inner(information) + det * information.det())
    return scale * (cov + det * information.adjugate())


def parallel(a: Sym2, b: Sym2) -> Sym2:
    """(A⁻¹ + B⁻¹)⁻¹ = (det(B) A + det(A) B) / det(A + B), without inverting either; definite if both are."""
    return (1.0 / (a + b).det()) * (b.det() * a + a.det() * b)


@partial(register_dataclass, data_fields=("a11", "a21", "a22", "a31", "a32", "a33"), meta_fields=())
@dataclass(frozen=True)
class Chol3:
    """Lower triangular factor of a 3x3 covariance: symmetric and positive definite whatever happens to it."""

    a11: Real
    a21: Real
    a22: Real
    a31: Real
    a32: Real
    a33: Real

    @staticmethod
    def of(cov) -> "Chol3":
        """Factor of an array of shape (3, 3)."""
        return Chol3.factor(cov[0, 0], cov[1, 0], cov[1, 1], cov[2, 0], cov[2, 1], cov[2, 2])

    @staticmethod
    def factor(c11, c21, c22, c31, c32, c33, floor: Real = 0.0) -> "Chol3":
        """Factor of the matrix with this lower triangle; pivots are kept at `floor` or above."""
        a11 = jnp.sqrt(jnp.maximum(c11, floor))
        a21, a31 = c21 / a11, c31 / a11
        a22 = jnp.sqrt(jnp.maximum(c22 - a21 * a21, floor))
        a32 = (c32 - a31 * a21) / a22
        a33 = jnp.sqrt(jnp.maximum(c33 - a31 * a31 - a32 * a32, floor))
        return Chol3(a11, a21, a22, a31, a32, a33)

    def triangle(self) -> tuple[Real, Real, Real, Real, Real, Real]:
        """Lower triangle of A Aᵀ: (c11, c21, c22, c31, c32, c33)."""
        return (
            self.a11 * self.a11,
            self.a21 * self.a11,
            self.a21 * self.a21 + self.a22 * self.a22,
            self.a31 * self.a11,
            self.a31 * self.a21 + self.a32 * self.a22,
            self.a31 * self.a31 + self.a32 * self.a32 + self.a33 * self.a33,
        )

    def array(self):
        """A Aᵀ as an array of shape (3, 3)."""
        c11, c21, c22, c31, c32, c33 = self.triangle()
        return jnp.stack([jnp.stack([c11, c21, c31]), jnp.stack([c21, c22, c32]), jnp.stack([c31, c32, c33])])

    def __matmul__(self, other: "Chol3") -> "Chol3":
        """Product of two lower triangular matrices."""
        return Chol3(
            self.a11 * other.a11,
            self.a21 * other.a11 + self.a22 * other.a21,
            self.a22 * other.a22,
            self.a31 * other.a11 + self.a32 * other.a21 + self.a33 * other.a31,
            self.a32 * other.a22 + self.a33 * other.a32,
            self.a33 * other.a33,
        )


def once(values, known: Real):
    """The same values, computed once.

    XLA on CPUs computes cheap arithmetic anew in each place where its result enters, and does not heed optimisation
    barriers; but it never merges what lies on both sides of a conditional.

    Args:
        known: any finite number that the compiler cannot know and that all runs share, such as a parameter.
    """
    return jax.lax.cond(jnp.all(known < jnp.inf), lambda v: v, lambda v: jax.tree.map(jnp.zeros_like, v), values)


def is_positive_definite(cov: Sym2) -> Real:
    """Whether the matrix is finite and positive definite."""
    det = cov.det()  # infinite, negative or not a number if an entry is not finite
    return (cov.xx > 0.0) & (det > 0.0) & (det < jnp.inf)


def all_finite(tree) -> Real:
    """Whether every number of a pytree is finite."""
    # zero times a number is zero, unless the number is not finite
    leaves = [0.0 * leaf for leaf in jax.tree.leaves(tree) if jnp.issubdtype(leaf.dtype, jnp.inexact)]
    # few numbers are added one by one: XLA on CPUs calls a routine for sums, which nothing merges with
    return sum(sum(leaf.ravel()) if 0 < leaf.size <= 16 else leaf.sum() for leaf in leaves) == 0.0


def cholesky(matrix):
    """Lower Cholesky factor of a small positive definite matrix (n, n), or of many (n, n, m); NaN if it is not.

    Column by column in plain operations, which batch and have derivatives without a triangular solver: that of XLA can
    wait for itself for ever on a CPU (seen with jaxlib 0.10 in batches of 600).
    """
    rest, columns = matrix, []
    below = jnp.arange(matrix.shape[0]).reshape(-1, *(1,) * (matrix.ndim - 2))
    for j in range(matrix.shape[0]):
        column = jnp.where(below >= j, rest[:, j] / jnp.sqrt(rest[j, j])[None], 0.0)
        columns.append(column)
        rest = rest - column[:, None] * column[None, :]
    return jnp.stack(columns, axis=1)


def semidefinite_root(matrix):
    """Lower triangular root of a small covariance (n, n) that may be singular.

    A pivot of less than 1e-12 of its variance (1e-5 in single precision) counts as zero.
    """
    rest, columns = matrix, []
    tolerance = 1e-12 if matrix.dtype == jnp.float64 else 1e-5
    below = jnp.arange(matrix.shape[0])
    for j in range(matrix.shape[0]):
        pivot = rest[j, j]
        sound = pivot > tolerance * matrix[j, j]
        column = jnp.where(sound & (below >= j), rest[:, j] / jnp.sqrt(jnp.where(sound, pivot, 1.0)), 0.0)
        columns.append(column)
        rest = rest - column[:, None] * column[None, :]
    return jnp.stack(columns, axis=1)


def forward_solve(root, right):
    """root⁻¹ right for a lower triangular root (n, n), right (n,) or (n, k), row by row in plain operations.

    Or for many, along axes behind those of both.
    """
    n, *lanes = root.shape[1:]
    root, rows = root.reshape(n, n, *(1,) * (right.ndim - 1 - len(lanes)), *lanes), []
    for i in range(root.shape[0]):
        rest = right[i]
        for j in range(i):
            rest = rest - root[i, j] * rows[j]
        rows.append(rest / root[i, i])
    return jnp.stack(rows)

"""Closed forms of the plane against NumPy's general routines."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from emt.linalg import (
    Chol3,
    Mat2,
    Sym2,
    Vec2,
    all_finite,
    cholesky,
    fuse,
    is_positive_definite,
    parallel,
    rotated_diagonal,
)

RNG = np.random.default_rng(0)
TIGHT = 1e-12
N = 50


def definite(n: int = N, size: int = 2) -> np.ndarray:
    """Random positive definite matrices of many scales."""
    factor = RNG.normal(size=(n, size, size))
    return 10.0 ** RNG.uniform(-3, 3, (n, 1, 1)) * (factor @ np.swapaxes(factor, 1, 2) + 0.01 * np.eye(size))


A, B = definite(), definite()
M, W, V = RNG.normal(size=(N, 2, 2)), RNG.normal(size=(N, 2, 2)), RNG.normal(size=(N, 2))


def over(fn, *arrays):
    """`fn` on every entry of the leading axis."""
    return np.asarray(jax.vmap(fn)(*map(jnp.asarray, arrays)))


def assert_close(actual, expected, tolerance=TIGHT):
    """Relative to the largest entry of each matrix."""
    actual, expected = np.asarray(actual), np.asarray(expected)
    assert actual.shape == expected.shape
    axes = tuple(range(1, expected.ndim))
    scale = np.abs(expected).max(axis=axes, keepdims=True) if axes else np.abs(expected)
    assert (np.abs(actual - expected) <= tolerance * scale).all()


@pytest.mark.parametrize(
    ("ours", "theirs"),
    [
        (lambda a, b: (Sym2.of(a) + Sym2.of(b)).array(), lambda a, b: a + b),
        (lambda a, b: (Sym2.of(a) - Sym2.of(b)).array(), lambda a, b: a - b),
        (lambda a, b: (3.0 * Sym2.of(a)).array(), lambda a, b: 3.0 * a),
        (lambda a, b: Sym2.of(a).full().array(), lambda a, b: a),
        (lambda a, b: (Sym2.of(a) @ Sym2.of(b)).array(), lambda a, b: a @ b),
        (lambda a, b: Sym2.of(a).inverse().array(), lambda a, b: np.linalg.inv(a)),
        (
            lambda a, b: Sym2.of(a).adjugate().array(),
            lambda a, b: np.linalg.det(a)[:, None, None] * np.linalg.inv(a),
        ),
        (lambda a, b: Sym2.of(a).det(), lambda a, b: np.linalg.det(a)),
        (lambda a, b: Sym2.of(a).trace(), lambda a, b: np.trace(a, axis1=1, axis2=2)),
        (lambda a, b: Sym2.of(a).inner(Sym2.of(b)), lambda a, b: np.trace(a @ b, axis1=1, axis2=2)),
        (
            lambda a, b: parallel(Sym2.of(a), Sym2.of(b)).array(),
            lambda a, b: np.linalg.inv(np.linalg.inv(a) + np.linalg.inv(b)),
        ),
        (lambda a, b: fuse(Sym2.of(a), Sym2.of(b)).array(), lambda a, b: np.linalg.inv(np.linalg.inv(a) + b)),
    ],
    ids=[
        "sum",
        "difference",
        "scaled",
        "full",
        "product",
        "inverse",
        "adjugate",
        "det",
        "trace",
        "inner",
        "parallel",
        "fuse",
    ],
)
def test_symmetric_matrices(ours, theirs):
    assert_close(over(ours, A, B), theirs(A, B), 1e-10)


@pytest.mark.parametrize(
    ("ours", "theirs"),
    [
        (lambda m, w: (Mat2.of(m) @ Mat2.of(w)).array(), lambda m, w: m @ w),
        (lambda m, w: (Mat2.of(m) + Mat2.of(w)).array(), lambda m, w: m + w),
        (lambda m, w: (Mat2.of(m) - Mat2.of(w)).array(), lambda m, w: m - w),
        (lambda m, w: (-0.5 * Mat2.of(m)).array(), lambda m, w: -0.5 * m),
        (lambda m, w: Mat2.of(m).T.array(), lambda m, w: np.swapaxes(m, 1, 2)),
        (lambda m, w: Mat2.of(m).plus_identity().array(), lambda m, w: m + np.eye(2)),
    ],
    ids=["product", "sum", "difference", "scaled", "transpose", "plus identity"],
)
def test_general_matrices(ours, theirs):
    assert_close(over(ours, M, W), theirs(M, W))


def test_vectors():
    assert_close(over(lambda m, v: (Mat2.of(m) @ Vec2.of(v)).array(), M, V), np.einsum("nij,nj->ni", M, V))
    assert_close(over(lambda a, v: (Sym2.of(a) @ Vec2.of(v)).array(), A, V), np.einsum("nij,nj->ni", A, V))
    assert_close(over(lambda a, v: Sym2.of(a).quadratic(Vec2.of(v)), A, V), np.einsum("ni,nij,nj->n", V, A, V), 1e-10)
    assert_close(over(lambda v: Vec2.of(v).outer().array(), V), V[:, :, None] * V[:, None, :])
    assert_close(over(lambda v, w: (Vec2.of(v) - 2.0 * Vec2.of(w) + Vec2.of(v)).array(), V, A[:, 0]), 2 * (V - A[:, 0]))


def test_congruence():
    expected = M @ A @ np.swapaxes(M, 1, 2)
    assert_close(over(lambda m, a: Mat2.of(m).congruence(Sym2.of(a)).array(), M, A), expected)


def test_square_root():
    roots = over(lambda a: Sym2.of(a).sqrt().array(), A)
    assert_close(roots @ roots, A)
    assert (np.linalg.eigvalsh(roots) > 0.0).all()


def test_square_root_of_a_singular_matrix():
    root = np.asarray(Sym2(jnp.asarray(9.0), jnp.asarray(0.0), jnp.asarray(0.0)).sqrt().array())
    np.testing.assert_array_equal(root, [[3.0, 0.0], [0.0, 0.0]])


def test_eigenvalues_and_direction():
    values, vectors = np.linalg.eigh(A)
    larger, smaller, angle = (over(lambda a, i=i: Sym2.of(a).eigen()[i], A) for i in range(3))
    np.testing.assert_allclose(larger, values[:, 1], rtol=TIGHT)
    np.testing.assert_allclose(smaller, values[:, 0], rtol=1e-9)
    along = np.abs(np.cos(angle) * vectors[:, 0, 1] + np.sin(angle) * vectors[:, 1, 1])
    np.testing.assert_allclose(along, 1.0, rtol=TIGHT)
    assert (angle > -np.pi / 2).all()
    assert (angle <= np.pi / 2).all()


@pytest.mark.parametrize(("xx", "yy", "direction"), [(4.0, 1.0, 0.0), (1.0, 4.0, np.pi / 2), (2.0, 2.0, 0.0)])
def test_eigen_of_axis_parallel_matrices(xx, yy, direction):
    larger, smaller, angle = Sym2(jnp.asarray(xx), jnp.asarray(0.0), jnp.asarray(yy)).eigen()
    assert (float(larger), float(smaller), float(angle)) == (max(xx, yy), min(xx, yy), direction)


def test_small_eigenvalue_of_a_needle_keeps_its_digits():
    """1 : 1e9 in length; half the trace minus the radius would be zero."""
    needle = Sym2.ellipse(jnp.asarray(1e9), jnp.asarray(1.0), jnp.asarray(0.0))
    needle = Sym2(needle.xx, needle.xy, jnp.asarray(1.0))
    assert float(needle.eigen()[1]) == pytest.approx(1.0, rel=1e-15)


def test_ellipse_and_rotated_diagonal():
    a, b, angle = RNG.uniform(0.1, 10.0, N), RNG.uniform(0.1, 10.0, N), RNG.uniform(-7.0, 7.0, N)
    turn = over(lambda t: Mat2.rotation(t).array(), angle)
    np.testing.assert_allclose(turn @ np.swapaxes(turn, 1, 2), np.broadcast_to(np.eye(2), (N, 2, 2)), atol=1e-15)
    np.testing.assert_allclose(turn[:, 1, 0], np.sin(angle), atol=1e-15)
    diagonal = np.stack([a, b], 1)[:, :, None] * np.eye(2)
    expected = turn @ diagonal @ np.swapaxes(turn, 1, 2)
    built = over(lambda a, b, t: rotated_diagonal(a, b, jnp.cos(2.0 * t), jnp.sin(2.0 * t)).array(), a, b, angle)
    assert_close(built, expected)
    ellipse = over(lambda a, b, t: Sym2.ellipse(a, b, t).array(), np.sqrt(a), np.sqrt(b), angle)
    assert_close(ellipse, expected)


def test_shrunk_rotated_diagonal_is_the_mean_over_a_gaussian_angle():
    nodes, weights = np.polynomial.hermite_e.hermegauss(60)
    mean, variance = 0.6, 0.3
    angles, weights = mean + np.sqrt(variance) * nodes, weights / weights.sum()
    c, s = np.cos(angles), np.sin(angles)
    expected = [(weights * (5.0 * c * c + 2.0 * s * s)).sum(), (weights * 3.0 * c * s).sum()]
    shrink = jnp.exp(-2.0 * variance)
    ours = rotated_diagonal(5.0, 2.0, shrink * jnp.cos(2.0 * mean), shrink * jnp.sin(2.0 * mean))
    np.testing.assert_allclose([float(ours.xx), float(ours.xy)], expected, rtol=1e-12)


def test_fuse_without_information_is_exact():
    zero = jnp.asarray(0.0)
    for a in A:
        fused = fuse(Sym2.of(jnp.asarray(a)), Sym2(zero, zero, zero))
        np.testing.assert_array_equal(np.asarray(fused.array()), np.asarray(Sym2.of(jnp.asarray(a)).array()))


@given(st.floats(-150.0, 150.0), st.floats(-150.0, 150.0), st.floats(-0.99, 0.99))
def test_fuse_stays_definite_at_any_scale(log_cov, log_information, correlation):
    """Between 1e-75 and 1e75 of either, and for singular information."""
    cov = 10.0 ** (0.5 * log_cov)
    info = 10.0 ** (0.5 * log_information)
    prior = Sym2(jnp.asarray(cov), jnp.asarray(correlation * cov), jnp.asarray(cov))
    fused = fuse(prior, Sym2(jnp.asarray(info), jnp.asarray(0.0), jnp.asarray(0.0)))
    assert float(fused.xx) > 0.0
    assert float(fused.yy) > 0.0
    assert float(fused.xy) ** 2 < float(fused.xx) * float(fused.yy) * (1.0 + 1e-12)


def test_factor_of_three_by_three():
    cov = definite(size=3)
    assert_close(over(lambda c: Chol3.of(c).array(), cov), cov)
    lower = over(lambda c: jnp.stack(jax.tree.leaves(Chol3.of(c))), cov)
    expected = np.linalg.cholesky(cov)
    rows, columns = np.tril_indices(3)
    assert_close(lower, expected[:, rows, columns], 1e-9)
    other = definite(size=3)
    factor, second = expected, np.linalg.cholesky(other)
    product = factor @ second
    assert_close(
        over(lambda c, d: (Chol3.of(c) @ Chol3.of(d)).array(), cov, other),
        product @ np.swapaxes(product, 1, 2),
        1e-9,
    )
    triangle = over(lambda c: jnp.stack(Chol3.of(c).triangle()), cov)
    assert_close(triangle, cov[:, rows, columns])


def test_factor_keeps_its_pivots_at_the_floor():
    factor = Chol3.factor(1.0, 0.0, -1e-18, 0.0, 0.0, 1.0, floor=1e-12)
    assert float(factor.a22) == 1e-6
    assert np.isfinite([float(leaf) for leaf in jax.tree.leaves(factor)]).all()


@pytest.mark.parametrize(
    ("triangle", "expected"),
    [
        ((2.0, 1.0, 2.0), True),
        ((1.0, 1.0, 1.0), False),
        ((-1.0, 0.0, -1.0), False),
        ((np.nan, 0.0, 1.0), False),
        ((np.inf, 0.0, 1.0), False),
        ((1.0, 0.0, 0.0), False),
    ],
)
def test_positive_definite(triangle, expected):
    assert bool(is_positive_definite(Sym2(*map(jnp.asarray, triangle)))) is expected


def test_all_finite_looks_at_every_inexact_leaf():
    assert bool(all_finite({"a": jnp.ones(2), "b": jnp.asarray(3)}))
    assert not bool(all_finite({"a": jnp.ones(2), "b": jnp.array([1.0, jnp.inf])}))
    assert not bool(all_finite((jnp.asarray(jnp.nan), jnp.ones(2))))


def test_cholesky_of_small_matrices():
    rng = np.random.default_rng(4)
    for n in (1, 2, 5, 8):
        factor = rng.normal(size=(6, n, n))
        cov = factor @ np.swapaxes(factor, -1, -2) + 0.1 * np.eye(n)
        np.testing.assert_allclose(
            jax.vmap(cholesky)(jnp.asarray(cov)), np.linalg.cholesky(cov), rtol=1e-12, atol=1e-13
        )
    assert not np.isfinite(cholesky(jnp.array([[1.0, 2.0], [2.0, 1.0]]))).all()

"""Image moments: conversions both ways, and the projection that keeps them those of an ellipse."""

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from emt.linalg import Sym2
from emt.shapes.moments import ellipse_of, moments_of, project
from emt.types import Ellipse

AXIS, ANGLE = st.floats(0.01, 100.0), st.floats(-7.0, 7.0)
ENTRY = st.floats(-50.0, 50.0)
project_once = jax.jit(project)


def matrix(m: Sym2) -> np.ndarray:
    return np.asarray(m.array())


@given(a=AXIS, b=AXIS, angle=ANGLE)
def test_there_and_back(a, b, angle):
    moments = moments_of(Ellipse(jnp.array([a, b]), jnp.asarray(angle)))
    again = moments_of(ellipse_of(moments))
    np.testing.assert_allclose(matrix(again), matrix(moments), rtol=0, atol=1e-9 * max(a, b) ** 2)
    np.testing.assert_allclose(ellipse_of(moments).semi_axes, sorted((a, b))[::-1], rtol=1e-6, atol=1e-7 * max(a, b))


def test_moments_are_those_of_points_on_the_ellipse():
    """n20, n02 and n11 are the variances and the covariance of a uniform point on the filled ellipse."""
    radius, phase = np.meshgrid((np.arange(400) + 0.5) / 400, 2 * np.pi * np.arange(64) / 64)
    disc = np.stack([radius * np.cos(phase), radius * np.sin(phase)])
    turn = np.array([[np.cos(0.7), -np.sin(0.7)], [np.sin(0.7), np.cos(0.7)]])
    points = np.einsum("ij,jkl->ikl", turn @ np.diag([5.0, 2.0]), disc)
    weights = radius / radius.sum()
    expected = np.einsum("ikl,jkl,kl->ij", points, points, weights)
    ours = moments_of(Ellipse(jnp.array([5.0, 2.0]), jnp.asarray(0.7)))
    np.testing.assert_allclose(matrix(ours), expected, rtol=1e-4)


@given(xx=ENTRY, xy=ENTRY, yy=ENTRY)
def test_projection_bounds_the_eigenvalues_and_keeps_the_axes(xx, xy, yy):
    given_moments = Sym2(*map(jnp.asarray, (xx, xy, yy)))
    done = matrix(project_once(given_moments, jnp.asarray(0.5), jnp.asarray(0.1)))
    low, high = np.linalg.eigvalsh(done)
    size = max(abs(xx), abs(xy), abs(yy), 1.0)
    assert high >= 0.5 - 1e-9 * size
    assert low >= 0.1 * high - 1e-9 * size
    before = matrix(given_moments)
    np.testing.assert_allclose(done @ before, before @ done, atol=1e-9 * size**2)
    twice = matrix(project_once(Sym2.of(jnp.asarray(done)), jnp.asarray(0.5), jnp.asarray(0.1)))
    np.testing.assert_allclose(twice, done, atol=1e-9 * size)


def test_projection_leaves_what_complies_to_the_last_bit():
    moments = Sym2(*map(jnp.asarray, (3.1, 0.7, 1.3)))
    assert (matrix(project_once(moments, jnp.asarray(0.5), jnp.asarray(0.1))) == matrix(moments)).all()


def test_projection_has_a_derivative_for_a_circle():
    def trace(xx):
        return project(Sym2(xx, jnp.asarray(0.0), jnp.asarray(2.0)), jnp.asarray(0.1), jnp.asarray(0.01)).trace()

    for start in (2.0, 1.0):
        value, slope = jax.jvp(trace, (jnp.asarray(start),), (jnp.asarray(1.0),))
        assert np.isfinite(value)
        np.testing.assert_allclose(slope, 1.0, rtol=1e-12)
        np.testing.assert_allclose(jax.grad(trace)(jnp.asarray(start)), 1.0, rtol=1e-12)

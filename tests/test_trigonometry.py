"""Sine, cosine and direction against the C library."""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from emt.trigonometry import arctan2, sincos, sincos_turns


@given(st.floats(-1e6, 1e6))
def test_to_the_last_bits(x):
    sine, cosine = sincos(jnp.asarray(x))
    assert float(sine) == pytest.approx(np.sin(x), abs=2.3e-16)
    assert float(cosine) == pytest.approx(np.cos(x), abs=2.3e-16)


@given(st.floats(0.0, 1.0))
def test_turns_to_the_last_bits(x):
    sine, cosine = sincos_turns(jnp.asarray(x))
    with mpmath.workdps(30):
        assert float(sine) == pytest.approx(float(mpmath.sin(2 * mpmath.pi * x)), abs=3e-16)
        assert float(cosine) == pytest.approx(float(mpmath.cos(2 * mpmath.pi * x)), abs=3e-16)


def test_all_quadrants_and_their_edges():
    x = np.pi / 4 * np.arange(-16, 17)
    x = np.concatenate([np.nextafter(x, -9.0), x, np.nextafter(x, 9.0)])
    sine, cosine = sincos(jnp.asarray(x))
    np.testing.assert_allclose(sine, np.sin(x), atol=2.3e-16)
    np.testing.assert_allclose(cosine, np.cos(x), atol=2.3e-16)


def test_derivatives_and_what_is_not_finite():
    slope = jax.vmap(jax.grad(lambda x: sincos(x)[0]))(jnp.linspace(-7.0, 7.0, 101))
    np.testing.assert_allclose(slope, np.cos(np.linspace(-7.0, 7.0, 101)), atol=1e-15)
    assert not np.isfinite(np.asarray(sincos(jnp.array([np.nan, np.inf])))).any()


def test_single_precision_is_left_to_the_compiler():
    x = jnp.linspace(-9.0, 9.0, 50, dtype=jnp.float32)
    np.testing.assert_array_equal(sincos(x)[0], jnp.sin(x))


SIZES = st.one_of(st.floats(-1e3, 1e3), st.floats(-1e-200, 1e-200), st.floats(-1e300, 1e300))


@given(SIZES, SIZES)
def test_directions_to_the_last_bits(y, x):
    # XLA on CPUs takes numbers below 1e-307 for zero
    y, x = (0.0 if abs(v) < 1e-290 else v for v in (y, x))
    assert float(arctan2(jnp.asarray(y), jnp.asarray(x))) == pytest.approx(np.arctan2(y, x), rel=5e-16)


def test_directions_around_the_circle_and_at_its_edges():
    turns = np.pi / 32 * np.arange(-32, 33)
    turns = np.concatenate([np.nextafter(turns, -9.0), turns, np.nextafter(turns, 9.0)])
    y, x = 3.0 * np.sin(turns), 3.0 * np.cos(turns)
    np.testing.assert_allclose(arctan2(jnp.asarray(y), jnp.asarray(x)), np.arctan2(y, x), rtol=5e-16, atol=1e-300)
    edges = np.array([0.0, -0.0, 1.0, -1.0, np.inf, -np.inf])
    y, x = (grid.ravel() for grid in np.meshgrid(edges, edges))
    found, expected = np.asarray(arctan2(jnp.asarray(y), jnp.asarray(x))), np.arctan2(y, x)
    np.testing.assert_allclose(found, expected, rtol=5e-16)
    np.testing.assert_array_equal(np.signbit(found), np.signbit(expected))
    assert np.isnan(arctan2(jnp.asarray([np.nan, 1.0]), jnp.asarray([1.0, np.nan]))).all()


@given(st.floats(-5.0, 5.0), st.floats(-5.0, 5.0))
def test_slopes_of_directions(y, x):
    if y * y + x * x > 1e-3:
        slopes = jax.grad(arctan2, argnums=(0, 1))(jnp.asarray(y), jnp.asarray(x))
        np.testing.assert_allclose(slopes, np.array([x, -y]) / (x * x + y * y), rtol=1e-12, atol=1e-14)

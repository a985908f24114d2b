"""Sine and cosine against the C library."""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from emt.trigonometry import sincos, sincos_turns


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

"""The logarithm against the C library and exact arithmetic."""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from emt.logarithm import log, log_positive


def exact(x: float) -> float:
    with mpmath.workdps(40):
        return float(mpmath.log(mpmath.mpf(x)))


@given(st.floats(-700.0, 700.0), st.integers(-3, 3))
def test_to_the_last_bits(power, steps):
    x = np.exp(power) * (1.0 + steps * 2.0**-52)
    for function in (log, log_positive):
        assert float(function(jnp.asarray(x))) == pytest.approx(exact(x), rel=3e-16, abs=2.3e-16)


@given(st.floats(2.0**-33, 1.0, exclude_max=True))
def test_of_numbers_that_are_drawn(u):
    assert float(log_positive(jnp.asarray(u))) == pytest.approx(exact(u), rel=3e-16, abs=2.3e-16)


def test_largest_number_that_is_drawn_has_a_negative_logarithm():
    assert float(log_positive(jnp.asarray(1.0 - 2.0**-33))) == pytest.approx(-(2.0**-33), rel=1e-5)


def test_borders_of_the_reduction():
    """Powers of two and √2 between them, with their neighbours."""
    x = np.concatenate([2.0 ** np.arange(-1022.0, 1024.0), np.sqrt(2.0) * 2.0 ** np.arange(-1021.0, 1023.0)])
    x = np.concatenate([x, np.nextafter(x, np.inf)])
    np.testing.assert_allclose(log(jnp.asarray(x)), np.log(x), rtol=3e-16, atol=2.3e-16)


def test_what_has_no_finite_logarithm():
    x = np.array([0.0, -0.0, np.inf, -np.inf, -1.0, -1e-300, np.nan])
    np.testing.assert_array_equal(log(jnp.asarray(x)), [-np.inf, -np.inf, np.inf, np.nan, np.nan, np.nan, np.nan])


def test_derivative():
    x = np.array([1e-9, 0.3, 1.0, 7.0, 1e9])
    np.testing.assert_allclose(jax.vmap(jax.grad(log))(jnp.asarray(x)), 1.0 / x, rtol=1e-15)


def test_single_precision_is_left_to_the_compiler():
    x = jnp.linspace(0.1, 9.0, 50, dtype=jnp.float32)
    np.testing.assert_array_equal(log(x), jnp.log(x))
    assert log_positive(x).dtype == jnp.float32

"""Coordinated turns: against integration, and as a group."""

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from emt.linalg import Vec2
from emt.models.turn import coordinated_turn

P, V = Vec2(jnp.asarray(3.0), jnp.asarray(-2.0)), Vec2(jnp.asarray(1.5), jnp.asarray(0.5))


def moved(w, dt, position=P, velocity=V):
    return coordinated_turn(position, velocity, jnp.asarray(w), jnp.asarray(dt))


def test_no_turn_is_a_straight_line():
    position, velocity = moved(0.0, 4.0)
    np.testing.assert_array_equal(position.array(), [9.0, 0.0])
    np.testing.assert_array_equal(velocity.array(), V.array())


@pytest.mark.parametrize("w", [-0.9, -1e-6, 1e-12, 0.3, 2.0])
def test_against_integration(w):
    t = (np.arange(200_000) + 0.5) * (3.0 / 200_000)
    path = (1.5 + 0.5j) * np.exp(1j * w * t)
    end = 3.0 - 2.0j + path.mean() * 3.0
    position, velocity = moved(w, 3.0)
    np.testing.assert_allclose(position.array(), [end.real, end.imag], rtol=1e-9)
    v = (1.5 + 0.5j) * np.exp(3j * w)
    np.testing.assert_allclose(velocity.array(), [v.real, v.imag], rtol=1e-12)


@given(w=st.floats(-3.0, 3.0), first=st.floats(0.0, 5.0), second=st.floats(0.0, 5.0))
def test_two_steps_are_one(w, first, second):
    position, velocity = moved(w, second, *moved(w, first))
    whole_position, whole_velocity = moved(w, first + second)
    np.testing.assert_allclose(position.array(), whole_position.array(), atol=1e-12 * 20)
    np.testing.assert_allclose(velocity.array(), whole_velocity.array(), atol=1e-12 * 20)

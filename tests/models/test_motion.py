"""Process noise against the textbook matrices."""

import jax.numpy as jnp
import numpy as np
import pytest

from emt.models.motion import FixedNoise, WhiteAcceleration


@pytest.mark.parametrize("dt", [1e-3, 0.1, 1.0, 10.0, 1e4])
@pytest.mark.parametrize("psd", [0.0, 0.04, 16.0])
def test_white_acceleration_is_the_textbook_matrix(dt, psd):
    expected = psd * np.kron([[dt**3 / 3.0, dt**2 / 2.0], [dt**2 / 2.0, dt]], np.eye(2))
    noise = WhiteAcceleration(jnp.asarray(psd))(jnp.asarray(dt))
    np.testing.assert_allclose(np.asarray(noise.array()), expected, rtol=1e-14)
    np.testing.assert_allclose(np.asarray(noise.cross().array()), expected[2:, :2], rtol=1e-14)


def random_cov(rank: int) -> np.ndarray:
    factor = np.random.default_rng(rank).normal(size=(4, rank))
    return factor @ factor.T


@pytest.mark.parametrize(
    "cov",
    [
        np.diag([100.0, 100.0, 1.0, 1.0]),
        random_cov(4),
        np.zeros((4, 4)),
        np.diag([0.0, 0.0, 1.0, 1.0]),
        np.diag([1.0, 0.0, 0.0, 2.0]),
        # discrete white acceleration: position and velocity noise fully correlated
        np.kron([[0.25, 0.5], [0.5, 1.0]], np.diag([2.0, 3.0])),
        random_cov(2),
    ],
    ids=["diagonal", "full", "none", "velocity only", "one axis each", "fully correlated", "rank two"],
)
def test_fixed_noise_keeps_the_given_matrix(cov):
    """Whatever the step; singular ones included, and without a variance below zero in the factors."""
    noise = FixedNoise.of(cov)
    for dt in (0.1, 10.0):
        built = noise(jnp.asarray(dt))
        np.testing.assert_allclose(np.asarray(built.array()), cov, rtol=0.0, atol=1e-14 * max(1.0, np.abs(cov).max()))
    rest = np.asarray(noise.noise.velocity.array())
    assert np.linalg.eigvalsh(rest).min() >= -1e-13 * max(1.0, np.abs(cov).max())

"""The factored Gaussian over position and velocity against F P Fᵀ + Q and the Kalman filter."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from emt.filters import kinematics
from emt.filters.kinematics import Kinematics
from emt.linalg import Sym2, Vec2, parallel
from emt.models.motion import FixedNoise, WhiteAcceleration

RNG = np.random.default_rng(4)


def random_belief() -> tuple[np.ndarray, np.ndarray]:
    factor = RNG.normal(size=(4, 4))
    scale = np.array([30.0, 10.0, 2.0, 1.0])
    return scale * RNG.normal(size=4), (factor @ factor.T + 0.1 * np.eye(4)) * np.outer(scale, scale)


def relative(actual, expected) -> float:
    """Largest difference of an entry, in units of the standard deviations it belongs to."""
    std = np.sqrt(np.diag(expected))
    return float((np.abs(np.asarray(actual) - expected) / np.outer(std, std)).max())


@pytest.mark.parametrize("dt", [1e-6, 0.01, 1.0, 10.0, 1e3, 1e6])
@pytest.mark.parametrize("kind", ["white", "fixed", "none"])
def test_prediction_is_the_textbook_one(dt, kind):
    """To 1e-12."""
    q = RNG.normal(size=(4, 4))
    noise = {
        "white": WhiteAcceleration(jnp.asarray(0.3)),
        "none": WhiteAcceleration(jnp.asarray(0.0)),
        "fixed": FixedNoise.of(q @ q.T),
    }[kind]
    Q = {
        "white": 0.3 * np.kron([[dt**3 / 3.0, dt**2 / 2.0], [dt**2 / 2.0, dt]], np.eye(2)),
        "none": np.zeros((4, 4)),
        "fixed": q @ q.T,
    }[kind]
    F = np.kron([[1.0, dt], [0.0, 1.0]], np.eye(2))
    for _ in range(5):
        mean, cov = random_belief()
        step = jnp.asarray(dt)
        found = kinematics.predict(Kinematics.of(jnp.asarray(mean), jnp.asarray(cov)), noise(step), step)
        assert relative(found.cov(), F @ cov @ F.T + Q) < 1e-12
        np.testing.assert_allclose(np.asarray(found.mean()), F @ mean, rtol=1e-12)
        assert np.array_equal(np.asarray(found.cov()), np.asarray(found.cov()).T)


def test_mean_and_covariance_survive_factoring():
    for _ in range(5):
        mean, cov = random_belief()
        belief = Kinematics.of(jnp.asarray(mean), jnp.asarray(cov))
        assert relative(belief.cov(), cov) < 1e-13
        np.testing.assert_array_equal(np.asarray(belief.mean()), mean)


def test_position_update_is_the_kalman_filter():
    H = np.hstack([np.eye(2), np.zeros((2, 2))])
    for _ in range(5):
        mean, cov = random_belief()
        noise, z = np.array([[4.0, 1.0], [1.0, 2.0]]), RNG.normal(size=2)
        belief = Kinematics.of(jnp.asarray(mean), jnp.asarray(cov))
        weight = (belief.position_cov + Sym2.of(noise)).inverse()
        position = belief.position + belief.position_cov @ (weight @ (Vec2.of(z) - belief.position))
        found = kinematics.with_position(belief, position, parallel(belief.position_cov, Sym2.of(noise)))
        K = cov @ H.T @ np.linalg.inv(H @ cov @ H.T + noise)
        np.testing.assert_allclose(np.asarray(found.mean()), mean + K @ (z - H @ mean), rtol=1e-11)
        assert relative(found.cov(), cov - K @ H @ cov) < 1e-12


@pytest.mark.parametrize("psd", [0.0, 1e-6, 1.0])
def test_long_chains_stay_definite(psd):
    """Steps of 1 ms and of an hour in turn, an accurate position in between: all factors stay positive."""
    noise, sensor = (
        WhiteAcceleration(jnp.asarray(psd)),
        Sym2(jnp.asarray(1e-6), jnp.asarray(0.0), jnp.asarray(1.0)),
    )

    def step(belief, k):
        dt = jnp.where(k % 2 == 0, 1e-3, 3600.0)
        belief = kinematics.predict(belief, noise(dt), dt)
        belief = kinematics.with_position(belief, belief.position, parallel(belief.position_cov, sensor))
        return belief, (belief.position_cov, belief.velocity_cov)

    start = Kinematics.of(jnp.zeros(4), jnp.diag(jnp.array([1e12, 1e12, 1e6, 1e6])))
    _, covs = jax.lax.scan(step, start, jnp.arange(2000))
    for cov in covs:
        assert float(cov.xx.min()) > 0.0
        assert float(cov.yy.min()) > 0.0
        assert float(cov.det().min()) > 0.0

"""The random track: statistics of its increments, and the object at rest."""

import jax
import numpy as np
import pytest

from emt.scenarios import constant_velocity, stationary
from emt.scenarios.constant_velocity import ConstantVelocitySettings
from emt.scenarios.stationary import StationarySettings
from tests.filters.cases import FAST_COMPILE, cast

DETECTIONS = {
    "count": {"kind": "fixed", "count": 3},
    "source": "uniform",
    "noise_cov": ((1.0, 0.0), (0.0, 1.0)),
}
STEPS, DT, PSD, TURN = 4000, 0.7, 0.3, 0.02


def settings_of(**changes) -> ConstantVelocitySettings:
    given = {
        "dt": DT,
        "steps": STEPS,
        "position": (5.0, -3.0),
        "velocity": (10.0, 10.0),
        "orientation": 0.5,
        "acceleration_psd": PSD,
        "orientation_noise": TURN,
        "semi_axes": (4.0, 2.0),
        "detections": DETECTIONS,
    }
    return ConstantVelocitySettings(**(given | changes))


def truth_of(settings, key=0):
    params, make = constant_velocity.build(settings, 1)
    return jax.tree.map(np.asarray, jax.jit(make(cast(params, np.float64)).sample_truth)(jax.random.key(key)))


@pytest.fixture(scope="module")
def increments():
    """(position noise, velocity noise, turn) of every step."""
    truth = truth_of(settings_of())
    position = np.concatenate([[[5.0, -3.0]], truth.position])
    velocity = np.concatenate([[[10.0, 10.0]], truth.velocity])
    angle = np.concatenate([[0.5], truth.ellipse.orientation])
    shift = np.diff(position, axis=0) - DT * velocity[:-1]
    return np.concatenate([shift, np.diff(velocity, axis=0), np.diff(angle)[:, None]], axis=1)


def test_increments_have_the_covariance_of_the_model(increments):
    """White acceleration on each axis and an independent turn: within five standard errors."""
    expected = np.zeros((5, 5))
    expected[:4, :4] = PSD * np.kron([[DT**3 / 3, DT**2 / 2], [DT**2 / 2, DT]], np.eye(2))
    expected[4, 4] = TURN
    std = np.sqrt(np.diag(expected))
    assert (np.abs(increments.mean(axis=0)) < 5.0 * std / np.sqrt(STEPS)).all()
    error = np.abs(np.cov(increments.T) - expected) / np.outer(std, std)
    assert error.max() < 5.0 * np.sqrt(2.0 / STEPS)


def test_increments_are_white(increments):
    """Neighbouring steps are uncorrelated."""
    scaled = increments / increments.std(axis=0)
    assert np.abs(scaled[1:].T @ scaled[:-1] / (STEPS - 1)).max() < 5.0 / np.sqrt(STEPS)


def test_track_without_noise_is_straight():
    truth = truth_of(settings_of(acceleration_psd=0.0, orientation_noise=0.0, steps=10))
    steps = np.arange(1, 11)[:, None]
    np.testing.assert_allclose(truth.position, [5.0, -3.0] + DT * steps * [10.0, 10.0], rtol=1e-12)
    np.testing.assert_array_equal(truth.velocity, np.full((10, 2), 10.0))
    np.testing.assert_array_equal(truth.ellipse.orientation, np.full(10, 0.5))
    np.testing.assert_array_equal(truth.ellipse.semi_axes, np.broadcast_to([4.0, 2.0], (10, 2)))


def test_longer_track_extends_a_shorter_one():
    long, short = truth_of(settings_of(steps=30)), truth_of(settings_of(steps=10))
    np.testing.assert_array_equal(long.position[:10], short.position)
    assert not np.array_equal(truth_of(settings_of(steps=10), key=1).position, short.position)


def test_stationary_object_stays():
    settings = StationarySettings(
        steps=4, position=(3.0, 4.0), orientation=0.2, semi_axes=(2.0, 1.0), detections=DETECTIONS
    )
    params, make = stationary.build(settings, 1)
    scenario = make(cast(params, np.float64))
    truth = scenario.sample_truth(jax.random.key(0))
    np.testing.assert_array_equal(np.asarray(truth.position), np.broadcast_to([3.0, 4.0], (4, 2)))
    np.testing.assert_array_equal(np.asarray(truth.velocity), np.zeros((4, 2)))
    np.testing.assert_array_equal(np.asarray(truth.ellipse.orientation), np.full(4, 0.2))
    scans = jax.jit(scenario.sample_scans, compiler_options=FAST_COMPILE)(truth, jax.random.key(1))
    assert scans.points.shape == (4, 3, 2)
    assert scenario.dt.shape == (settings.n_steps,)
    assert np.abs(np.asarray(scans.points) - [3.0, 4.0]).max() < 10.0

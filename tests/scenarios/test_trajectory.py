"""The trajectory of legs and turns of Tuncer and Özkan 2021, Sec. VI."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from ruamel.yaml import YAML

from emt.scenarios import trajectory
from emt.scenarios.trajectory import TrajectorySettings, headings_and_speeds
from tests.filters.cases import FAST_COMPILE, cast

SPEED = 500.0 / 36.0
PI = np.pi


def settings_of(**changes) -> TrajectorySettings:
    given = {
        "dt": 10.0,
        "speed": SPEED,
        "semi_axes": (170.0, 40.0),
        "legs": (
            {"steps": 20, "heading": -PI / 4},
            {"steps": 11, "heading": (-PI / 4, 0.0)},
            {"steps": 10, "heading": 0.0},
            {"steps": 11, "heading": (0.0, PI / 2)},
            {"steps": 20, "heading": PI / 2},
            {"steps": 11, "heading": (PI / 2, PI)},
            {"steps": 20, "heading": PI},
        ),
        "detections": {
            "count": {"kind": "poisson", "mean": 20.0},
            "source": "uniform",
            "noise_cov": ((200.0, 0.0), (0.0, 200.0)),
        },
    }
    return TrajectorySettings(**(given | changes))


def truth_of(settings: TrajectorySettings):
    params, make = trajectory.build(settings, 1)
    return jax.tree.map(np.asarray, make(cast(params, np.float64)).sample_truth(jax.random.key(0)))


def test_published_trajectory():
    """103 scans; turns in steps of π/40 and π/20; 500/36 m/s; from the origin; ellipse along the heading."""
    settings = settings_of()
    truth = truth_of(settings)
    heading = truth.ellipse.orientation
    assert settings.n_steps == len(heading) == 103
    expected = np.concatenate(
        [
            np.full(20, -PI / 4),
            -PI / 4 + PI / 40 * np.arange(11),
            np.zeros(10),
            PI / 20 * np.arange(11),
            np.full(20, PI / 2),
            PI / 2 + PI / 20 * np.arange(11),
            np.full(20, PI),
        ]
    )
    np.testing.assert_allclose(heading, expected, atol=1e-14)
    np.testing.assert_allclose(np.hypot(*truth.velocity.T), SPEED, rtol=1e-14)
    np.testing.assert_allclose(truth.velocity, SPEED * np.stack([np.cos(expected), np.sin(expected)], 1), atol=1e-12)
    np.testing.assert_array_equal(truth.position[0], [0.0, 0.0])
    np.testing.assert_allclose(np.diff(truth.position, axis=0), 10.0 * truth.velocity[1:], atol=1e-10)
    np.testing.assert_array_equal(truth.ellipse.semi_axes, np.broadcast_to([170.0, 40.0], (103, 2)))


def test_start_and_speed_of_a_leg():
    legs = (
        {"steps": 3, "heading": 0.0},
        {"steps": 2, "heading": PI / 2, "speed": 1.0},
        {"steps": 1, "heading": 1.0},
    )
    settings = settings_of(dt=1.0, speed=2.0, start=(5.0, 6.0), legs=legs)
    headings, speeds = headings_and_speeds(settings)
    np.testing.assert_array_equal(speeds, [2.0, 2.0, 2.0, 1.0, 1.0, 2.0])
    assert len(headings) == settings.n_steps == 6
    position = truth_of(settings).position
    np.testing.assert_allclose(position[:5], [[5, 6], [7, 6], [9, 6], [9, 7], [9, 8]], atol=1e-12)


def test_truth_is_the_same_in_every_run_and_scans_are_not():
    params, make = trajectory.build(settings_of(), 1)
    scenario = make(cast(params, np.float64))
    np.testing.assert_array_equal(np.asarray(scenario.dt), np.full(103, 10.0))
    truth, again = scenario.sample_truth(jax.random.key(0)), scenario.sample_truth(jax.random.key(1))
    np.testing.assert_array_equal(np.asarray(truth.position), np.asarray(again.position))
    sample = jax.jit(scenario.sample_scans, compiler_options=FAST_COMPILE)
    first, second = sample(truth, jax.random.key(0)), sample(truth, jax.random.key(1))
    assert bool(jnp.any(first.mask != second.mask))
    assert first.points.shape[:1] == (103,)
    assert abs(float(first.mask.sum(axis=1).mean()) - 20.0) < 5.0 * np.sqrt(20.0 / 103)


@pytest.mark.parametrize("name", ["trajectory_uniform.yaml", "trajectory_gaussian.yaml"])
def test_shipped_configuration_is_the_published_trajectory(name):
    text = (Path(__file__).parents[2] / "configs" / "tuncer2021" / name).read_text(encoding="utf-8")
    settings = TrajectorySettings.model_validate(YAML(typ="safe").load(text)["scenario"])
    np.testing.assert_allclose(headings_and_speeds(settings)[0], headings_and_speeds(settings_of())[0], atol=1e-9)
    np.testing.assert_allclose(headings_and_speeds(settings)[1], SPEED, rtol=1e-9)

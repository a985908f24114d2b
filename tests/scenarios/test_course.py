"""The course of a vehicle: its trajectory, its box, and what is refused."""

import jax
import numpy as np
import pytest
from pydantic import ValidationError

from emt.scenarios.course import CourseSettings, build, trajectory

SETTINGS = {
    "kind": "course",
    "dt": 0.5,
    "steps": 41,
    "start": [3.0, -2.0],
    "heading": "90 deg",
    "speed": [[0.0, 2.0], [10.0, 4.0]],
    "turn_rate": [[5.0, 0.0], [6.0, 0.3], [9.0, 0.3], [10.0, 0.0]],
    "box": [8.0, 2.0],
    "detections": {"count": {"kind": "fixed", "count": 400}, "source": "box", "noise_cov": {"diagonal": [0.0, 0.0]}},
}


def test_straight_part_follows_the_heading():
    position, velocity, heading = trajectory(CourseSettings.model_validate(SETTINGS))
    np.testing.assert_allclose(heading[:10], np.pi / 2)
    np.testing.assert_allclose(position[:10, 0], 3.0, atol=1e-12)
    speeds = np.hypot(*velocity.T)
    np.testing.assert_allclose(speeds, np.interp(0.5 * np.arange(41), [0, 10], [2, 4]))
    np.testing.assert_allclose(np.diff(position[:10, 1]), 0.5 * speeds[:9])


def test_heading_is_the_sum_of_the_turn_rates():
    _, _, heading = trajectory(CourseSettings.model_validate(SETTINGS))
    times = 0.5 * np.arange(41)
    rates = np.interp(times, [5, 6, 9, 10], [0, 0.3, 0.3, 0])
    np.testing.assert_allclose(heading[-1] - heading[0], 0.5 * rates.sum())


def test_fine_steps_approach_the_integral():
    fine = CourseSettings.model_validate({**SETTINGS, "dt": 0.001, "steps": 12001})
    position, _, _ = trajectory(fine)
    t = np.linspace(0.0, 12.0, 240_001)
    heading = np.pi / 2 + np.cumsum(np.interp(t, [5, 6, 9, 10], [0, 0.3, 0.3, 0])) * 5e-5
    speed = np.interp(t, [0, 10], [2, 4])
    end = np.array([3.0, -2.0]) + 5e-5 * np.array([speed @ np.cos(heading), speed @ np.sin(heading)])
    np.testing.assert_allclose(position[-1], end, atol=0.01)


def test_points_fill_the_box_and_lie_in_the_true_ellipse():
    settings = CourseSettings.model_validate(SETTINGS)
    params, make = build(settings, 4)
    scenario = make(jax.tree.map(np.asarray, params))
    truth = scenario.sample_truth(jax.random.key(0))
    scans = scenario.sample_scans(truth, jax.random.key(1))
    turn = np.exp(-1j * np.asarray(truth.ellipse.orientation))[:, None]
    gaps = (np.asarray(scans.points) - np.asarray(truth.position)[:, None, :]) @ [1.0, 1j] * turn
    along, across = gaps.real, gaps.imag
    assert 3.9 < np.abs(along).max() <= 4.0 + 1e-9
    assert 0.99 < np.abs(across).max() <= 1.0 + 1e-9
    axes = np.asarray(truth.ellipse.semi_axes)[0]
    assert ((along / axes[0]) ** 2 + (across / axes[1]) ** 2).max() <= 1.0 + 1e-9
    np.testing.assert_allclose(axes, [4.0 * np.sqrt(2.0), np.sqrt(2.0)])


def test_times_out_of_order_are_refused():
    with pytest.raises(ValidationError, match="times must increase, but 3 s follows 5 s"):
        CourseSettings.model_validate({**SETTINGS, "speed": [[5.0, 1.0], [3.0, 1.0]]})


def test_maneuvers_are_where_the_rate_is_not_zero():
    assert CourseSettings.model_validate(SETTINGS).maneuvers == ((11.0, 21.0),)
    straight = CourseSettings.model_validate({**SETTINGS, "turn_rate": [[0.0, 0.0], [5.0, 0.0]]})
    assert straight.maneuvers == ()

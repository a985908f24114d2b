"""Coordinated turns as a true track: exact at any scan, whatever the scans' times."""

import numpy as np
import pytest
from pydantic import ValidationError

from emt.scenarios.coordinated_turns import CoordinatedTurnsSettings, trajectory

SETTINGS = {
    "kind": "coordinated_turns",
    "dt": 1.0,
    "steps": 31,
    "velocity": [3.0, 1.0],
    "turns": [{"start": 4.5, "duration": 6.0, "rate": 0.2}, {"start": 15.0, "duration": 5.0, "rate": -0.3}],
    "semi_axes": [3.0, 1.0],
    "detections": {"count": {"kind": "fixed", "count": 4}, "source": "uniform", "noise_cov": {"diagonal": [0.0, 0.0]}},
}


def test_against_integration():
    position, velocity, angle = trajectory(CoordinatedTurnsSettings.model_validate(SETTINGS))
    h = 1e-4
    t = (np.arange(300_000) + 0.5) * h
    rate = np.where((t >= 4.5) & (t < 10.5), 0.2, 0.0) + np.where((t >= 15.0) & (t < 20.0), -0.3, 0.0)
    turned = np.concatenate([[0.0], np.cumsum(rate * h)])
    speed = (3.0 + 1.0j) * np.exp(0.5j * (turned[1:] + turned[:-1]))
    path = np.concatenate([[0.0], np.cumsum(speed * h)])[::10_000]
    np.testing.assert_allclose(position[:, 0] + 1j * position[:, 1], path, atol=1e-6)
    np.testing.assert_allclose(angle, turned[::10_000], atol=1e-9)
    np.testing.assert_allclose(np.hypot(*velocity.T), np.sqrt(10.0), rtol=1e-12)


def test_other_scan_times_lie_on_the_same_path():
    every, _, _ = trajectory(CoordinatedTurnsSettings.model_validate(SETTINGS))
    late = {**SETTINGS, "first_scan": 6.0, "dt": 3.0, "steps": 5}
    some, _, _ = trajectory(CoordinatedTurnsSettings.model_validate(late))
    np.testing.assert_allclose(some, every[6:19:3], rtol=1e-12)


def test_maneuvers_are_counted_in_scans():
    assert CoordinatedTurnsSettings.model_validate(SETTINGS).maneuvers == ((5.5, 11.5), (16.0, 21.0))


def test_turns_that_overlap_are_refused():
    turns = [{"start": 1.0, "duration": 3.0, "rate": 0.2}, {"start": 3.5, "duration": 1.0, "rate": 0.2}]
    with pytest.raises(ValidationError, match=r"turn 2 starts at 3\.5 s, before the end of the one before it"):
        CoordinatedTurnsSettings.model_validate({**SETTINGS, "turns": turns})

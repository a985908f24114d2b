"""Simulated connected objects: their motion, the components of their points, clutter."""

from functools import cache

import jax
import numpy as np
import pytest
from pydantic import ValidationError

from emt.montecarlo.program import cast
from emt.scenarios.connected import ConnectedScenarioSettings, build
from tests.shapes.test_connected import ARM

SCENARIO = {
    "kind": "connected",
    "shape": ARM,
    "steps": 4000,
    "lengths": {"length_a": 1.0, "length_b": 1.5},
    "angles": {
        "alpha_a": {"center": "90 deg", "amplitude": 1.0, "rate": 1e-3},
        "alpha_b": {"center": 1.0},
        "alpha_c": {"center": 1.0, "amplitude": 0.5, "rate": 0.01, "phase": "90 deg"},
    },
    "noise_cov": [[0.01, 0.0], [0.0, 0.01]],
}


def run(key=0, **changes):
    """(truth, scans) of one run."""
    params, make = build(ConnectedScenarioSettings.model_validate({**SCENARIO, **changes}), 10)
    scenario = make(cast(params, np.float64))
    keys = jax.random.split(jax.random.key(key))
    truth = scenario.sample_truth(keys[0])
    return truth, jax.jit(scenario.sample_scans)(truth, keys[1])


@cache
def plain():
    return run()


def test_angles_swing_as_stated():
    truth, _ = plain()
    k = np.arange(1, 4001)
    state = np.asarray(truth.state)
    np.testing.assert_allclose(state[:, 0], 1.0)
    np.testing.assert_allclose(state[:, 3], 1.5)
    np.testing.assert_allclose(state[:, 1], np.pi / 2 + np.sin(1e-3 * k), atol=1e-12)
    np.testing.assert_allclose(state[:, 2], 1e-3 * np.cos(1e-3 * k), atol=1e-15)
    np.testing.assert_allclose(state[:, 4:6], [[1.0, 0.0]] * 4000)
    np.testing.assert_allclose(state[:, 6], 1.0 + 0.5 * np.cos(0.01 * k), atol=1e-12)


def test_components_are_drawn_evenly_and_points_stay_near_them():
    _, scans = plain()
    counts = np.bincount(np.asarray(scans.sources)[:, 0], minlength=5)
    assert np.abs(counts - 800).max() < 4.0 * np.sqrt(640)
    hub = np.asarray(scans.points)[np.asarray(scans.sources) == 0]
    reach = np.hypot(*hub.T)
    assert (hub**2).sum(axis=1).mean() == pytest.approx(0.3**2 / 2 + 0.02, rel=0.1)
    assert reach.max() < 0.3 + 5 * 0.1
    assert np.asarray(scans.mask).all()


def test_probabilities_and_several_points():
    chances = {"hub": 0.5, "upper": 0.5, "lower": 0.0, "finger_1": 0.0, "finger_2": 0.0}
    _, scans = run(steps=500, probabilities=chances, points=3)
    assert scans.points.shape == (500, 3, 2)
    assert set(np.unique(scans.sources)) == {0, 2}  # in the order of the file
    assert np.mean(np.asarray(scans.sources) == 0) == pytest.approx(0.5, abs=0.06)


def test_a_markov_chain_of_components_persists():
    _, scans = run(markov={"stay": 0.9}, points=2)
    sources = np.asarray(scans.sources)
    np.testing.assert_array_equal(sources[:, 0], sources[:, 1])
    assert (sources[1:, 0] == sources[:-1, 0]).mean() == pytest.approx(0.9, abs=0.02)
    assert np.bincount(sources[:, 0], minlength=5).min() > 400


def test_clutter_is_even_over_its_rectangle():
    _, scans = run(clutter={"probability": 0.3, "low": [-4.0, 1.0], "high": [2.0, 3.0]})
    points, is_clutter = np.asarray(scans.points)[:, 0], np.asarray(scans.sources)[:, 0] == -1
    assert is_clutter.mean() == pytest.approx(0.3, abs=0.03)
    np.testing.assert_allclose(points[is_clutter].mean(axis=0), [-1.0, 2.0], atol=0.2)
    np.testing.assert_allclose(points[is_clutter].var(axis=0), [3.0, 1.0 / 3.0], rtol=0.1)


@pytest.mark.bits
def test_runs_differ_and_repeat():
    np.testing.assert_array_equal(run()[1].points, plain()[1].points)
    assert not np.array_equal(run(key=1)[1].points, plain()[1].points)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"lengths": {"length_a": 1.0}}, "lengths: no value for length_b"),
        ({"lengths": {"length_a": 1.0, "length_b": 1.0, "length_x": 1.0}}, "no length 'length_x' .did you mean"),
        ({"lengths": {"length_a": -1.0, "length_b": 1.0}}, "greater than 0"),
        ({"angles": {**SCENARIO["angles"], "alpha": {"center": 0.0}}}, "no angle 'alpha'"),
        ({"probabilities": {"hub": 0.5, "upper": 0.6, "lower": 0, "finger_1": 0, "finger_2": 0}}, "sum to 1.1, not 1"),
        ({"probabilities": {"hub": 1.0}}, "no probability for finger_1, upper"),
        ({"probabilities": {"hubb": 1.0}}, "unknown component 'hubb' .did you mean 'hub'"),
        ({"markov": {"transition": [[0.5, 0.5], [0.5, 0.5]]}}, "expected 5 rows of 5"),
        ({"markov": {"transition": (np.eye(5) * 0.9).tolist()}}, "sums to 0.9, not 1"),
        ({"markov": {"transition": np.eye(5)[[0, 0, 1, 2, 3]].T.tolist()}}, "give the transpose"),
        ({"markov": {}}, "one of stay, changes or transition"),
    ],
    ids=str,
)
def test_what_cannot_be(changes, message):
    with pytest.raises(ValidationError, match=message):
        ConnectedScenarioSettings.model_validate({**SCENARIO, **changes})

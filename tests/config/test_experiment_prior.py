"""What a prior and a multiple-model filter may not be, and that drawn priors are drawn."""

import numpy as np
import pytest
from pydantic import ValidationError

from emt.config.experiment import PriorSettings
from emt.config.load import load_experiment
from emt.filters.imm import ImmSettings
from emt.filters.moment_ukf import MomentUkfSettings
from emt.montecarlo.program import Program
from emt.scenarios.coordinated_turns import CoordinatedTurnsSettings, trajectory

PRIOR = {"mean": [0, 0, 1, 0], "cov": {"diagonal": [1, 1, 1, 1]}}
STRAIGHT = {
    "kind": "moment_ukf",
    "motion": {"kind": "constant_velocity", "psd": 0.1, "moment_noise": [1, 1, 1]},
    "moment_cov": [1, 1, 1],
}
MATRIX = {"kind": "lan_li", "degrees_of_freedom": 10.0, "psd": 0.1, "agility": 10}
EVEN = [[0.5, 0.5], [0.5, 0.5]]


@pytest.mark.parametrize(
    ("shape", "message"),
    [
        ({"moments": [5, 4, 4]}, "not those of an ellipse"),
        ({"moments": [0, -4, -4]}, "not those of an ellipse"),
        ({}, "either by semi_axes or by moments"),
        ({"moments": [0, 4, 4], "semi_axes": [1, 1]}, "either by semi_axes or by moments"),
        ({"moments": [0, 4, 4], "orientation": 0.1}, "the moments already give it"),
    ],
)
def test_impossible_prior_shapes_are_refused(shape, message):
    with pytest.raises(ValidationError, match=message):
        PriorSettings.model_validate({**PRIOR, **shape})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"transition": [[0.9, 0.2], [0.5, 0.5]]}, r"row 0 \(from 'a'\) sums to 1.1, not 1"),
        ({"transition": [[0.5, 0.5]]}, "expected 2 rows of 2"),
        ({"start": [0.5, 0.6]}, "expected 2 probabilities that sum to 1"),
        ({"modes": {"a": STRAIGHT, "b": MATRIX}}, "no common component"),
    ],
)
def test_impossible_modes_are_refused(change, message):
    good = {"kind": "imm", "modes": {"a": MATRIX, "b": MATRIX}, "transition": EVEN}
    ImmSettings.model_validate(good)
    with pytest.raises(ValidationError, match=message):
        ImmSettings.model_validate({**good, **change})


def test_infinite_weight_is_refused():
    MomentUkfSettings.model_validate({**STRAIGHT, "kappa": -8.9})
    with pytest.raises(ValidationError, match="kappa must be greater than -9"):
        MomentUkfSettings.model_validate({**STRAIGHT, "kappa": -9.0})


def test_each_run_draws_its_prior_and_all_filters_share_it():
    program = Program.of(load_experiment("yao2020/linear").experiment)
    priors = [program.prior_of_run(program.world.prior, np.int64(5), np.int64(run)) for run in range(200)]
    means = np.array([p.mean for p in priors])
    np.testing.assert_allclose(means.mean(0), [0, 80, 4, 2], atol=4 * 3 / np.sqrt(200))
    np.testing.assert_allclose(means.std(0), [3, 3, 0.18**0.5, 0.18**0.5], rtol=0.2)
    again = program.prior_of_run(program.world.prior, np.int64(5), np.int64(3))
    np.testing.assert_array_equal(again.mean, priors[3].mean)


TURNING = {
    "kind": "coordinated_turns",
    "dt": 0.7,
    "steps": 60,
    "velocity": [3.0, 1.0],
    "position": [2.0, -1.0],
    "turns": [{"start": 3.33, "duration": 8.1, "rate": 0.2}, {"start": 20.0, "duration": 5.0, "rate": -0.4}],
    "semi_axes": [2, 1],
    "detections": {"count": {"kind": "fixed", "count": 1}, "source": "uniform", "noise_cov": [0.0, 0.0]},
}


def test_turns_between_scans_are_exact():
    position, velocity, angle = trajectory(CoordinatedTurnsSettings.model_validate(TURNING))
    t = np.linspace(0.0, 0.7 * 59, 2_000_001)
    h = t[1]
    rate = np.where((t >= 3.33) & (t < 11.43), 0.2, 0.0) + np.where((t >= 20.0) & (t < 25.0), -0.4, 0.0)
    turned = np.concatenate([[0.0], np.cumsum(rate[:-1]) * h])
    track = 2.0 - 1.0j + np.concatenate([[0.0], np.cumsum((3.0 + 1.0j) * np.exp(1j * turned[:-1])) * h])
    at = np.rint(0.7 * np.arange(60) / h).astype(int)
    np.testing.assert_allclose(position @ [1.0, 1j], track[at], atol=1e-3)
    np.testing.assert_allclose(angle, turned[at], atol=1e-4)
    np.testing.assert_allclose(np.hypot(*velocity.T), np.sqrt(10.0))


def test_overlapping_turns_are_refused():
    turns = [{"start": 0.0, "duration": 5.0, "rate": 0.1}, {"start": 4.0, "duration": 5.0, "rate": 0.1}]
    with pytest.raises(ValidationError, match="turn 2 starts at 4 s, before the end"):
        CoordinatedTurnsSettings.model_validate({**TURNING, "turns": turns})

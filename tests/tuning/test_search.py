"""Searches on small experiments: scores, slopes, and answers that are known."""

import math

import jax
import numpy as np
import pytest

from emt.config.errors import ConfigError
from emt.config.load import load_experiment
from emt.metrics.base import find_metric
from emt.montecarlo.chunks import Engine
from emt.runner import build_program
from emt.tuning.gradient import Descent
from emt.tuning.parameters import candidate, parse_parameters
from emt.tuning.scoring import Batch
from emt.tuning.search import plan_of, search
from emt.tuning.trial import build_trial, grouped
from tests.montecarlo.small import TEXT, write

MOMENTS = """
  moments:
    kind: moment_ukf
    motion: {kind: constant_velocity, psd: 0.01, moment_noise: {diagonal: [0.1, 0.1, 0.1]}}
    moment_cov: {diagonal: [2, 3, 4]}
    projection: {ratio: 0.01, floor: 0.01}
  vb:
    kind: vb
"""
NUMBERS = {"tuning_runs": 12, "reporting_runs": 12, "steps": 4, "rate": 0.3}


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    return load_experiment(str(write(tmp_path_factory.mktemp("tune"))))


@pytest.fixture(scope="module")
def moments(tmp_path_factory):
    text = TEXT.replace("\nmetrics:", MOMENTS.rsplit("  vb:", 1)[0] + "metrics:").replace("steps: 4", "steps: 3")
    return load_experiment(str(write(tmp_path_factory.mktemp("tune"), text)))


def test_scores_are_those_of_a_run(small):
    """Same runs, same numbers as the engine stores; shares average to the metric as tables show it."""
    names = ("gw", "position_rmse")
    batch = Batch(small, "feldmann", [find_metric(name) for name in names], 0, 16)
    (scores,) = batch.score([build_trial(small.experiment, "feldmann")])
    engine = Engine(build_program(small), 3, 16)
    engine.compile()
    arrays = engine.run_chunk(0, 16)
    np.testing.assert_allclose(scores[0].shares, arrays["feldmann/values"][:, 0], rtol=1e-12)
    squares = arrays["feldmann/step_sum"].sum(axis=0)[:, 2] / 16
    assert scores[1].value == pytest.approx(np.sqrt(squares).mean(), rel=1e-12)
    assert scores[1].value == pytest.approx(scores[1].shares.mean(), rel=1e-12)


def test_candidates_share_a_compilation_unless_their_structure_differs(small):
    (weight,) = parse_parameters(["filters.feldmann.weight=4,8,16"], small, grid=True)
    trials = [build_trial(candidate(small, [weight], [v]).experiment, "feldmann") for v in weight.values]
    assert grouped(trials) == [[0, 1, 2]]
    assert grouped([trials[0], trials[1], trials[0]]) == [[0, 1], [2]]
    batch = Batch(small, "feldmann", [find_metric("gw")], 0, 5)
    together = batch.score(trials)
    assert batch.score(trials[2:])[0][0].value == pytest.approx(together[2][0].value, rel=1e-12)
    assert len({scores[0].value for scores in together}) == 3


def test_a_grid_finds_the_better_value_and_reports_on_other_runs(small):
    poor = load_experiment(str(small.source.path), ["filters.feldmann.weight=2000"])
    found = parse_parameters(["filters.feldmann.weight=2,20,200", "filters.feldmann.decay.factor=0.5,0.8"], poor, True)
    outcome = search(poor, "feldmann", found, plan_of(poor, "grid", None, **NUMBERS))
    assert len(outcome.tried) == 7
    best = min(outcome.tried, key=lambda one: one.objective)
    assert outcome.values == best.values
    tuning, reporting = (next(c for c in outcome.comparisons if c.runs == runs) for runs in ("tuning", "reporting"))
    assert tuning.tuned.value == pytest.approx(best.objective, rel=1e-12)
    assert tuning.tuned.value != reporting.tuned.value
    assert {c.metric.name for c in outcome.comparisons} == {"gw", "position_rmse"}
    gap, error = tuning.tuned.above(tuning.start)
    assert gap == pytest.approx(tuning.tuned.value - tuning.start.value, rel=1e-9)
    assert 0.0 < error < tuning.start.error + tuning.tuned.error


SLOPED = {
    "moments": ["filters.moments.moment_cov.diagonal[0]", "filters.moments.motion.psd=0.001:10", "model.prior.mean[0]"],
    "feldmann": ["filters.feldmann.weight", "model.process_noise.psd=0.001:10", "model.prior.mean[0]"],
}


@pytest.mark.parametrize(
    ("label", "metric"),
    [("moments", "soft_iou"), ("feldmann", "nll"), pytest.param("moments", "gw", marks=pytest.mark.slow)],
)
def test_slopes_are_those_of_finite_differences(moments, label, metric):
    found = parse_parameters(SLOPED[label], moments, grid=False)
    batch = Batch(moments, label, [find_metric(metric)], 0, 3)
    descent = Descent(batch, moments, found)
    theta = np.array([p.theta(p.start) for p in found])
    slopes = descent.at(theta).gradient
    value = jax.jit(descent.value)
    for k, slope in enumerate(slopes):
        ends = [
            float(value(descent.trial(theta + h * np.eye(3)[k]).trial, batch.data)[0])
            for h in (-2e-4, -1e-4, 1e-4, 2e-4)
        ]
        expected = (ends[0] - 8.0 * ends[1] + 8.0 * ends[2] - ends[3]) / 12e-4
        assert slope == pytest.approx(expected, rel=1e-6, abs=1e-9), k
        assert slope != 0.0


def test_a_gradient_goes_downhill(moments):
    found = parse_parameters(["filters.moments.moment_cov"], moments, grid=False)
    with jax.numpy_dtype_promotion("standard"):  # optax mixes integers and floats
        outcome = search(moments, "moments", found, plan_of(moments, "gradient", "iou", **NUMBERS))
    followed, objective = outcome.comparisons[:2]
    assert (followed.metric.name, objective.metric.name) == ("soft_iou", "iou")
    assert objective.tuned.value > objective.start.value
    assert outcome.tried[-1].followed > outcome.tried[0].followed
    scored = [one for one in outcome.tried if np.isfinite(one.objective)]
    assert max(one.objective for one in scored) == pytest.approx(objective.tuned.value, abs=1e-4)
    assert outcome.values != tuple(p.start for p in found)
    assert all(float(f"{value:.4g}") == value for value in outcome.values)


@pytest.mark.parametrize(
    ("objective", "message"),
    [("nees", "no better or worse"), ("gw_std", "no better or worse"), ("gv", "unknown metric 'gv'")],
)
def test_what_cannot_be_an_objective(small, objective, message):
    with pytest.raises(ConfigError, match=message):
        plan_of(small, "grid", objective, **NUMBERS)


def test_runs_that_fail_are_left_out_of_shares():
    from emt.tuning.scoring import Score

    sound = np.array([True, True, False, True])
    one = Score(2.0, np.array([1.0, 2.0, 0.0, 3.0]), sound)
    other = Score(1.0, np.array([1.0, 1.0, 9.0, 2.0]), np.array([True, True, True, False]))
    assert one.failed == 1
    assert one.error == pytest.approx(1.0 / math.sqrt(3.0))
    assert one.above(other) == (pytest.approx(0.5), pytest.approx(math.sqrt(0.5) / math.sqrt(2.0)))

"""How values of steps and runs become one number with its error, and the metrics of points, against plain NumPy."""

import math
from typing import get_args

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import chi2

import emt.metrics.catalogue  # noqa: F401 - fills the catalogue
from emt.averaging import OF_SINGLE_RUNS, OverRuns
from emt.metrics.base import METRICS, find_metric, has, under_rule
from emt.reports.gathering import FilterResults
from emt.reports.summary import (
    band,
    peak_over_steps,
    pooled_over_runs,
    share_in_band,
    standard_error_of_std,
    summarise_metric,
)
from emt.status import Status
from emt.types import Ellipse, Estimate, Info, Point, Truth

BLOCKS, PER_BLOCK, STEPS, FIRST = 8, 6, 10, 3
RUNS = BLOCKS * PER_BLOCK


def results_of(squares: np.ndarray, status: np.ndarray | None = None, over_time: str = "rms") -> FilterResults:
    """What is stored of squared errors (run, step) of one metric; failed runs count nowhere."""
    runs = len(squares)
    status = np.zeros(runs, int) if status is None else status
    sound = (status & int(Status.DIVERGED)) == 0
    kept = np.where(sound[:, None], squares, 0.0)
    means = squares[:, FIRST:].mean(axis=1)
    blocks = np.array_split(np.arange(runs), BLOCKS)
    return FilterResults(
        values=(np.sqrt(means) if over_time == "rms" else means)[None, sound],
        step_sum=np.stack([kept[block].sum(axis=0) for block in blocks])[:, :, None],
        step_count=np.array([sound[block].sum() for block in blocks]),
    )


def errors(seed: int = 0, runs: int = RUNS) -> np.ndarray:
    """Squared errors (run, step) that grow with time and differ from run to run."""
    rng = np.random.default_rng(seed)
    return rng.gamma(2.0, 1.0, (runs, 1)) * rng.gamma(1.0, 1.0, (runs, STEPS)) * np.linspace(1.0, 2.0, STEPS)


def jackknife(groups: list[np.ndarray], value) -> float:
    """Standard error of a function of runs, leaving out one group of them at a time."""
    n = len(groups)
    without = [value(np.concatenate(groups[:k] + groups[k + 1 :])) for k in range(n)]
    return float(np.sqrt((n - 1) / n * np.sum((np.array(without) - np.mean(without)) ** 2)))


def test_the_pooled_root_is_over_all_runs_and_steps():
    squares = errors()
    value, se = pooled_over_runs(np.sqrt(squares[:, FIRST:].mean(axis=1)))
    assert value == pytest.approx(np.sqrt(squares[:, FIRST:].mean()), rel=1e-14)
    per_run = squares[:, FIRST:].mean(axis=1)
    assert se == pytest.approx(np.std(per_run, ddof=1) / np.sqrt(RUNS) / (2.0 * value), rel=1e-12)


def test_the_error_of_the_pooled_root_is_the_spread_of_repetitions():
    found = np.array([pooled_over_runs(np.sqrt(errors(k)[:, FIRST:].mean(axis=1))) for k in range(400)])
    assert found[:, 0].std() == pytest.approx(found[:, 1].mean(), rel=0.12)


def test_the_peak_is_the_largest_root_over_runs_at_any_step():
    """Steps that do not count are left out; its error is by the jackknife over blocks."""
    squares = errors()
    squares[:, 0] = 1e6  # before the first step that counts
    value, se = peak_over_steps(results_of(squares), 0, FIRST)
    groups = np.array_split(squares[:, FIRST:], BLOCKS)
    assert value == pytest.approx(np.sqrt(squares[:, FIRST:].mean(axis=0)).max(), rel=1e-14)
    assert se == pytest.approx(jackknife(groups, lambda runs: np.sqrt(runs.mean(axis=0)).max()), rel=1e-12)


def test_blocks_without_a_sound_run_do_not_count():
    squares, status = errors(), np.zeros(RUNS, int)
    status[: 2 * PER_BLOCK], status[-1] = int(Status.DIVERGED), int(Status.DIVERGED)
    squares[status != 0] = 1e9
    results = results_of(squares, status)
    assert list(results.step_count[:2]) == [0, 0]
    sound = squares[status == 0][:, FIRST:]
    value, se = peak_over_steps(results, 0, FIRST)
    assert value == pytest.approx(np.sqrt(sound.mean(axis=0)).max(), rel=1e-14)
    assert math.isfinite(se)
    one = results._replace(step_sum=results.step_sum[:3], step_count=results.step_count[:3])
    assert math.isnan(peak_over_steps(one, 0, FIRST)[1])  # a single block that holds something


@given(st.integers(1, 6), st.integers(1, 2000))
def test_the_band_holds_95_percent_of_means(dof, runs):
    low, high = band(dof, runs)
    assert chi2.cdf(low * runs, dof * runs) == pytest.approx(0.025, abs=1e-9)
    assert chi2.sf(high * runs, dof * runs) == pytest.approx(0.025, abs=1e-9)
    assert low < dof < high


def test_bands_of_the_textbook():
    """50 runs of 4 degrees of freedom, and one of 2: tables of chi-square."""
    assert band(4, 50) == pytest.approx((162.728 / 50, 241.058 / 50), abs=1e-4)
    assert band(2, 1) == pytest.approx((0.0506, 7.3778), abs=1e-4)


def test_the_share_of_steps_inside_the_band():
    rng = np.random.default_rng(2)
    squares, status = rng.chisquare(4, (RUNS, STEPS)), np.zeros(RUNS, int)
    squares[:, 5], squares[:, 7], squares[:, 1] = 20.0, 0.1, 4.0
    status[3] = int(Status.DIVERGED)
    low, high = chi2.ppf([0.025, 0.975], 4 * (RUNS - 1)) / (RUNS - 1)
    means = np.delete(squares, 3, axis=0)[:, FIRST:].mean(axis=0)
    expected = np.mean((means >= low) & (means <= high))
    assert share_in_band(results_of(squares, status), 0, FIRST, 4) == expected
    assert 0.0 < expected < 1.0
    many = rng.chisquare(2, (RUNS, 2000))
    assert share_in_band(results_of(many), 0, FIRST, 2) == pytest.approx(0.95, abs=0.015)
    assert share_in_band(results_of(many), 0, FIRST, 3) < 0.2


def summarised(rule: str, squares: np.ndarray, status=None, over_time: str = "rms") -> dict:
    results = results_of(squares, status, over_time)
    return summarise_metric({"over_runs": rule, "dof": 4}, results, 0, FIRST)


def plain(rule: str, squares: np.ndarray) -> float:
    """The rule of `emt.averaging` in words of NumPy, for root-mean-square metrics."""
    counted = squares[:, FIRST:]
    per_run = np.sqrt(counted.mean(axis=1))
    match rule:
        case "mean":
            return per_run.mean()
        case "std":
            return per_run.std(ddof=1)
        case "var":
            return per_run.var(ddof=1)
        case "max":
            return per_run.max()
        case "rms":
            return np.sqrt(counted.mean(axis=0)).mean()
        case "pooled":
            return np.sqrt(counted.mean())
        case "peak":
            return np.sqrt(counted.mean(axis=0)).max()
        case _:
            low, high = chi2.ppf([0.025, 0.975], 4 * len(squares)) / len(squares)
            means = counted.mean(axis=0)
            return np.mean((means >= low) & (means <= high))


@pytest.mark.parametrize("rule", get_args(OverRuns))
def test_every_rule_is_what_it_says(rule):
    """Over the runs without failure; other bits only inform."""
    squares, status = errors(4), np.zeros(RUNS, int)
    status[[2, 17]], status[5] = int(Status.DIVERGED), int(Status.GROSS_INNOVATION)
    squares[[2, 17]] = 1e6
    sound = squares[status != int(Status.DIVERGED)]
    found = summarised(rule, squares, status)
    assert found["value"] == pytest.approx(plain(rule, sound), rel=1e-12)
    assert found["runs_used"] == RUNS - 2
    assert found["median"] == pytest.approx(np.median(np.sqrt(sound[:, FIRST:].mean(axis=1))), rel=1e-12)
    if rule in ("max", "band"):
        assert found["se"] is None  # it has no error of this kind
    else:
        assert 0.0 < found["se"] < found["value"]


def test_the_error_of_a_sample_variance_is_the_spread_of_repetitions():
    """That of the standard deviation times twice the deviation, to first order."""
    found = [summarised("var", errors(k, 400)) for k in range(300)]
    values, errors_of = (np.array([f[key] for f in found]) for key in ("value", "se"))
    assert np.std(values) == pytest.approx(np.mean(errors_of), rel=0.15)
    squares = errors(3)
    values = np.sqrt(squares[:, FIRST:].mean(axis=1))
    expected = 2.0 * values.std(ddof=1) * standard_error_of_std(values)
    assert summarised("var", squares)["se"] == pytest.approx(expected, rel=1e-12)


def test_one_run_and_none_have_no_errors():
    one = summarised("pooled", errors(0, 1))
    assert one["value"] == pytest.approx(np.sqrt(errors(0, 1)[:, FIRST:].mean()))
    assert one["se"] is None
    assert summarised("var", errors(0, 1))["value"] is None
    assert summarised("max", errors(0, 1))["value"] is not None
    none = summarised("pooled", errors(), np.full(RUNS, int(Status.DIVERGED)))
    assert none == {"value": None, "se": None, "std": None, "median": None, "runs_used": 0}
    assert summarised("pooled", np.zeros((RUNS, STEPS)))["se"] is None


def test_the_pooled_rule_changes_root_mean_squares_over_runs_only():
    for name, metric in METRICS.items():
        pooled = under_rule(metric, "pooled")
        assert under_rule(metric, "per_step") is metric
        if metric.over_runs == "rms":
            assert pooled.over_runs == "pooled"
            assert pooled.definition.startswith("root over runs and steps of the mean squared ")
            assert pooled._replace(over_runs="rms", definition=metric.definition) == metric
            assert pooled.over_runs in OF_SINGLE_RUNS
        else:
            assert pooled is metric, name
    assert {name for name, metric in METRICS.items() if metric.over_runs == "rms"} >= {"position_rmse", "velocity_rmse"}
    assert METRICS["peak_position_rmse"].over_runs == "peak"


# metrics of points

KINEMATIC = Point(("x", "vx", "y", "vy"), 2, ("straight", "left", "right"))
INFO = Info(jnp.asarray(-3.0), jnp.asarray(2.0), jnp.asarray(0), None, jnp.asarray(0.4), jnp.asarray(5.0))


def estimate_of(modes=None, mean=(3.0, 1.0, 4.0, 1.0), cov=None) -> Estimate:
    probabilities = None if modes is None else {name: jnp.asarray(p) for name, p in modes.items()}
    cov = jnp.eye(len(mean)) if cov is None else jnp.asarray(cov)
    return Estimate(jnp.asarray(mean), cov, KINEMATIC if len(mean) == 4 else Point(("level",), 1), probabilities)


def truth_of(mode=0, state=(0.0, 4.0, 0.0, 5.0)) -> Truth:
    return Truth(jnp.asarray(state), KINEMATIC, jnp.asarray(mode))


def value_of(name: str, estimate: Estimate, truth: Truth) -> float:
    return float(METRICS[name].per_step(estimate, truth, INFO))


@pytest.mark.parametrize(
    ("modes", "mode", "expected"),
    [
        ({"straight": 0.7, "left": 0.2, "right": 0.1}, 0, "cid"),
        ({"right": 0.1, "straight": 0.7, "left": 0.2}, 0, "cid"),
        ({"straight": 0.7, "left": 0.2, "right": 0.1}, 1, "iid"),
        ({"straight": 0.4, "left": 0.35, "right": 0.25}, 0, "nid"),
        ({"straight": 0.5, "left": 0.5, "right": 0.0}, 0, "nid"),
        ({"straight": 0.9, "left": 0.1}, 2, "iid"),
        ({"straight": 0.45, "wide": 0.55}, 0, "iid"),
        ({"straight": 0.4, "wide": 0.3, "left": 0.3}, 2, "nid"),
    ],
    ids=str,
)
def test_modes_are_identified_correctly_incorrectly_or_not(modes, mode, expected):
    """By names, in any order; one of the three holds always. A filter may lack the true mode, or have others."""
    found = {name: value_of(name, estimate_of(modes), truth_of(mode)) for name in ("cid", "iid", "nid")}
    assert found == {name: float(name == expected) for name in found}


def test_metrics_belong_to_those_that_can_have_them():
    """Identification to filters with modes; others by what filters tell; none of an ellipse's to a point."""
    with_modes, without = estimate_of({"straight": 1.0}), estimate_of()
    for name in ("cid", "iid", "nid"):
        assert METRICS[name].needs_mode
        assert has(METRICS[name], with_modes, INFO)
        assert not has(METRICS[name], without, INFO)
    silent = INFO._replace(effective_samples=None, active_models=None)
    for name, told in (("effective_samples", 0.4), ("active_models", 5.0), ("most_active_models", 5.0)):
        assert has(METRICS[name], without, INFO)
        assert not has(METRICS[name], without, silent)
        assert value_of(name, without, truth_of()) == told
    level = estimate_of(mean=(1.0,))
    for name in ("position_rmse", "velocity_rmse", "peak_velocity_rmse", "gw", "iou"):
        assert not has(METRICS[name], level, INFO)
    assert has(METRICS["position_rmse"], without, INFO)
    assert find_metric("mode_straight_probability").applies_to(with_modes)


def test_errors_of_positions_and_velocities_go_by_the_names_of_the_state():
    """Here x, vx, y, vy; of a state without a position the error is that of all its entries."""
    estimate, truth = estimate_of(), truth_of()
    assert value_of("position_rmse", estimate, truth) == 25.0
    assert value_of("peak_position_rmse", estimate, truth) == 25.0
    assert value_of("velocity_rmse", estimate, truth) == 25.0
    assert value_of("run_mse", estimate_of(mean=(3.0, 1.0, 4.0, 2.0)), truth) == 25.0
    level = estimate_of(mean=(3.0,))
    assert value_of("run_rmse", level, Truth(jnp.asarray([1.0]), level.shape)) == 4.0
    units = {name: METRICS[name].unit_of for name in ("run_rmse", "run_rmse_variance", "run_mse")}
    assert [unit(level) for unit in units.values()] == ["1", "1", "1"]
    assert [unit(estimate) for unit in units.values()] == ["L", "L²", "L²"]


def test_squared_errors_are_normalised_by_the_whole_covariance():
    rng = np.random.default_rng(6)
    factor, error = rng.normal(size=(4, 4)), rng.normal(size=4)
    cov = factor @ factor.T + 0.1 * np.eye(4)
    truth = truth_of(state=tuple(rng.normal(size=4)))
    estimate = estimate_of(mean=np.asarray(truth.state) + error, cov=cov)
    for name in ("nees", "nees_in_band"):
        assert value_of(name, estimate, truth) == pytest.approx(error @ np.linalg.solve(cov, error), rel=1e-10)
        assert METRICS[name].dof(estimate) == 4
    assert value_of("nis_in_band", estimate, truth) == 2.0
    assert METRICS["nis_in_band"].dof(estimate) == 2
    assert METRICS["nis"].dof(estimate_of(mean=(1.0,))) == 1
    ellipse = Estimate(jnp.zeros(4), jnp.eye(4), Ellipse(jnp.ones(2), jnp.asarray(0.0)))
    assert METRICS["nees"].dof(ellipse) == 4

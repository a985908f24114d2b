"""Filters of other packages on emt's scans: those that are installed compute the same."""

import numpy as np
import pytest

from emt.benchmark.peers import ELLIPSE, PEERS, Peer, Scans, installed
from emt.benchmark.peers.agreement import error_difference, largest_difference, own_reports
from emt.benchmark.peers.given import scans_of
from emt.benchmark.peers.models import prior_means, settings_of
from emt.config.load import load_experiment
from emt.config.shipped import config_names
from emt.montecarlo.chunks import Engine
from emt.montecarlo.program import Program

EXACT = [peer for peer in PEERS if peer.exact]
STATISTICAL = [peer for peer in PEERS if not peer.exact]
ROUNDING = 1e-11


def name_of(peer: Peer) -> str:
    return f"{peer.package}-{peer.workload}"


def both(peer: Peer, runs: int, *overrides: str):
    """Reports of the other package and of emt for the same runs, with the arrays of these."""
    pytest.importorskip(peer.package, reason=f"{peer.package} is not installed")
    experiment = load_experiment(f"benchmark/{peer.workload}", [f"monte_carlo.chunk={runs}", *overrides]).experiment
    program, seed = Program.of(experiment), experiment.monte_carlo.seed
    engine = Engine(program, seed, runs, quick=True)
    engine.compile()
    arrays = engine.run_chunk(0, runs, tracked=runs)
    found = peer.prepare(experiment, scans_of(program, arrays, seed))()
    return found, own_reports(arrays, next(iter(experiment.filters)), peer.report), arrays


@pytest.mark.parametrize("peer", EXACT, ids=name_of)
def test_the_same_numbers(peer):
    steps = ["scenario.steps=40"] if peer.report == ELLIPSE else []
    found, own, _ = both(peer, 2, *steps)
    assert found.shape == own.shape
    assert found.shape[-1] == len(peer.report)
    assert largest_difference(found, own) < ROUNDING


@pytest.mark.parametrize("peer", [peer for peer in EXACT if peer.report == ELLIPSE], ids=name_of)
def test_the_same_numbers_from_few_points(peer):
    found, own, arrays = both(peer, 2, "scenario.steps=50", "scenario.detections.count.mean=2")
    assert {0, 1, 2} <= set(arrays["scans/mask"].sum(axis=-1).ravel())
    assert largest_difference(found, own) < ROUNDING


@pytest.mark.parametrize("peer", STATISTICAL, ids=name_of)
def test_the_same_statistics(peer):
    """Where the measurement leaves many particles their weight, the packages differ by much less than they err."""
    mild = [f"{part}.measurement.range_std=10" for part in ("scenario", "model")]
    found, own, arrays = both(peer, 16, "scenario.steps=30", *mild)
    truth = arrays["truth/state"]
    difference, standard_error = error_difference(found, own, truth)
    assert abs(difference) < 4.0 * standard_error
    assert np.abs(found - own).mean() < 0.5 * np.abs(own - truth).mean()


@pytest.mark.parametrize("peer", STATISTICAL, ids=name_of)
def test_draws_repeat_and_leave_the_global_generator_alone(peer):
    pytest.importorskip(peer.package, reason=f"{peer.package} is not installed")
    experiment = load_experiment(f"benchmark/{peer.workload}", ["filters.particle.particles=50"]).experiment
    points = np.tile(np.array([100.0, 3.0]), (2, 5, 1, 1))
    call = peer.prepare(experiment, Scans(points, np.ones((2, 5, 1), bool)))
    before = np.random.get_state(legacy=False)
    np.testing.assert_array_equal(call(), call())
    np.testing.assert_equal(np.random.get_state(legacy=False), before)


@pytest.mark.parametrize("peer", PEERS, ids=name_of)
def test_every_workload_is_shipped(peer):
    assert f"benchmark/{peer.workload}" in config_names()


def test_versions_of_what_is_installed():
    peer = PEERS[0]
    assert installed(peer._replace(package="numpy")) == np.__version__
    assert installed(peer._replace(package="no-such-package")) is None


def test_drawn_priors_have_to_be_given():
    experiment = load_experiment("benchmark/multiple_model").experiment
    scans = Scans(np.zeros((2, 1, 1, 2)), np.ones((2, 1, 1), bool))
    with pytest.raises(ValueError, match="prior_means"):
        prior_means(experiment, scans)
    means = np.arange(8.0).reshape(2, 4)
    np.testing.assert_array_equal(prior_means(experiment, scans._replace(prior_means=means)), means)


def test_a_filter_that_the_experiment_does_not_have():
    with pytest.raises(ValueError, match="no filter of kind 'vb_random_matrix'"):
        settings_of(load_experiment("benchmark/mem_ekf_star").experiment, "vb_random_matrix")


def test_empty_slots_are_left_out():
    points, mask = np.arange(12.0).reshape(1, 2, 3, 2), np.array([[[True, False, True], [False, False, False]]])
    first, second = Scans(points, mask).real()[0]
    np.testing.assert_array_equal(first, [[0.0, 1.0], [4.0, 5.0]])
    assert second.shape == (0, 2)


def test_difference_relative_to_each_column():
    expected = np.array([[[100.0, 1.0], [50.0, 0.0]]])
    assert largest_difference(expected + np.array([1.0, 0.02]), expected) == pytest.approx(0.02)
    assert np.isnan(largest_difference(expected * np.nan, expected))

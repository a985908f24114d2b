"""What every filter promises, checked over one list of filters."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import emt.filters.catalogue  # noqa: F401 - registers the filters
from emt.linalg import Mat2
from emt.registry import FILTERS
from emt.scans import prepared
from emt.settings import reads_points
from emt.status import FAILURE, Status
from emt.types import Ellipse, Measurements
from tests.filters.cases import (
    CASES,
    ELSEWHERE,
    FAST_COMPILE,
    MAIN,
    N_RUNS,
    Case,
    Problem,
    Report,
    assert_same,
    batch_tracker,
    differences,
    pick,
    problems,
    report,
    solved,
    track,
)

every = pytest.mark.parametrize("case", CASES, ids=str)
main = pytest.mark.parametrize("case", MAIN, ids=str)


def answer(case: Case, changed: Problem) -> Report:
    return report(batch_tracker(case)(changed)[0])


def test_every_registered_filter_has_a_row():
    assert {case.settings.kind for case in CASES} | ELSEWHERE == set(FILTERS.names())


@every
def test_agrees_with_its_oracle(case):
    """Whole sequences from the same prior, each side using its own previous result."""
    ours = report(solved(case)[0])
    for run in range(N_RUNS):
        theirs = case.oracle(case.settings, pick(problems(case), run))
        assert_same(case, Report(*(field[run] for field in ours)), theirs, case.tolerance)


@pytest.mark.parametrize("case", [case for case in CASES if not reads_points(case.settings)], ids=str)
def test_filters_of_statistics_need_no_points(case):
    def bare(problem: Problem) -> Problem:
        return problem._replace(scans=jax.vmap(without_points)(problem.scans))

    def without_points(scan: Measurements) -> Measurements:
        known = prepared(scan)
        return known._replace(points=known.points[:0], mask=known.mask[:0])

    assert_same(case, answer(case, jax.vmap(bare)(problems(case))), report(solved(case)[0]), 1e-12)


@pytest.mark.slow
@every
def test_agrees_with_its_oracle_as_compiled_in_experiments(case):
    """The other tests compile without optimisation, which is faster."""
    ours = report(jax.jit(jax.vmap(lambda problem: track(case, problem)))(problems(case))[0])
    assert_same(case, ours, report(solved(case)[0]), case.tolerance)


@every
def test_reports_no_failure_on_ordinary_data(case):
    status = np.asarray(solved(case)[1].status)
    assert not (status & int(FAILURE | Status.FLOOR_USED | Status.MEASUREMENT_SKIPPED)).any()


@every
def test_order_of_points_does_not_matter(case):
    """Up to rounding; MEM-EKF* takes the points one after the other, and its answer must move."""
    given = problems(case)
    order = np.random.default_rng(1).permutation(given.scans.mask.shape[-1])
    scans = Measurements(given.scans.points[:, :, order], given.scans.mask[:, :, order], given.scans.overflow)
    found = differences(case, answer(case, given._replace(scans=scans)), report(solved(case)[0]))
    if case.order_free:
        assert max(found.values()) < case.tolerance, found
    else:
        assert found["outline"] > 1e-6


@every
def test_content_of_padding_does_not_matter(case):
    """Bit by bit, whatever stands in the unused slots."""
    given = problems(case)
    rng = np.random.default_rng(2)
    garbage = rng.choice([np.nan, np.inf, -np.inf, 1e300, -7.0], given.scans.points.shape)
    points = jnp.where(given.scans.mask[..., None], given.scans.points, jnp.asarray(garbage))
    estimate, info = batch_tracker(case)(given._replace(scans=given.scans._replace(points=points)))
    for ours, theirs in zip(jax.tree.leaves((estimate, info)), jax.tree.leaves(solved(case)), strict=True):
        np.testing.assert_array_equal(ours, theirs)


@cache
def one_step(case: Case):
    """Jitted (problem without time axis) -> predicted state, updated state, their estimates, diagnostics."""

    def step(problem: Problem):
        flt, key = case.build(problem.params, problem.model), jax.random.key(0)
        predicted = flt.predict(flt.init(problem.prior, key), problem.dt, key)
        updated, info = flt.update(predicted, problem.scans, key)
        return predicted, updated, flt.estimate(predicted), flt.estimate(updated), info

    return jax.jit(step, compiler_options=FAST_COMPILE)


@main
@pytest.mark.parametrize("content", ["empty", "nothing finite", "far too large"])
def test_empty_scan_returns_the_prediction_exactly(case, content):
    """Bit by bit, the whole state; also if the door takes every point out, which it says."""
    given = pick(problems(case), 4)
    points = {
        "empty": given.scans.points[3],
        "nothing finite": jnp.full((9, 2), jnp.nan).at[:, 0].set(1.0),
        "far too large": jnp.full((9, 2), -1e300),
    }[content]
    mask = jnp.zeros(9, bool) if content == "empty" else jnp.arange(9) < 4
    scan = Measurements(points, mask, jnp.asarray(False))
    predicted, updated, before, after, info = one_step(case)(given._replace(scans=scan, dt=given.dt[0]))
    for ours, theirs in zip(
        jax.tree.leaves((updated.state, after)), jax.tree.leaves((predicted.state, before)), strict=True
    ):
        np.testing.assert_array_equal(ours, theirs)
    assert int(info.status) == (0 if content == "empty" else Status.MEASUREMENT_SKIPPED)
    assert float(info.nis) == 0.0
    assert float(info.log_likelihood) == 0.0


@main
def test_one_point_is_used(case):
    """The update moves towards a single point and shrinks the position covariance."""
    given = pick(problems(case), 6)
    scan = pick(given.scans, 0)
    assert int(scan.mask.sum()) == 1
    _, _, before, after, info = one_step(case)(given._replace(scans=scan, dt=given.dt[0]))
    assert not int(info.status) & int(FAILURE)
    assert np.trace(after.cov[:2, :2]) < np.trace(before.cov[:2, :2])
    assert np.abs(np.asarray(after.mean - before.mean)).max() > 1e-3


@every
def test_moving_the_origin_moves_the_answer(case):
    given, shift = problems(case), np.array([3000.0, -2000.0, 0.0, 0.0])
    scans = given.scans._replace(points=jnp.asarray(np.asarray(given.scans.points) + shift[:2]))
    prior = given.prior._replace(mean=jnp.asarray(np.asarray(given.prior.mean) + shift))
    moved = answer(case, given._replace(scans=scans, prior=prior))
    back = moved._replace(mean=moved.mean - shift)
    assert_same(case, back, report(solved(case)[0]), max(case.tolerance, 1e-8))


@every
def test_other_units_change_only_the_numbers(case):
    """Lengths and times in other units give the same answer in these units.

    Times only for `gp_ett`, as in its authors' code the jitter on the kernel matrix is 1e-6 in whatever unit.
    """
    length, time = 7.3 if case.any_length_unit else 1.0, 0.19
    given, model = problems(case), problems(case).model
    unit = np.array([length, length, length / time, length / time])
    prior = given.prior._replace(
        mean=jnp.asarray(unit * np.asarray(given.prior.mean)),
        cov=jnp.asarray(np.outer(unit, unit) * np.asarray(given.prior.cov)),
        ellipse=Ellipse(length * given.prior.ellipse.semi_axes, given.prior.ellipse.orientation),
    )
    noise = type(model.noise)(length**2 / time**3 * model.noise.psd)
    changed = Problem(
        jax.vmap(lambda params: case.in_units(params, length, time))(given.params),
        type(model)(noise, length**2 * model.sensor_noise, model.extent_scale),
        prior,
        given.scans._replace(points=length * given.scans.points),
        time * given.dt,
    )
    found = answer(case, changed)
    outline = length if case.source == "outline" else length**2
    back = Report(found.mean / unit, found.cov / np.outer(unit, unit), found.outline / outline, found.orientation)
    assert_same(case, back, report(solved(case)[0]), case.tolerance)


@every
def test_turning_the_world_turns_the_answer(case):
    """By any angle; VB starts from a matrix that is not turned, so by half a turn only (both checked)."""
    angles = [np.pi] if case.label == "vb_random_matrix" else [0.7, 2.5]
    for angle in angles:
        assert_same(case, turned_back(case, angle), in_world(case, report(solved(case)[0])), max(case.tolerance, 1e-8))
    if not case.turns:
        found = differences(case, turned_back(case, 0.7), in_world(case, report(solved(case)[0])))
        assert 1e-6 < max(found.values()) < 0.3, found


def in_world(case: Case, found: Report) -> Report:
    """Without the orientation where it is read in a limited range."""
    return found if case.unwrapped else found._replace(orientation=np.zeros_like(found.orientation))


def turned_back(case: Case, angle: float) -> Report:
    """The answer in a world turned by `angle`, turned back."""
    given = problems(case)
    turn = Mat2.rotation(jnp.asarray(angle))
    matrix = turn.array()
    both = jnp.kron(jnp.eye(2), matrix)
    prior = given.prior._replace(
        mean=given.prior.mean @ both.T,
        cov=both @ given.prior.cov @ both.T,
        ellipse=Ellipse(given.prior.ellipse.semi_axes, given.prior.ellipse.orientation + angle),
    )
    model = given.model
    noise = jax.vmap(turn.congruence)(model.sensor_noise)
    changed = given._replace(
        model=type(model)(model.noise, noise, model.extent_scale),
        prior=prior,
        scans=given.scans._replace(points=given.scans.points @ matrix.T),
    )
    found, both, matrix = answer(case, changed), np.asarray(both), np.asarray(matrix)
    outline = found.outline if case.source == "outline" else matrix.T @ found.outline @ matrix
    back = Report(found.mean @ both, both.T @ found.cov @ both, outline, found.orientation - angle)
    return in_world(case, back)

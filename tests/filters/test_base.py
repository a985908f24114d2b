"""The door, the guard and the diagnostics that all filters share."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.stats import multivariate_normal

from emt.filters.base import estimate_status, guarded, innovation_info
from emt.linalg import Sym2, Vec2
from emt.scans import as_scan, scan_statistics, screen
from emt.status import Status
from emt.types import Ellipse, Estimate, Filter, Info, Measurements, Prior, StarConvex

KEY = jax.random.key(0)
PRIOR = Prior(jnp.array([1.0, 2.0, 3.0, 4.0]), jnp.eye(4), Ellipse(jnp.array([2.0, 1.0]), jnp.asarray(0.3)))


def scan_of(points, mask=None, overflow=False) -> Measurements:
    points = jnp.asarray(points, float).reshape(-1, 2)
    mask = jnp.ones(len(points), bool) if mask is None else jnp.asarray(mask)
    return Measurements(points, mask, jnp.asarray(overflow))


def estimate_of(cov=None, shape=None, mean=None) -> Estimate:
    return Estimate(
        jnp.zeros(4) if mean is None else jnp.asarray(mean),
        jnp.eye(4) if cov is None else jnp.asarray(cov),
        Ellipse(jnp.array([2.0, 1.0]), jnp.asarray(0.0)) if shape is None else shape,
    )


def spoiling(updated=None, predicted=None, info=None) -> Filter:
    """A filter whose state is its estimate, and which does as it is told."""
    quiet = Info(jnp.asarray(0.0), jnp.asarray(0.0), jnp.asarray(0))
    return Filter(
        lambda prior, key: estimate_of(mean=prior.mean),
        lambda state, dt, key: state if predicted is None else predicted,
        lambda state, scan, key: (state if updated is None else updated, quiet if info is None else info),
        lambda state: state,
    )


def assert_equal(actual, expected):
    for ours, theirs in zip(jax.tree.leaves(actual), jax.tree.leaves(expected), strict=True):
        np.testing.assert_array_equal(ours, theirs)


UNSOUND = {
    "mean not a number": (estimate_of(mean=[np.nan, 0.0, 0.0, 0.0]), Status.NON_FINITE),
    "infinite variance": (estimate_of(cov=np.diag([np.inf, 1.0, 1.0, 1.0])), Status.NON_FINITE),
    "negative variance of position": (
        estimate_of(cov=np.diag([1.0, -1.0, 1.0, 1.0])),
        Status.NOT_POSITIVE_DEFINITE,
    ),
    "no variance of velocity": (estimate_of(cov=np.diag([1.0, 1.0, 0.0, 1.0])), Status.NOT_POSITIVE_DEFINITE),
    "semi-axis of zero": (
        estimate_of(shape=Ellipse(jnp.array([1.0, 0.0]), jnp.asarray(0.0))),
        Status.NOT_POSITIVE_DEFINITE,
    ),
    "negative semi-axis": (
        estimate_of(shape=Ellipse(jnp.array([-1.0, 1.0]), jnp.asarray(0.0))),
        Status.NOT_POSITIVE_DEFINITE,
    ),
    "infinite radius": (
        estimate_of(shape=StarConvex(jnp.array([1.0, jnp.inf]), jnp.asarray(0.0))),
        Status.NON_FINITE,
    ),
}


@pytest.mark.parametrize("name", UNSOUND)
def test_unsound_estimates_are_named(name):
    estimate, bit = UNSOUND[name]
    assert int(estimate_status(estimate)) == bit


def test_a_sound_estimate_has_no_bits():
    assert int(estimate_status(estimate_of())) == 0
    assert int(estimate_status(estimate_of(shape=StarConvex(jnp.array([1.0, -0.5]), jnp.asarray(0.0))))) == 0


@pytest.mark.bits
@pytest.mark.parametrize("name", [name for name in UNSOUND if name != "infinite radius"])
def test_guard_keeps_the_last_sound_state_after_an_update(name):
    estimate, bit = UNSOUND[name]
    flt = guarded(spoiling(updated=estimate))
    start = flt.init(PRIOR, KEY)
    state, info = flt.update(start, scan_of([[0.0, 0.0]]), KEY)
    assert_equal(state.state, start.state)
    assert int(info.status) == bit


@pytest.mark.bits
@pytest.mark.parametrize("name", [name for name in UNSOUND if name != "infinite radius"])
def test_guard_goes_back_before_an_unsound_prediction(name):
    """The update that follows says so, and the state is that after the last update."""
    estimate, bit = UNSOUND[name]
    flt = guarded(spoiling(predicted=estimate))
    start = flt.init(PRIOR, KEY)
    for scan in (scan_of([[0.0, 0.0]]), scan_of([[0.0, 0.0]], [False])):
        state, info = flt.update(flt.predict(start, jnp.asarray(1.0), KEY), scan, KEY)
        assert_equal(state.state, start.state)
        assert int(info.status) == bit
    _, info = flt.update(state, scan_of([[0.0, 0.0]]), KEY)
    assert int(info.status) == 0


def test_guard_looks_at_the_whole_state():
    """Also at numbers that are not reported."""
    inner = spoiling()
    hidden = Filter(
        lambda prior, key: (inner.init(prior, key), jnp.asarray(1.0)),
        lambda state, dt, key: state,
        lambda state, scan, key: ((state[0], jnp.asarray(jnp.nan)), inner.update(state[0], scan, key)[1]),
        lambda state: state[0],
    )
    flt = guarded(hidden)
    state, info = flt.update(flt.init(PRIOR, KEY), scan_of([[0.0, 0.0]]), KEY)
    assert float(state.state[1]) == 1.0
    assert int(info.status) == Status.NON_FINITE


@pytest.mark.bits
def test_guard_lets_a_sound_update_pass():
    new = estimate_of(mean=[5.0, 6.0, 7.0, 8.0])
    flt = guarded(spoiling(updated=new))
    state, info = flt.update(flt.init(PRIOR, KEY), scan_of([[0.0, 0.0]]), KEY)
    assert_equal(state.state, new)
    assert int(info.status) == 0


@pytest.mark.bits
@pytest.mark.parametrize("scan", [scan_of([[0.0, 0.0]], [False]), scan_of([[np.nan, 0.0]])], ids=["empty", "screened"])
def test_guard_ignores_updates_without_a_point(scan):
    flt = guarded(spoiling(updated=estimate_of(mean=[5.0, 6.0, 7.0, 8.0])))
    start = flt.init(PRIOR, KEY)
    assert_equal(flt.update(start, scan, KEY)[0].state, start.state)


@pytest.mark.bits
def test_company_changes_nothing_behind_the_guard():
    """Sound, unsound and blind runs in one batch, and batches in which all are sound: as each of them alone."""
    flt = guarded(
        Filter(
            lambda prior, key: estimate_of(mean=prior.mean),
            lambda state, dt, key: state._replace(mean=state.mean + dt),
            lambda state, scan, key: (
                state._replace(mean=scan.points[0, 0] * state.mean),
                Info(jnp.asarray(-1.0), jnp.asarray(2.0), jnp.asarray(0)),
            ),
            lambda state: state,
        )
    )

    def one(x, mask):
        scan = scan_of([[0.0, 0.0]])._replace(points=jnp.stack([x, x])[None], mask=mask[None])
        start = flt.predict(flt.init(PRIOR, KEY), jnp.asarray(1.0), KEY)
        return flt.update(start._replace(state=start.state._replace(cov=x * start.state.cov)), scan, KEY)

    x, mask = jnp.asarray([1.0, -1.0, 2.0, 3.0, 3.0]), jnp.asarray([True, True, False, True, True])
    for some in (slice(None), slice(3, None)):
        together = jax.vmap(one)(x[some], mask[some])
        for k, (mine, seen) in enumerate(zip(x[some], mask[some], strict=True)):
            assert_equal(jax.tree.map(lambda leaf, k=k: leaf[k], together), one(mine, seen))
    state, info = jax.vmap(one)(x, mask)
    assert info.status.tolist() == [0, int(Status.NOT_POSITIVE_DEFINITE), 0, 0, 0]
    np.testing.assert_array_equal(state.state.mean[:3], [PRIOR.mean + 1.0, PRIOR.mean, PRIOR.mean + 1.0])


@pytest.mark.parametrize(("log_likelihood", "nis"), [(-np.inf, 1.0), (0.0, np.inf), (np.nan, np.nan)])
def test_diagnostics_are_finite_or_flagged(log_likelihood, nis):
    bad = Info(jnp.asarray(log_likelihood), jnp.asarray(nis), jnp.asarray(int(Status.GROSS_INNOVATION)))
    flt = guarded(spoiling(info=bad))
    _, info = flt.update(flt.init(PRIOR, KEY), scan_of([[0.0, 0.0]]), KEY)
    assert np.isfinite([float(info.log_likelihood), float(info.nis)]).all()
    assert int(info.status) == Status.GROSS_INNOVATION | Status.FLOOR_USED


def test_overflow_of_a_scan_is_reported():
    flt = guarded(spoiling())
    _, info = flt.update(flt.init(PRIOR, KEY), scan_of([[0.0, 0.0]], overflow=True), KEY)
    assert int(info.status) == Status.SCAN_OVERFLOW


EXTREME = st.one_of(st.floats(-1e6, 1e6), st.floats(allow_nan=True, allow_infinity=True))


@given(arrays(np.float64, (5, 2), elements=EXTREME), arrays(bool, 5))
def test_screen_passes_exactly_the_sound_points(points, mask):
    """Everything behind the door is finite, with a finite fourth power; sound points pass unchanged."""
    scan = screen(scan_of(points, mask))
    passed = np.asarray(scan.mask)
    with np.errstate(over="ignore", invalid="ignore"):
        assert np.isfinite(np.asarray(scan.points) ** 4).all()
        bad = mask & ~np.isfinite(16.0 * points**4).all(axis=1)
    ordinary = mask & (np.abs(points) < 1e70).all(axis=1)
    assert not (passed & ~mask).any()
    assert not (passed & bad).any()
    assert (passed | ~ordinary).all()
    np.testing.assert_array_equal(np.asarray(scan.points)[passed], points[passed])
    assert (np.asarray(scan.points)[~passed] == 0.0).all()
    assert bool(scan.skipped) == bool((mask & ~passed).any())


@given(arrays(np.float64, (6, 2), elements=st.floats(-1e5, 1e5)), arrays(bool, 6))
def test_statistics_of_a_scan(points, mask):
    stats = scan_statistics(scan_of(np.where(mask[:, None], points, np.nan), mask))
    real = points[mask]
    assert float(stats.count) == len(real)
    mean = real.mean(axis=0) if len(real) else np.zeros(2)
    np.testing.assert_allclose(np.asarray(stats.mean.array()), mean, rtol=1e-12, atol=1e-9)
    expected = (real - mean).T @ (real - mean)
    np.testing.assert_allclose(np.asarray(stats.scatter.array()), expected, rtol=1e-9, atol=1e-6)


@pytest.mark.parametrize("n", [1, 2, 7])
def test_likelihood_and_nis_are_those_of_the_stacked_points(n):
    """Joint Gaussian of all points: common centre with covariance C, own spread Y each."""
    rng = np.random.default_rng(n)
    C, Y = np.array([[2.0, 0.5], [0.5, 1.0]]), np.array([[3.0, -1.0], [-1.0, 4.0]])
    centre, points = np.array([10.0, -5.0]), np.array([10.0, -5.0]) + 2.0 * rng.normal(size=(n, 2))
    scan = as_scan(jnp.asarray(points), capacity=9)
    scan = scan._replace(points=jnp.where(scan.mask[:, None], scan.points, jnp.nan))
    info = innovation_info(Vec2.of(jnp.asarray(centre)), Sym2.of(C), Sym2.of(Y), scan)
    joint = np.kron(np.ones((n, n)), C) + np.kron(np.eye(n), Y)
    expected = multivariate_normal(np.tile(centre, n), joint).logpdf(points.ravel())
    innovation = points.mean(axis=0) - centre
    assert float(info.log_likelihood) == pytest.approx(expected, rel=1e-12)
    assert float(info.nis) == pytest.approx(innovation @ np.linalg.inv(C + Y / n) @ innovation, rel=1e-12)
    assert int(info.status) == 0


@pytest.mark.parametrize(("distance", "gross"), [(10.19, False), (10.21, True), (1e70, True), (1e200, True)])
def test_gross_innovation_starts_at_ten_standard_deviations(distance, gross):
    """Squared distances may sum to 10² and 2 for each of two points; also where the distance overflows."""
    one, two = Sym2(1.0, 0.0, 1.0), Sym2(3.0, 0.0, 3.0)
    scan = scan_of([[0.0, 0.0], [2.0 * distance, 0.0], [1e9, 0.0]], [True, True, False])
    info = innovation_info(Vec2(jnp.asarray(0.0), jnp.asarray(0.0)), one, two, scan)
    assert bool(int(info.status) & Status.GROSS_INNOVATION) is gross


def test_gross_innovation_is_seen_where_the_distance_is_not_a_number():
    """Infinity minus infinity."""
    spread = Sym2(1.0, 0.9, 1.0)
    info = innovation_info(Vec2(jnp.asarray(0.0), jnp.asarray(0.0)), spread, spread, scan_of([[1e200, 1e200]]))
    assert int(info.status) == Status.GROSS_INNOVATION


def test_padding_of_a_scan():
    scan = as_scan(jnp.ones((3, 2)), capacity=5)
    assert scan.points.shape == (5, 2)
    assert np.asarray(scan.mask).tolist() == [True] * 3 + [False] * 2
    assert as_scan(jnp.zeros((0, 2))).mask.shape == (1,)
    with pytest.raises(ValueError, match="3 points do not fit a scan of capacity 2"):
        as_scan(jnp.ones((3, 2)), capacity=2)


def test_names_of_status_bits():
    """The values are stored in results, so they never change."""
    values = {
        "non-finite": 1,
        "not positive definite": 2,
        "diverged": 4,
        "measurement skipped": 8,
        "gross innovation": 16,
        "floor used": 32,
        "scan overflow": 64,
    }
    assert {name: sum(flag for flag in Status if Status.names_of(flag) == [name]) for name in values} == values
    assert Status.names_of(0) == []
    assert Status.names_of(3) == ["non-finite", "not positive definite"]

"""The floors inside the filters: where they act, what they keep, and that they say so."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from emt.filters import feldmann, gp_ett, mem_ekf_star, vb_random_matrix
from emt.filters.base import TrackingModel
from emt.filters.kinematics import Kinematics
from emt.linalg import Chol3, Sym2, Vec2
from emt.models.motion import WhiteAcceleration
from emt.scans import as_scan
from emt.status import FAILURE, Status
from emt.types import Ellipse, Prior
from tests.filters.cases import CASES, GP, MEM_COV, cast
from tests.reference import feldmann as reference

KEY, DT = jax.random.key(0), jnp.asarray(1.0)
NAMED = {case.label: case for case in CASES}


def model_of(noise: float = 0.04) -> TrackingModel:
    return cast(TrackingModel(WhiteAcceleration(0.1), Sym2(noise, 0.0, noise), 0.25), np.float64)


def prior_of(axes=(6.0, 2.5), mean=(0.0, 0.0, 1.0, 0.5)) -> Prior:
    return cast(Prior(np.array(mean), np.eye(4), Ellipse(np.array(axes), 0.3)), np.float64)


def mem_state(l1: float, l2: float) -> mem_ekf_star.MemState:
    belief = Kinematics.of(jnp.zeros(4), jnp.eye(4))
    chol = Chol3.of(jnp.asarray(MEM_COV))
    return mem_ekf_star.MemState(belief, jnp.asarray(0.3), Vec2(jnp.asarray(l1), jnp.asarray(l2)), chol)


@pytest.mark.parametrize(
    ("axes", "reported"),
    [
        ((3.0, 2.0), (3.0, 2.0)),
        ((-3.0, 2.0), (3.0, 2.0)),
        ((3.0, 0.0), (3.0, 3e-9)),
        ((-1e-30, -2.0), (2e-9, 2.0)),
    ],
)
def test_mem_reports_positive_axes(axes, reported):
    found = mem_ekf_star.estimate(mem_state(*axes)).shape.semi_axes
    np.testing.assert_allclose(np.asarray(found), reported, rtol=1e-15)


@pytest.mark.parametrize(("correlation", "crossed"), [(0.0, False), (0.9, True)], ids=["collapses", "crosses"])
def test_mem_says_that_an_axis_vanished(correlation, crossed):
    """Points at the centre under a wide prior shrink the axes to rounding level or past zero."""
    case = NAMED["mem_ekf_star"]
    wide = jnp.array([[0.1, 0.0, 0.0], [0.0, 100.0, 100.0 * correlation], [0.0, 100.0 * correlation, 100.0]])
    flt = case.build(mem_ekf_star.Params(wide, jnp.zeros((3, 3))), model_of(1e-4))
    update = jax.jit(flt.update)
    state, info = update(flt.init(prior_of((2.0, 1.0)), KEY), as_scan(jnp.zeros((9, 2))), KEY)
    smaller = min(float(state.state.semi_axes.x), float(state.state.semi_axes.y))
    assert (smaller < 0.0) is crossed
    assert smaller < 1e-9
    assert int(info.status) & Status.FLOOR_USED
    assert not int(info.status) & int(FAILURE)
    assert (np.asarray(flt.estimate(state).shape.semi_axes) > 0.0).all()
    _, ordinary = update(flt.init(prior_of((60.0, 60.0)), KEY), as_scan(30.0 * jnp.ones((9, 2))), KEY)
    assert not int(ordinary.status) & Status.FLOOR_USED


def test_mem_shape_covariance_keeps_its_factor():
    """Thousands of points without process noise drive the covariance to zero, never below."""
    case = NAMED["mem_ekf_star"]
    flt = case.build(mem_ekf_star.Params(jnp.asarray(MEM_COV), jnp.zeros((3, 3))), model_of())
    around = 2.0 * np.pi * np.arange(9) / 9
    scan = as_scan(jnp.asarray(np.stack([3.0 * np.cos(around), 1.2 * np.sin(around)], 1)))

    def step(state, _):
        state, info = flt.update(flt.predict(state, DT, KEY), scan, KEY)
        return state, (jnp.stack(jax.tree.leaves(state.state.shape_chol)), info.status)

    still = prior_of(mean=(0.0, 0.0, 0.0, 0.0))
    _, (chol, status) = jax.lax.scan(step, flt.init(still, KEY), length=2000)
    pivots = np.asarray(chol)[:, [0, 2, 5]]
    assert np.isfinite(np.asarray(chol)).all()
    assert (pivots > 0.0).all()
    assert not (np.asarray(status) & int(FAILURE)).any()


def test_mem_pivots_survive_rounding():
    """A needle without noise about a known centre: one point tells the angle to the last digit and beyond."""
    model = model_of(1e-24)
    belief = Kinematics.of(jnp.zeros(4), jnp.diag(jnp.array([1e-24, 1e-24, 1.0, 1.0])))
    chol = Chol3.of(jnp.diag(jnp.array([0.3, 1e-12, 1e-24])))

    def pivots(angle):
        axes = Vec2(jnp.asarray(1000.0), jnp.asarray(1e-9))
        turn = mem_ekf_star.rotation(angle)
        state = mem_ekf_star.Now(belief.position, belief.position_cov, angle, axes, chol, turn)
        point = Vec2(300.0 * jnp.cos(angle + 0.01), 300.0 * jnp.sin(angle + 0.01))
        found = mem_ekf_star.update_with_point(state, point, jnp.asarray(True), model)
        return jnp.stack(jax.tree.leaves(found.shape_chol)), found.orientation

    factors, orientation = jax.vmap(pivots)(jnp.linspace(0.0, 3.0, 64))
    assert np.isfinite(np.asarray(orientation)).all()
    assert np.isfinite(np.asarray(factors)).all()
    assert (np.asarray(factors)[:, [0, 2, 5]] > 0.0).all()


@pytest.mark.parametrize("rule", ["weight", "inverse_wishart"])
def test_feldmann_weight_stays_worth_one_point(rule):
    """Forgetting stops there, and the extent is kept."""
    extent = Sym2(jnp.asarray(4.0), jnp.asarray(1.0), jnp.asarray(3.0))
    state = feldmann.FeldmannState(Kinematics.of(jnp.zeros(4), jnp.eye(4)), extent, jnp.asarray(30.0))
    weight, X = 30.0, np.asarray(extent.array())
    for _ in range(12):
        state = feldmann.forget(state, rule, jnp.asarray(0.8), DT)
        if rule == "inverse_wishart":
            zero = np.zeros(4), np.eye(4)
            _, _, X, weight = reference.predict_inverse_wishart_decay(
                *zero, X, weight, np.eye(4), np.zeros((4, 4)), 0.8
            )
        else:
            weight = max(0.8 * weight, feldmann.MIN_WEIGHT)
        assert float(state.weight) == pytest.approx(weight, rel=1e-12)
        np.testing.assert_allclose(np.asarray(state.extent.array()), X, rtol=1e-12)
    for _ in range(50):
        state = feldmann.forget(state, rule, jnp.asarray(0.8), DT)
    assert float(state.weight) == feldmann.MIN_WEIGHT
    grown = np.asarray(state.extent.array())
    np.testing.assert_allclose(np.asarray(feldmann.forget(state, rule, jnp.asarray(0.1), DT).extent.array()), grown)


def test_feldmann_weight_decays_towards_two():
    state = feldmann.FeldmannState(
        Kinematics.of(jnp.zeros(4), jnp.eye(4)), Sym2(*map(jnp.asarray, (1.0, 0.0, 1.0))), jnp.asarray(30.0)
    )
    for _ in range(100):
        state = feldmann.forget(state, "time_constant", jnp.asarray(1.0), DT)
    assert float(state.weight) == pytest.approx(2.0, rel=1e-12)


def test_vb_shapes_stay_where_the_extent_exists():
    """The floor keeps the mean inverse extent, as forgetting does, and is reported with the next scan."""
    case = NAMED["vb_random_matrix"]
    params = vb_random_matrix.Params(
        (jnp.asarray(3.0), jnp.asarray(8.0)), jnp.asarray(0.1), jnp.asarray(0.01), jnp.asarray(0.5)
    )
    flt = case.build(params, model_of())
    state = flt.init(prior_of(), KEY)
    first = state.state
    seen = []
    for step in range(6):
        state = flt.predict(state, DT, KEY)
        now = state.state
        for shape, scale, start, start_scale in (
            (now.shape.x, now.scale.x, first.shape.x, first.scale.x),
            (now.shape.y, now.scale.y, first.shape.y, first.scale.y),
        ):
            assert float(shape) == max(float(start) * 0.5 ** (step + 1), vb_random_matrix.MIN_SHAPE)
            assert float(shape / scale) == pytest.approx(float(start / start_scale), rel=1e-12)
        axes = np.asarray(flt.estimate(state).shape.semi_axes)
        assert np.isfinite(axes).all()
        assert (axes > 0.0).all()
        state, info = flt.update(state, as_scan(jnp.zeros((0, 2)), 3), KEY)
        seen.append(int(info.status))
    # 3 x 0.5 is above the floor, 3 x 0.25 below
    assert seen == [0] + [int(Status.FLOOR_USED)] * 5


def gp_filter(noise: float):
    case = NAMED["gp_ett"]
    return case.build(case.params(GP), model_of(noise))


def test_gp_point_at_the_centre_and_padding_at_the_origin():
    """The direction of such a point is not defined; update and gradient stay finite."""
    flt = gp_filter(0.04)
    at_rest = prior_of(mean=(0.0, 0.0, 0.0, 0.0))
    full, padded = as_scan(jnp.array([[0.0, 0.0], [3.0, 1.0]])), as_scan(jnp.array([[3.0, 1.0]]), 2)

    def answer(mean, scan):
        state, info = flt.update(flt.init(at_rest._replace(mean=mean), KEY), scan, KEY)
        return flt.estimate(state).mean.sum(), info.status

    for scan in (full, padded):
        gradient, status = jax.jit(jax.jacfwd(answer, has_aux=True))(jnp.zeros(4), scan)
        assert int(status) == 0
        assert np.isfinite(np.asarray(gradient)).all()


@pytest.mark.parametrize(("noise", "floored"), [(0.04, False), (1e-30, True), (0.0, True)])
def test_gp_says_that_the_sensor_noise_is_below_rounding(noise, floored):
    flt = gp_filter(noise)
    around = 2.0 * np.pi * np.arange(9) / 9
    scan = as_scan(jnp.asarray(np.stack([6.0 * np.cos(around), 2.5 * np.sin(around)], 1)))
    _, info = jax.jit(flt.update)(flt.init(prior_of(), KEY), scan, KEY)
    assert bool(int(info.status) & Status.FLOOR_USED) is floored
    assert not int(info.status) & int(FAILURE)


def test_gp_floor_is_far_below_any_real_noise():
    """A hundred units of rounding of the predicted spread."""
    cov = np.diag([100.0, 100.0, 1.0])
    h = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, 0.0]])
    found = float(gp_ett.noise_floor(jnp.asarray(h), jnp.asarray(cov)))
    assert found == pytest.approx(100.0 * np.finfo(float).eps * 100.25, rel=1e-12)

"""The sampled posterior against its NumPy twin and against a case with a known answer."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from emt.filters import sampled_posterior as sampled
from emt.filters.base import TrackingModel, guarded
from emt.linalg import Sym2
from emt.models.motion import WhiteAcceleration
from emt.scans import as_scan, scan_statistics
from emt.types import Ellipse, Prior
from tests.filters.cases import FAST_COMPILE, cast
from tests.reference.sampled_posterior import sampled_posterior

N, REPEATS = 20_000, 6
SHAPE, VARIANCE, SCALE = (8.0, 6.0), 0.2, 0.25
NOISE = np.array([[0.5, 0.1], [0.1, 0.3]])
COV = np.array([[4.0, 0.5, 1.0, 0.0], [0.5, 3.0, 0.0, 0.8], [1.0, 0.0, 1.0, 0.1], [0.0, 0.8, 0.1, 1.0]])
AXES, ANGLE, MEAN = np.array([5.0, 2.0]), 0.3, np.array([10.0, -5.0, 1.0, 2.0])
POINTS = np.array([[11.0, -4.0], [13.5, -2.0], [9.0, -6.5], [14.0, -3.5], [12.0, -1.0]])


def tracking_model() -> TrackingModel:
    return cast(TrackingModel(WhiteAcceleration(1.0), Sym2.of(NOISE), SCALE), np.float64)


def build(shape=SHAPE, variance=VARIANCE, n=N):
    params = cast(sampled.Params(shape, variance), np.float64)
    return guarded(sampled.sampled_posterior(n, params, tracking_model()))


def prior() -> Prior:
    return cast(Prior(MEAN, COV, Ellipse(AXES, ANGLE)), np.float64)


@pytest.fixture(scope="module")
def ours():
    flt = build()

    def run(key):
        state = flt.init(prior(), key)
        state, info = flt.update(state, as_scan(jnp.asarray(POINTS), 8), key)
        return flt.estimate(state), state.state.matched, info

    return jax.jit(jax.vmap(run), compiler_options=FAST_COMPILE)(jax.random.split(jax.random.key(3), REPEATS))


def test_moments_agree_with_the_reference(ours):
    """Within five Monte Carlo errors of both sides, estimated from repetitions."""
    estimate, matched, info = ours
    a = np.array(SHAPE)
    theirs = [
        sampled_posterior(MEAN, COV, ANGLE, VARIANCE, a, (a - 1.0) * AXES**2, POINTS, NOISE, SCALE, N, seed)
        for seed in range(REPEATS)
    ]
    for found, expected in (
        (estimate.mean, [t.x for t in theirs]),
        (estimate.cov, [t.P for t in theirs]),
        (matched.orientation, [t.theta for t in theirs]),
    ):
        found, expected = np.asarray(found), np.array(expected)
        error = np.sqrt((found.var(axis=0) + expected.var(axis=0)) / REPEATS) + 1e-9
        if found.ndim == 1:
            # a linear mean there, a circular one here: equal up to the tails
            error = error + 2e-3
        assert (np.abs(found.mean(axis=0) - expected.mean(axis=0)) < 6.0 * error).all()
    assert (np.asarray(info.status) == 0).all()


def test_known_shape_leaves_the_kalman_filter():
    """Where the prior knows orientation and axes, up to 1e-4."""
    flt = build((1e10, 1e10), 1e-12, 1000)
    key = jax.random.key(1)
    update = jax.jit(flt.update, compiler_options=FAST_COMPILE)
    state, _ = update(flt.init(prior(), key), as_scan(jnp.asarray(POINTS), 5), key)
    estimate = flt.estimate(state)
    c, s = np.cos(ANGLE), np.sin(ANGLE)
    turn = np.array([[c, -s], [s, c]])
    spread = (SCALE * turn @ np.diag(AXES**2) @ turn.T + NOISE) / len(POINTS)
    H = np.hstack([np.eye(2), np.zeros((2, 2))])
    K = COV @ H.T @ np.linalg.inv(H @ COV @ H.T + spread)
    np.testing.assert_allclose(np.asarray(estimate.mean), MEAN + K @ (POINTS.mean(axis=0) - H @ MEAN), rtol=1e-4)
    np.testing.assert_allclose(np.asarray(estimate.cov), COV - K @ H @ COV, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(np.asarray(estimate.shape.semi_axes), AXES, rtol=1e-4)


def test_inverse_gamma_moments_survive_the_matching():
    """Samples that carry no information give back the prior's mean and mean inverse."""
    flt = build(n=100_000)
    key = jax.random.key(2)
    state = flt.init(prior(), key).state.matched
    scan = as_scan(jnp.zeros((0, 2)), 4)
    draw = jax.jit(sampled.draw, static_argnums=4, compiler_options=FAST_COMPILE)
    samples = draw(state, scan_statistics(scan), tracking_model(), key, 100_000)
    flat = samples._replace(log_weight=jnp.zeros_like(samples.log_weight))
    back = sampled.match(state, flat).matched
    np.testing.assert_allclose([float(back.shape.x), float(back.shape.y)], SHAPE, rtol=0.05)
    assert float(back.scale.x / back.shape.x) == pytest.approx(float(state.scale.x / state.shape.x), rel=0.01)
    assert float(back.orientation_var) == pytest.approx(VARIANCE, rel=0.02)
    assert float(sampled.effective_sample_size(flat)) == pytest.approx(100_000, rel=1e-9)


@pytest.mark.bits
def test_empty_scan_returns_the_prior_exactly():
    flt = build(n=1000)
    key = jax.random.key(0)
    start = flt.init(prior(), key)
    state, info = flt.update(start, as_scan(jnp.zeros((0, 2)), 4), key)
    for ours, theirs in zip(jax.tree.leaves(state.state), jax.tree.leaves(start.state), strict=True):
        np.testing.assert_array_equal(ours, theirs)
    assert int(info.status) == 0


@pytest.mark.parametrize(
    ("weights", "expected"), [((0.25, 0.25, 0.5), 2.0), ((0.1, 0.1, 0.8), 3.0), ((1.0, 0, 0), 1.0)]
)
def test_weighted_median(weights, expected):
    """The smallest value at which half of the weight is reached."""
    order = [2, 0, 1]
    values, weights = np.array([1.0, 2.0, 3.0])[order], np.array(weights, float)[order]
    assert float(sampled.weighted_median(jnp.asarray(values), jnp.asarray(weights))) == expected


def test_weighted_medians_of_many_are_those_of_sorted_values():
    """Exactly, also with a far value of no weight, which widens the interval that is halved, and around zero."""
    rng = np.random.default_rng(5)
    values, weights = rng.normal(size=(6, 501)) ** 3, rng.gamma(0.5, size=(6, 501))
    values[1, 7], weights[1, 7] = 1e25, 0.0
    values[2], weights[2, 4] = 5.0 + 1e-9 * values[2], 0.0
    values[3, :400] = 0.0
    order = np.argsort(values, axis=1)
    reached = np.take_along_axis(weights, order, 1).cumsum(axis=1) >= 0.5 * weights.sum(axis=1, keepdims=True)
    expected = np.take_along_axis(values, order, 1)[np.arange(6), reached.argmax(axis=1)]
    found = jax.jit(jax.vmap(sampled.weighted_median))(jnp.asarray(values), jnp.asarray(weights))
    np.testing.assert_array_equal(found, expected)

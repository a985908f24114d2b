"""Detections: numbers of points, their places on the object, noise, capacity."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import kstest, poisson

from emt.draws import normal_pairs, normals, unit_disc
from emt.keys import step_key
from emt.scenarios.detections import (
    OVERFLOW_PROBABILITY,
    DetectionSettings,
    capacity_for,
    params_of,
    poisson_cdf,
    poisson_count,
    sample_scans,
    usual_slots,
)
from emt.types import Ellipse, Truth
from tests.filters.cases import FAST_COMPILE

AXES, ANGLE, CENTRE = np.array([6.0, 2.0]), 0.7, np.array([100.0, -50.0])
TURN = np.array([[np.cos(ANGLE), -np.sin(ANGLE)], [np.sin(ANGLE), np.cos(ANGLE)]])
EXTENT = TURN @ np.diag(AXES**2) @ TURN.T
NOISE = ((1.5, 0.4), (0.4, 0.5))
STEPS = 400


def settings_of(count, source="uniform", noise=NOISE, max_points=None) -> DetectionSettings:
    return DetectionSettings(count=count, source=source, noise_cov=noise, max_points=max_points)


def truth() -> Truth:
    centre = jnp.broadcast_to(jnp.asarray(CENTRE), (STEPS, 2))
    ellipse = Ellipse(jnp.broadcast_to(jnp.asarray(AXES), (STEPS, 2)), jnp.full(STEPS, ANGLE))
    return Truth.moving(centre, jnp.zeros((STEPS, 2)), ellipse)


@cache
def scans_of(settings: DetectionSettings, capacity: int, seed: int = 0):
    params = jax.tree.map(jnp.asarray, params_of(settings))
    draw = jax.jit(
        lambda key, params: sample_scans(key, truth(), settings, params, capacity),
        compiler_options=FAST_COMPILE,
    )
    return jax.tree.map(np.asarray, draw(jax.random.key(seed), params))


@pytest.mark.parametrize(("source", "scale"), [("uniform", 0.25), ("gaussian", 1.0)])
def test_moments_of_the_points(source, scale):
    """Mean and covariance of 20,000 points within five standard errors."""
    scans = scans_of(settings_of({"kind": "fixed", "count": 50}, source), 50)
    assert scans.mask.all()
    points = scans.points.reshape(-1, 2)
    cov = scale * EXTENT + np.array(NOISE)
    std = np.sqrt(np.diag(cov))
    assert (np.abs(points.mean(axis=0) - CENTRE) < 5.0 * std / np.sqrt(len(points))).all()
    error = np.abs(np.cov(points.T) - cov) / np.outer(std, std)
    assert error.max() < 5.0 * np.sqrt(2.0 / len(points))


def test_uniform_points_fill_the_ellipse_evenly():
    """Without noise: none outside, half of them in the inner half of the area, no preferred direction."""
    settings = settings_of({"kind": "fixed", "count": 50}, noise=((0.0, 0.0), (0.0, 0.0)))
    body = ((scans_of(settings, 50).points.reshape(-1, 2) - CENTRE) @ TURN) / AXES
    squared = (body**2).sum(axis=1)
    assert squared.max() <= 1.0 + 1e-9
    n = len(squared)
    for area in (0.1, 0.5, 0.9):
        assert abs((squared < area).mean() - area) < 5.0 * np.sqrt(area * (1.0 - area) / n)
    sectors = np.bincount(
        ((np.arctan2(body[:, 1], body[:, 0]) + np.pi) / (2.0 * np.pi) * 8).astype(int) % 8, minlength=8
    )
    assert np.abs(sectors - n / 8).max() < 5.0 * np.sqrt(n / 8)


def test_unit_disc_is_inside_the_circle():
    points = unit_disc(jax.random.key(1), 1000, jnp.float64)
    assert np.hypot(points.x, points.y).max() <= 1.0


def test_normals_are_normal_and_independent():
    """Kolmogorov and Smirnov's test of both coordinates, and of the squared distance, which is chi-square."""
    draw = jax.jit(lambda key: normal_pairs(key, 100_000, jnp.float64))(jax.random.key(2))
    x, y = np.asarray(draw.x), np.asarray(draw.y)
    many = np.asarray(normals(jax.random.key(3), (99, 333), jnp.float64))
    for values in (x, y, (x + y) / np.sqrt(2.0), many.ravel()):
        assert kstest(values, "norm").pvalue > 1e-4
    assert kstest(x**2 + y**2, "chi2", args=(2,)).pvalue > 1e-4
    assert abs(np.corrcoef(x**2, y**2)[0, 1]) < 5.0 / np.sqrt(len(x))


@pytest.mark.parametrize("noise", [((0.0, 0.0), (0.0, 4.0)), ((4.0, 2.0), (2.0, 1.0)), ((0.0, 0.0), (0.0, 0.0))])
def test_singular_noise_has_a_factor(noise):
    factor = params_of(settings_of({"kind": "fixed", "count": 1}, noise=noise)).noise_chol
    matrix = np.array([[factor.xx, factor.xy], [factor.yx, factor.yy]])
    np.testing.assert_allclose(matrix @ matrix.T, np.array(noise), atol=1e-15)


@pytest.mark.parametrize("mean", [0.5, 1.0, 10.0, 20.0, 200.0])
def test_poisson_numbers(mean):
    """Frequencies of 20,000 numbers within five standard errors of the probabilities."""
    capacity = capacity_for(settings_of({"kind": "poisson", "mean": mean}), 1, 1)
    n = 20_000
    keys = jax.random.split(jax.random.key(3), n)
    draw = jax.jit(jax.vmap(lambda key: poisson_count(key, poisson_cdf(jnp.asarray(mean), capacity))))
    counts, overflow = map(np.asarray, draw(keys))
    assert not overflow.any()
    values = np.arange(capacity + 1)
    expected = poisson.pmf(values, mean)
    error = np.abs(np.bincount(counts, minlength=capacity + 1) / n - expected)
    assert (error <= 5.0 * np.sqrt(expected * (1.0 - expected) / n) + 1e-4).all()
    assert abs(counts.mean() - mean) < 5.0 * np.sqrt(mean / n)
    assert abs(counts.var() - mean) < 5.0 * mean * np.sqrt((2.0 + 1.0 / mean) / n)


@pytest.mark.parametrize("mean", [0.5, 10.0, 200.0])
def test_poisson_inversion_is_the_quantile(mean):
    """The same uniform number through SciPy's inverse distribution function."""
    capacity = capacity_for(settings_of({"kind": "poisson", "mean": mean}), 1, 1)
    keys = jax.random.split(jax.random.key(5), 500)
    uniform = np.asarray(jax.vmap(lambda key: jax.random.uniform(key, dtype=jnp.float64))(keys))
    counts = np.asarray(jax.vmap(lambda key: poisson_count(key, poisson_cdf(jnp.asarray(mean), capacity))[0])(keys))
    np.testing.assert_array_equal(counts, poisson.ppf(uniform, mean))


@pytest.mark.bits
@pytest.mark.parametrize("source", ["uniform", "gaussian"])
def test_more_capacity_changes_no_detection(source):
    """Bit by bit."""
    settings = settings_of({"kind": "poisson", "mean": 5.0}, source)
    narrow, wide = scans_of(settings, 30), scans_of(settings, 64)
    np.testing.assert_array_equal(wide.mask[:, :30], narrow.mask)
    assert not wide.mask[:, 30:].any()
    np.testing.assert_array_equal(wide.points[:, :30][narrow.mask], narrow.points[narrow.mask])


@pytest.mark.bits
def test_longer_tracks_extend_shorter_ones():
    """The same numbers of points at the same places, up to the last digit of programs of different length."""
    settings = settings_of({"kind": "poisson", "mean": 5.0})
    params = jax.tree.map(jnp.asarray, params_of(settings))
    start = jax.tree.map(lambda leaf: leaf[:20], truth())
    short = jax.jit(lambda key: sample_scans(key, start, settings, params, 30), compiler_options=FAST_COMPILE)(
        jax.random.key(0)
    )
    long = scans_of(settings, 30)
    np.testing.assert_allclose(np.asarray(short.points), long.points[:20], rtol=1e-14)
    np.testing.assert_array_equal(np.asarray(short.mask), long.mask[:20])


@pytest.mark.parametrize("mean", [0.1, 0.5, 10.0, 200.0, 10_000.0])
@pytest.mark.parametrize(("n_steps", "runs"), [(1, 1), (103, 1000), (10_000, 10_000_000)])
def test_capacity_bounds_the_probability_of_an_overflow(mean, n_steps, runs):
    """Over all scans of the experiment below 1e-9, with as few slots as that and multiples of eight allow."""
    capacity = capacity_for(settings_of({"kind": "poisson", "mean": mean}), n_steps, runs)
    scans = n_steps * max(runs, 1_000_000)
    assert scans * poisson.sf(capacity, mean) < OVERFLOW_PROBABILITY
    assert capacity % 8 == 0
    assert scans * poisson.sf(capacity - 8, mean) >= OVERFLOW_PROBABILITY


def test_capacity_of_other_counts():
    assert capacity_for(settings_of({"kind": "fixed", "count": 7}), 10, 10) == 7
    assert capacity_for(settings_of({"kind": "fixed", "count": 0}), 10, 10) == 1
    assert capacity_for(settings_of({"kind": "poisson", "mean": 9.0}, max_points=4), 10, 10) == 4
    assert capacity_for(settings_of({"kind": "poisson", "mean": 0.1, "minimum": 50}), 10, 10) == 56


def test_overflow_is_counted():
    """A scan that had more points than slots keeps as many as fit, and says so."""
    settings = settings_of({"kind": "poisson", "mean": 5.0}, max_points=4)
    small, large = scans_of(settings, 4), scans_of(settings_of({"kind": "poisson", "mean": 5.0}), 40)
    counts = large.mask.sum(axis=1)
    np.testing.assert_array_equal(small.overflow, counts > 4)
    np.testing.assert_array_equal(small.mask.sum(axis=1), np.minimum(counts, 4))
    assert 0 < small.overflow.sum() < STEPS
    assert scans_of(settings_of({"kind": "fixed", "count": 9}), 4).overflow.all()
    assert not scans_of(settings_of({"kind": "fixed", "count": 4}), 4).overflow.any()


def test_smallest_number_of_points():
    raised = scans_of(settings_of({"kind": "poisson", "mean": 1.0, "minimum": 1}), 30).mask.sum(axis=1)
    free = scans_of(settings_of({"kind": "poisson", "mean": 1.0}), 30).mask.sum(axis=1)
    np.testing.assert_array_equal(raised, np.maximum(free, 1))
    assert (free == 0).any()


@pytest.mark.bits
def test_a_full_scan_changes_no_scan_in_its_company():
    """Slots beyond the usual are drawn for a whole batch where one run needs them: nobody else notices a bit of it."""
    settings = settings_of({"kind": "poisson", "mean": 10})
    capacity, usual, n = capacity_for(settings, 1, 1), usual_slots(settings, 48), 16
    assert (capacity, usual) == (48, 24)
    params = jax.tree.map(jnp.asarray, params_of(settings))
    one = jax.tree.map(lambda leaf: leaf[:1], truth())
    keys = jax.random.split(jax.random.key(5), 40_000)
    cdf = poisson_cdf(jnp.asarray(10.0), capacity)
    counts = jax.vmap(lambda key: poisson_count(jax.random.fold_in(step_key(key, 0), 0), cdf)[0])(keys)
    full, few = jnp.flatnonzero(counts > usual), jnp.flatnonzero(counts <= usual)
    assert len(full)
    draw = jax.jit(jax.vmap(lambda key: sample_scans(key, one, settings, params, capacity)))
    alone, mixed = draw(keys[few[:n]]), draw(keys[jnp.append(few[: n - 1], full[0])])
    jax.tree.map(lambda a, b: np.testing.assert_array_equal(a[: n - 1], b[: n - 1]), alone, mixed)
    assert mixed.mask[-1, 0].sum() == counts[full[0]] > usual
    spread = np.asarray(mixed.points[-1, 0])[np.asarray(mixed.mask[-1, 0])] - CENTRE
    assert len(np.unique(spread)) == 2 * len(spread)
    assert (np.abs(spread) > 1e-3).all()
    assert (np.abs(spread) < 20.0).all()

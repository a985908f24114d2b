"""Association of points with the components of a connected object."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from emt.conformance.sampling_kinds import ARM
from emt.filters.association import component_updates, direct, distances, only, weighted
from emt.filters.sampling_update import conditioned, sampled_moments
from emt.linalg import Vec2, cholesky
from emt.sampling.rules import lcd_set
from emt.shapes.linkage import place, segment_residual

ORIGIN = Vec2(jnp.asarray(0.0), jnp.asarray(0.0))
EVEN = jnp.full(5, -jnp.log(5.0))
MOVE = jnp.asarray(np.eye(8) + np.eye(8, k=1) * np.array([0, 1, 0, 0, 1, 0, 1, 0])[:, None])
"""Constant velocity of the angles in a step of one."""


def at(x, y):
    return Vec2(jnp.asarray(x), jnp.asarray(y))


@pytest.fixture(scope="module")
def belief():
    rng = np.random.default_rng(3)
    factor = rng.normal(size=(8, 8)) * 0.05
    mean = jnp.array([0.9, 1.5, 0.01, 0.8, 1.4, -0.01, 1.2, 0.0])
    return mean, jnp.asarray(factor @ factor.T + 1e-3 * np.eye(8))


@pytest.mark.parametrize("point", [(0.1, 0.05), (0.1, 0.9), (0.9, 1.0), (2.0, 2.0)])
def test_each_segment_is_updated_as_if_alone(belief, point):
    mean, cov = belief
    samples, noise = jnp.asarray(lcd_set(9, 18)), jnp.asarray(0.01)
    parts = component_updates(mean, cov, at(*point), noise, samples, ARM)
    for component, link in ARM.segments:

        def h(x, w, link=link):
            segment = place(ARM.links, x, ORIGIN)[link]
            return segment_residual(segment, 0.5 + w[0] / jnp.sqrt(12.0), at(*point)).array()

        moments = sampled_moments(mean, cholesky(cov), samples, noise * jnp.eye(2), h)
        alone = conditioned(mean, cov, moments)
        np.testing.assert_allclose(parts.mean[component], alone.mean, rtol=1e-10)
        np.testing.assert_allclose(parts.cov[component], alone.cov, rtol=1e-9, atol=1e-14)
        assert float(parts.log_density[component]) == pytest.approx(float(alone.log_density), rel=1e-10)
        expected = moments.mean @ np.linalg.solve(moments.cov, moments.mean)
        assert float(parts.distance[component]) == pytest.approx(float(expected), rel=1e-8)
    np.testing.assert_array_equal(parts.mean[0], mean)  # the disc reads nothing
    np.testing.assert_array_equal(parts.cov[0], cov)


def test_what_association_makes_of_the_components(belief):
    parts = component_updates(*belief, at(0.1, 0.9), jnp.asarray(0.01), jnp.asarray(lcd_set(9, 18)), ARM)
    weights, mean, cov = weighted(parts, EVEN)
    assert float(weights.sum()) == pytest.approx(1.0)
    best = int(np.argmax(parts.log_density))
    for rule in (direct(parts, EVEN), only(parts, jnp.asarray(best))):
        np.testing.assert_array_equal(rule[0], np.eye(5)[best])
        np.testing.assert_array_equal(rule[1], parts.mean[best])
        np.testing.assert_array_equal(rule[2], parts.cov[best])
    certain = jnp.where(jnp.arange(5) == 2, 0.0, -jnp.inf)
    np.testing.assert_allclose(weighted(parts, certain)[1], parts.mean[2], rtol=1e-12)
    np.testing.assert_array_equal(direct(parts, certain)[1], parts.mean[2])
    assert np.linalg.eigvalsh(cov)[0] > 0.0
    np.testing.assert_allclose(mean, weights @ parts.mean, rtol=1e-12)


def test_distances():
    right = np.pi / 2
    segments = place(ARM.links, jnp.array([1.0, right, 0.0, 1.0, right, 0.0, right, 0.0]), ORIGIN)
    found = distances(segments, ARM, at(0.5, 0.5))
    np.testing.assert_allclose(found[:3], [np.sqrt(0.5) - 0.3, 0.5, 0.5], atol=1e-12)
    assert float(distances(segments, ARM, at(0.1, 0.1))[0]) == 0.0
    np.testing.assert_allclose(distances(segments, ARM, at(0.0, -2.0))[1], 2.0, atol=1e-12)
    np.testing.assert_allclose(distances(segments, ARM, at(1.0, 1.0))[3:], 0.0, atol=1e-12)


def true_state(k):
    angle, rate = 0.5 * np.pi + jnp.sin(1e-3 * k), 1e-3 * jnp.cos(1e-3 * k)
    return jnp.stack([jnp.ones_like(angle), angle, rate, jnp.ones_like(angle), angle, rate, angle, rate])


def tracked(key, sigma2, q, start_variance, samples, n_steps=12_600):
    """Absolute errors of the lengths, the first two angles and, folded, the third, at every step of one run."""

    def step(carry, k):
        mean, cov = carry
        true, keys = true_state(k + 1.0), jax.random.split(jax.random.fold_in(key, k.astype(int)), 3)
        u, phase = jax.random.uniform(keys[1], (2,))
        disc = 0.3 * jnp.sqrt(u) * jnp.stack([jnp.cos(2 * jnp.pi * phase), jnp.sin(2 * jnp.pi * phase)])
        sources = jnp.stack([disc, *(s.at(u).array() for s in place(ARM.links, true, ORIGIN))])
        noise = jnp.sqrt(sigma2) * jax.random.normal(keys[2], (2,))
        y = sources[jax.random.randint(keys[0], (), 0, 5)] + noise
        mean, cov = MOVE @ mean, MOVE @ cov @ MOVE.T + q * jnp.eye(8)
        _, mean, cov = weighted(component_updates(mean, cov, Vec2.of(y), sigma2, samples, ARM), EVEN)
        gap = jnp.mod(mean[jnp.array([1, 4])] - true[1] + jnp.pi, 2 * jnp.pi) - jnp.pi
        folded = jnp.abs(jnp.mod(mean[6] + 2 * jnp.pi, 4 * jnp.pi) - 2 * jnp.pi) - true[6]
        errors = jnp.concatenate([mean[jnp.array([0, 3])] - 1.0, gap, folded[None]])
        return (mean, cov), jnp.abs(errors)

    start = jnp.array([0.5, np.pi / 2, 0.0, 0.5, np.pi / 2, 0.0, np.pi / 2, 0.0])
    return jax.lax.scan(step, (start, start_variance * jnp.eye(8)), jnp.arange(float(n_steps)))[1]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ((1e-2, 1e-5, 1e-3), (0.0312, 0.0356, 0.0763, 0.0846, 0.240)),
        ((1e-3, 1e-6, 1e-4), (0.0078, 0.0121, 0.0237, 0.0258, 0.0684)),
    ],
    ids=["A", "B"],
)
def test_agrees_with_an_independent_implementation(settings, expected):
    """Medians over runs of the mean over k > 1000, against 100 runs of the same settings; weighted association."""
    keys = jax.random.split(jax.random.key(11), 60)
    run = jax.jit(jax.vmap(tracked, in_axes=(0, None, None, None, None)))
    errors = np.asarray(run(keys, *map(jnp.asarray, settings), jnp.asarray(lcd_set(9, 32))))[:, 1000:].mean(axis=1)
    tolerance = (0.1, 0.1, 0.04, 0.04, 0.05) if settings[0] == 1e-2 else (0.2, 0.2, 0.05, 0.05, 0.06)
    np.testing.assert_array_less(np.abs(np.median(errors, axis=0) / expected - 1.0), tolerance)

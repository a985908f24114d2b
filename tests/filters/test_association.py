"""Association of points with the components of a connected object."""

import jax.numpy as jnp
import numpy as np
import pytest

from emt.conformance.sampling_kinds import ARM
from emt.filters.association import Samples, direct, evidence, only, updated, weighted
from emt.filters.sampling_update import conditioned, mixed, sampled_moments
from emt.linalg import Sym2, Vec2, cholesky
from emt.sampling.rules import lcd_set
from emt.shapes.articulated import distances
from emt.shapes.linkage import place, segment_residual

ORIGIN = Vec2(jnp.asarray(0.0), jnp.asarray(0.0))
EVEN = jnp.full(5, -jnp.log(5.0))


def even(points):
    return Samples(jnp.asarray(points), jnp.full(len(points), 1.0 / len(points)))


def isotropic(variance):
    return Sym2(variance, jnp.zeros_like(variance), variance)


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
    found = evidence(mean, cov, at(*point), isotropic(noise), even(samples), ARM)
    for component, link in ARM.segments:

        def h(x, w, link=link):
            segment = place(ARM.links, x, ORIGIN)[link]
            return segment_residual(segment.length, 0.5 + w[0] / jnp.sqrt(12.0), segment.local(at(*point))).array()

        moments = sampled_moments(mean, cholesky(cov), samples, noise * jnp.eye(2), h)
        alone = conditioned(mean, cov, moments)
        new_mean, new_cov = updated(mean, cov, found, only(found, jnp.asarray(component)))
        np.testing.assert_allclose(new_mean, alone.mean, rtol=1e-10)
        np.testing.assert_allclose(new_cov, alone.cov, rtol=1e-9, atol=1e-14)
        assert float(found.log_density[component]) == pytest.approx(float(alone.log_density), rel=1e-10)
        expected = moments.mean @ np.linalg.solve(moments.cov, moments.mean)
        assert float(found.distance[component]) == pytest.approx(float(expected), rel=1e-8)
    new_mean, new_cov = updated(mean, cov, found, only(found, jnp.asarray(0)))
    np.testing.assert_array_equal(new_mean, mean)  # the disc reads nothing
    np.testing.assert_array_equal(new_cov, cov)


def test_what_association_makes_of_the_components(belief):
    found = evidence(*belief, at(0.1, 0.9), isotropic(jnp.asarray(0.01)), even(lcd_set(9, 18)), ARM)
    weights = weighted(found, EVEN)
    mean, cov = updated(*belief, found, weights)
    assert float(weights.sum()) == pytest.approx(1.0)
    best = int(np.argmax(found.log_density))
    for rule in (direct(found, EVEN), only(found, jnp.asarray(best))):
        np.testing.assert_array_equal(rule, np.eye(5)[best])
    certain = jnp.where(jnp.arange(5) == 2, 0.0, -jnp.inf)
    np.testing.assert_array_equal(weighted(found, certain), np.eye(5)[2])
    np.testing.assert_array_equal(direct(found, certain), np.eye(5)[2])
    single = [updated(*belief, found, only(found, jnp.asarray(k))) for k in range(5)]
    means, covs = (np.stack(column) for column in zip(*single, strict=True))
    _, expected_mean, expected_cov = mixed(jnp.log(weights), jnp.asarray(means), jnp.asarray(covs))
    np.testing.assert_allclose(mean, expected_mean, rtol=1e-12)
    np.testing.assert_allclose(cov, expected_cov, rtol=1e-10, atol=1e-15)
    assert np.linalg.eigvalsh(cov)[0] > 0.0


def test_distances():
    right = np.pi / 2
    state = jnp.array([1.0, right, 0.0, 1.0, right, 0.0, right, 0.0])
    found = distances(ARM, state, at(0.5, 0.5))
    np.testing.assert_allclose(found[:3], [np.sqrt(0.5) - 0.3, 0.5, 0.5], atol=1e-12)
    assert float(distances(ARM, state, at(0.1, 0.1))[0]) == 0.0
    np.testing.assert_allclose(distances(ARM, state, at(0.0, -2.0))[1], 2.0, atol=1e-12)
    np.testing.assert_allclose(distances(ARM, state, at(1.0, 1.0))[3:], 0.0, atol=1e-12)

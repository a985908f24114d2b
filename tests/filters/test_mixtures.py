"""Mixtures of modes: the chain's prediction, Bayes' rule and moments, against plain NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from emt.filters.bayes import posterior
from emt.filters.gaussian import Belief, fused, mixed
from tests.filters.point_cases import QUICK, assert_close
from tests.reference import multiple_model

mix, bayes = jax.jit(mixed, compiler_options=QUICK), jax.jit(posterior, compiler_options=QUICK)
N, ONE = 5, jnp.asarray(1.0)
MEANS = np.random.default_rng(8).normal(size=(N, 3))
COVS = np.stack([(1.0 + k) * np.eye(3) + 0.3 for k in range(N)])
SHARE = st.sampled_from([0.0, 0.0, 1e-250, 1e-12, 0.3, 1.0]) | st.floats(1e-250, 1.0)
SHARES = st.lists(SHARE, min_size=N, max_size=N).filter(lambda shares: sum(shares) > 1e-6)
LOGS = st.lists(st.floats(-1e4, 1e4), min_size=N, max_size=N)


def of_sum_one(shares) -> np.ndarray:
    return np.array(shares) / np.sum(shares)


@given(SHARES, st.lists(SHARES, min_size=N, max_size=N))
def test_the_chain_mixes_what_it_leads_to(probability, rows):
    """As mixed one by one with the weights of Bayes' rule; a mode that cannot be in effect keeps its own state."""
    p, pi = of_sum_one(probability), np.array([of_sum_one(row) for row in rows])
    predicted, beliefs = mix(jnp.asarray(pi), jnp.asarray(p), Belief(jnp.asarray(MEANS), jnp.asarray(COVS)), ONE)
    np.testing.assert_allclose(predicted, p @ pi, rtol=1e-12, atol=1e-300)
    assert float(predicted.sum()) == pytest.approx(1.0, abs=1e-12)
    for j, total in enumerate(p @ pi):
        if total > 1e-270:
            mean, cov = multiple_model.merged(p * pi[:, j] / total, MEANS, COVS)
            assert_close(beliefs.mean[j], mean, 1e-11)
            assert_close(beliefs.cov[j], cov, 1e-11)
        elif total < 1e-280:
            np.testing.assert_array_equal(beliefs.mean[j], MEANS[j])
            np.testing.assert_array_equal(beliefs.cov[j], COVS[j])


@given(SHARES, LOGS, st.floats(-1e5, 1e5))
def test_bayes_rule_depends_on_ratios_of_likelihoods_only(predicted, logs, shift):
    """It sums to 1, gives nothing to what was impossible, and stays finite whatever the gaps."""
    p, logs = jnp.asarray(of_sum_one(predicted)), jnp.asarray(logs)
    found, total = bayes(p, logs)
    assert np.isfinite(np.asarray(found)).all()
    assert np.isfinite(float(total))
    assert float(found.sum()) == pytest.approx(1.0, abs=1e-12)
    assert (np.asarray(found)[np.asarray(p) == 0.0] == 0.0).all()
    shifted, more = bayes(p, logs + shift)
    np.testing.assert_allclose(shifted, found, rtol=0, atol=1e-9)
    assert float(more) == pytest.approx(float(total) + shift, abs=1e-9)
    with np.errstate(divide="ignore"):
        joint = np.log(np.asarray(p)) + np.asarray(logs)
    expected = multiple_model.log_sum_exp(joint)
    np.testing.assert_allclose(found, np.exp(joint - expected), rtol=1e-9, atol=1e-60)
    assert float(total) == pytest.approx(expected, rel=1e-12, abs=1e-9)


@given(SHARES, LOGS, st.lists(st.booleans(), min_size=N, max_size=N))
def test_bayes_rule_within_a_set(predicted, logs, active):
    """As with the predicted probabilities of the others set to zero; nothing happens where nothing is possible."""
    p, mask = of_sum_one(predicted), np.array(active)
    found, total = bayes(jnp.asarray(p), jnp.asarray(logs), jnp.asarray(mask))
    inside = np.where(mask, p, 0.0)
    if inside.sum() == 0.0:
        np.testing.assert_array_equal(found, p)
        return
    expected, expected_total = bayes(jnp.asarray(inside), jnp.asarray(logs))
    np.testing.assert_allclose(found, expected, atol=1e-12)
    assert float(total) == pytest.approx(float(expected_total), rel=1e-12)


def test_a_likelihood_of_zero_everywhere_but_one_leaves_that_one():
    found, total = bayes(jnp.asarray([0.5, 0.5, 0.0]), jnp.asarray([-jnp.inf, -2e4, 3.0]))
    np.testing.assert_array_equal(found, [0.0, 1.0, 0.0])
    assert float(total) == pytest.approx(-2e4 + np.log(0.5))


@pytest.mark.parametrize("origin", [0.0, 1e6])
def test_moments_of_mixtures_far_from_the_origin(origin):
    """Relative error of the covariances 1e-9, symmetric to the last bit."""
    rng = np.random.default_rng(4)
    means = origin + 10.0 * rng.normal(size=(6, 4))
    factors = rng.normal(size=(6, 4, 4))
    covs = factors @ factors.transpose(0, 2, 1)
    transition, probability = rng.dirichlet(np.full(6, 0.5), size=6), rng.dirichlet(np.full(6, 0.5))
    beliefs = Belief(jnp.asarray(means), jnp.asarray(covs))
    predicted, found = jax.jit(mixed)(jnp.asarray(transition), jnp.asarray(probability), beliefs, ONE)
    weights = probability[:, None] * transition / (probability @ transition)
    for j in range(6):
        mean, cov = multiple_model.merged(weights[:, j], means, covs)
        np.testing.assert_allclose(found.mean[j], mean, rtol=1e-14)
        assert_close(found.cov[j], cov, 1e-9)
        one = fused(jnp.asarray(weights[:, j]), beliefs)
        np.testing.assert_allclose(one.mean, mean, rtol=1e-14)
        assert_close(one.cov, cov, 1e-9)
    np.testing.assert_allclose(predicted, probability @ transition, rtol=1e-14)
    np.testing.assert_array_equal(found.cov, np.asarray(found.cov).transpose(0, 2, 1))


@pytest.mark.parametrize("own_chains", [False, True])
def test_all_runs_are_mixed_at_once(own_chains):
    """Whether they share the matrix of the chain or have one each; the same as mode by mode."""
    rng, runs = np.random.default_rng(6), 7
    transition = rng.dirichlet(np.ones(N), size=(runs, N) if own_chains else N)
    transition[..., 3] = 0.0  # a mode that cannot be in effect
    transition = jnp.asarray(transition / transition.sum(axis=-1, keepdims=True))
    probability = jnp.asarray(rng.dirichlet(np.ones(N), size=runs))
    beliefs = Belief(
        jnp.asarray(MEANS + rng.normal(size=(runs, N, 3))), jnp.asarray(COVS * rng.gamma(2.0, size=(runs, 1, 1, 1)))
    )
    axes = (0 if own_chains else None, 0, 0, None)
    found = jax.jit(jax.vmap(mixed, in_axes=axes))(transition, probability, beliefs, ONE)
    for run in range(runs):
        chain = transition[run] if own_chains else transition
        own, p = jax.tree.map(lambda leaf, k=run: np.asarray(leaf[k]), (beliefs, probability))
        np.testing.assert_allclose(found[0][run], p @ chain, rtol=1e-12)
        for j, total in enumerate(p @ chain):
            expected = own.mean[j], own.cov[j]
            if total > 0.0:
                expected = multiple_model.merged(p * np.asarray(chain)[:, j] / total, own.mean, own.cov)
            assert_close(found[1].mean[run, j], expected[0], 1e-11)
            assert_close(found[1].cov[run, j], expected[1], 1e-11)

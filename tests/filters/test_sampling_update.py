"""The sampling update against the Kalman filter, which it equals for linear pseudo-measurements."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import multivariate_normal

from emt.filters.sampling_update import conditioned, mixed, sampled_moments
from emt.sampling.lcd import standardised
from emt.sampling.rules import standard_points


@pytest.mark.parametrize("m", [1, 2])
def test_linear_measurements_give_the_kalman_filter(m):
    rng = np.random.default_rng(m)
    samples = standardised(rng.normal(size=(12, 5)))
    samples = np.vstack([samples, -samples])
    H, G, c = rng.normal(size=(m, 4)), rng.normal(size=(m, 1)), rng.normal(size=m)
    factor, mean, R = rng.normal(size=(4, 4)), rng.normal(size=4), 0.3 * np.eye(m)
    cov = factor @ factor.T + np.eye(4)
    h = sampled_moments(
        jnp.asarray(mean),
        jnp.linalg.cholesky(cov),
        jnp.asarray(samples),
        jnp.asarray(R),
        lambda x, w: H @ x + G @ w + c,
    )
    new = conditioned(jnp.asarray(mean), jnp.asarray(cov), h)
    S = H @ cov @ H.T + G @ G.T + R
    K = cov @ H.T @ np.linalg.inv(S)
    np.testing.assert_allclose(new.mean, mean - K @ (H @ mean + c), rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(new.cov, cov - K @ S @ K.T, rtol=1e-10, atol=1e-12)
    assert float(new.log_density) == pytest.approx(multivariate_normal(H @ mean + c, S).logpdf(np.zeros(m)), rel=1e-10)


def test_every_rule_is_exact_for_linear_functions():
    H = jnp.array([[1.0, -2.0, 0.5]])
    for count in (6, 7, 20):
        points = jnp.asarray(standard_points("lcd", 3, count).points)
        h = sampled_moments(jnp.zeros(3), jnp.eye(3), points, jnp.zeros((1, 1)), lambda x, w: H @ x)
        assert float(h.cov[0, 0]) == pytest.approx(5.25, rel=1e-9)


def test_mixing_matches_the_first_two_moments():
    rng = np.random.default_rng(5)
    logs, means = np.log([0.2, 0.5, 0.3]) - 700.0, rng.normal(size=(3, 4))
    covs = np.stack([np.diag(rng.uniform(0.5, 2.0, 4)) for _ in range(3)])
    weights, mean, cov = mixed(jnp.asarray(logs), jnp.asarray(means), jnp.asarray(covs))
    np.testing.assert_allclose(weights, [0.2, 0.5, 0.3], rtol=1e-12)
    np.testing.assert_allclose(mean, np.array([0.2, 0.5, 0.3]) @ means, rtol=1e-12)
    second = sum(w * (P + np.outer(x, x)) for w, P, x in zip([0.2, 0.5, 0.3], covs, means, strict=True))
    np.testing.assert_allclose(cov + np.outer(mean, mean), second, rtol=1e-12, atol=1e-12)

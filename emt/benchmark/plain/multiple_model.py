"""Interacting multiple models of a point, from the equations: one `jax.vmap` over the models.

H. A. P. Blom and Y. Bar-Shalom, IEEE Trans. Autom. Control 33 (1988) 780-783; Y. Bar-Shalom, X. R. Li and
T. Kirubarajan, Estimation with Applications to Tracking and Navigation (2001), section 11.6.
"""

import jax
import jax.numpy as jnp
from jax.scipy.stats import multivariate_normal
from jaxtyping import Array, Float

from emt.benchmark.peers.base import Scans
from emt.benchmark.peers.models import Bank, prior_means
from emt.benchmark.plain.base import Prepared, check_start, over_runs
from emt.config.experiment import Experiment

Moments = tuple[Float[Array, "n"], Float[Array, "n n"]]


def merged(weights: Float[Array, "r"], x: Float[Array, "r n"], P: Float[Array, "r n n"]) -> Moments:
    """Mean and covariance of a mixture, with the spread of the means."""
    mean = weights @ x
    gaps = x - mean[None, :]
    spread = jax.vmap(jnp.outer)(gaps, gaps)
    return mean, (weights[:, None, None] * (P + spread)).sum(axis=0)


def filtered(x, P, F, b, Q, z, H, R) -> tuple[Float[Array, "n"], Float[Array, "n n"], Float[Array, ""]]:
    """Kalman prediction and update with one model x ← F x + b + v, and the log-likelihood of z."""
    x, P = F @ x + b, F @ P @ F.T + Q
    S = H @ P @ H.T + R
    K = P @ H.T @ jnp.linalg.inv(S)
    return x + K @ (z - H @ x), P - K @ S @ K.T, jnp.asarray(multivariate_normal.logpdf(z, H @ x, S))


def prepare(experiment: Experiment, scans: Scans) -> Prepared:
    """The filter on scans of some runs.

    Raises:
        ValueError: some scan has no measurement.
    """
    check_start(experiment)
    bank, means = Bank.of(experiment), prior_means(experiment, scans)
    if not scans.mask.all():
        raise ValueError("the plain form needs a measurement in every scan")
    F, b, Q = (jnp.array(parts) for parts in zip(*bank.motions, strict=True))
    H, R, chain = jnp.array(bank.observed), jnp.array(bank.noise_cov), jnp.array(bank.chain)
    r = len(bank.motions)

    def step(now, z: Float[Array, "m"]):
        x, P, mu = now
        predicted = mu @ chain
        # [j, i]: of model j before, given i now; a model that cannot be in effect keeps its own state
        reached = predicted > 0.0
        weights = mu[:, None] * chain / jnp.where(reached, predicted, 1.0)[None, :]
        weights = jnp.where(reached[None, :], weights, jnp.eye(r))
        x, P = jax.vmap(merged, in_axes=(1, None, None))(weights, x, P)
        x, P, gains = jax.vmap(filtered, in_axes=(0, 0, 0, 0, 0, None, None, None))(x, P, F, b, Q, z, H, R)
        mu = jax.nn.softmax(jnp.log(predicted) + gains)
        return (x, P, mu), merged(mu, x, P)[0]

    def track(mean: Float[Array, "n"], points: Float[Array, "step 1 m"]) -> Float[Array, "step n"]:
        start = jnp.tile(mean, (r, 1)), jnp.tile(jnp.array(bank.prior_cov), (r, 1, 1)), jnp.array(bank.start)
        return jax.lax.scan(step, start, points[:, 0])[1]

    return over_runs(track, means, scans.points)

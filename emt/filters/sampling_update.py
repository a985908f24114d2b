"""Update by a pseudo-measurement whose moments are taken over fixed samples of state and noise.

Source: J. Steinbring and U. D. Hanebeck 2013 (S2KF); A. Zea, F. Faion and U. D. Hanebeck 2014 for h = 0.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from emt.logarithm import log
from emt.types import Scalar


class Moments(NamedTuple):
    """A pseudo-measurement h under a belief."""

    mean: Float[Array, "m"]
    cov: Float[Array, "m m"]
    """Additive noise included."""
    cross: Float[Array, "n m"]
    """Covariance of the state with h."""


class Updated(NamedTuple):
    """A belief after the pseudo-measurement was found to be zero."""

    mean: Float[Array, "n"]
    cov: Float[Array, "n n"]
    log_density: Scalar
    """log N(0; mean, cov) of h before the update."""
    distance: Scalar
    """Squared Mahalanobis distance of h from zero."""


def sampled_moments(
    mean: Float[Array, "n"],
    root: Float[Array, "n n"],
    samples: Float[Array, "count d"],
    additive: Float[Array, "m m"],
    h: Callable[[Float[Array, "n"], Float[Array, "k"]], Float[Array, "m"]],
) -> Moments:
    """Moments of h(state, noise) over equally weighted standard normal samples of state and noise, d = n + k.

    Args:
        root: a square root of the covariance; another root turns the samples and gives another answer.
        additive: covariance of noise that adds to h.
    """
    n, share = mean.shape[0], 1.0 / samples.shape[0]
    steps = (root[None, :, :] * samples[:, None, :n]).sum(axis=-1)
    values = jax.vmap(h)(mean[None, :] + steps, samples[:, n:])
    center = share * values.sum(axis=0)
    gaps = values - center[None, :]
    cov = share * (gaps[:, :, None] * gaps[:, None, :]).sum(axis=0) + additive
    return Moments(center, cov, share * (steps[:, :, None] * gaps[:, None, :]).sum(axis=0))


def inverse_and_log_det(cov: Float[Array, "m m"]) -> tuple[Float[Array, "m m"], Scalar]:
    """Inverse and log determinant of a covariance of one or two components, in closed form."""
    if cov.shape[0] == 1:
        return 1.0 / cov, log(cov[0, 0])
    det = cov[0, 0] * cov[1, 1] - cov[0, 1] * cov[1, 0]
    adjugate = jnp.stack([jnp.stack([cov[1, 1], -cov[0, 1]]), jnp.stack([-cov[1, 0], cov[0, 0]])])
    return adjugate / det, log(det)


def conditioned(mean: Float[Array, "n"], cov: Float[Array, "n n"], h: Moments) -> Updated:
    """The belief given h = 0 (x - K ĥ, P - K C_h Kᵀ), symmetric by construction."""
    inverse, log_det = inverse_and_log_det(h.cov)
    gain = (h.cross[:, :, None] * inverse[None, :, :]).sum(axis=1)
    moved = mean - (gain * h.mean[None, :]).sum(axis=1)
    taken = (gain[:, None, :, None] * h.cov[None, None, :, :] * gain[None, :, None, :]).sum(axis=(-1, -2))
    distance = (h.mean[:, None] * inverse * h.mean[None, :]).sum()
    log_density = -0.5 * (distance + log_det + h.mean.shape[0] * jnp.log(2.0 * jnp.pi))
    return Updated(moved, cov - taken, log_density, distance)


def mixed(log_weights: Float[Array, "c"], means: Float[Array, "c n"], covs: Float[Array, "c n n"]):
    """Weights of sum 1, mean and covariance of a mixture, from unnormalised log weights."""
    weights = jax.nn.softmax(log_weights)
    mean = (weights[:, None] * means).sum(axis=0)
    gaps = means - mean[None, :]
    cov = (weights[:, None, None] * (covs + gaps[:, :, None] * gaps[:, None, :])).sum(axis=0)
    return weights, mean, cov

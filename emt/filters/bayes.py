"""Probabilities of modes given a measurement, by Bayes' rule without a logarithm of 0."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from emt.logarithm import log
from emt.types import Scalar


def posterior(
    predicted: Float[Array, "*modes"],
    log_likelihood: Float[Array, "*modes"],
    active: Bool[Array, "*modes"] | bool = True,
) -> tuple[Float[Array, "*modes"], Scalar]:
    """Probability of each mode given the measurement, among the active ones, and the log-likelihood of the mixture.

    Likelihoods are taken relative to the largest of a possible mode, so that they cannot all underflow. Where no active
    mode is possible, the predicted probabilities stay.
    """
    possible = (predicted > 0.0) & active
    largest = jnp.where(possible, log_likelihood, -jnp.inf).max()
    largest = jnp.where(jnp.isfinite(largest), largest, 0.0)
    relative = jnp.exp(jnp.where(possible, log_likelihood - largest, 0.0))
    joint = jnp.where(possible, predicted * relative, 0.0)
    total = joint.sum()
    sound = total > 0.0
    log_total = largest + log(jnp.where(sound, total, 1.0))
    return jnp.where(sound, joint / jnp.where(sound, total, 1.0), predicted), log_total

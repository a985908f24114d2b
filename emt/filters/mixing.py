"""Probabilities of modes: the chain's prediction, Bayes' rule, and weights of mixtures, without a logarithm of 0."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from emt.logarithm import log
from emt.types import Scalar


def mixing(
    probability: Float[Array, "n_from"], transition: Float[Array, "n_from n_to"]
) -> tuple[Float[Array, "n_to"], Float[Array, "n_from n_to"]]:
    """Predicted probability of each mode, and the probability of each mode before, given the mode after.

    A mode that cannot be in effect has probability 0 and keeps its own state.

    Source: Blom and Bar-Shalom 1988; Azimian 2005, table 4.1, whose denominator should be the predicted probability.
    """
    joint = probability[:, None] * transition
    predicted = joint.sum(axis=0)
    possible = (predicted > 0.0)[None, :]
    weights = joint / jnp.where(possible, predicted[None, :], 1.0)
    return predicted, jnp.where(possible, weights, jnp.eye(len(predicted), dtype=joint.dtype))


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

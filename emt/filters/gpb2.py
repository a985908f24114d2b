"""Generalised pseudo-Bayes of second order over any filters that can merge their states."""

from typing import NamedTuple

import jax.numpy as jnp
from jax.scipy.special import logsumexp
from jaxtyping import Array, Float

from emt.filters.imm import Params, merge_of, pooled
from emt.types import Estimate, Filter, Info, Measurements, Scalar, State


class Gpb2State(NamedTuple):
    """A state and a probability for every pair of modes: the one before the last prediction, and the one since."""

    log_probability: Float[Array, "n_modes n_modes"]
    """From (row), to (column)."""
    pairs: tuple[tuple[State, ...], ...]
    """In the order [to][from]."""


def gpb2(names: tuple[str, ...], modes: tuple[Filter, ...], params: Params) -> Filter:
    """GPB2: every mode goes on from the state of every mode; histories that end in the same mode are merged.

    Where IMM mixes the states first and runs n updates, this runs n² and mixes afterwards.

    Source: Bar-Shalom, Li and Kirubarajan 2001, section 11.6.5.
    """
    n, log_transition = len(modes), jnp.log(params.transition)

    def weights_of(log_probability: Float[Array, "n_from"]) -> Float[Array, "n_from"]:
        """Normalised; even where every history is impossible."""
        total = logsumexp(log_probability)
        return jnp.where(jnp.isfinite(total), jnp.exp(log_probability - total), 1.0 / n)

    def init(prior, key) -> Gpb2State:
        alone = jnp.where(jnp.eye(n, dtype=bool), jnp.log(params.start)[:, None], -jnp.inf)
        return Gpb2State(alone, tuple((mode.init(prior, key),) * n for mode in modes))

    def predict(state: Gpb2State, dt: Scalar, key) -> Gpb2State:
        merged = [
            merge_of(mode)(weights_of(state.log_probability[:, j]), state.pairs[j]) for j, mode in enumerate(modes)
        ]
        joint = logsumexp(state.log_probability, axis=0)[:, None] + log_transition
        return Gpb2State(joint, tuple(tuple(mode.predict(old, dt, key) for old in merged) for mode in modes))

    def update(state: Gpb2State, scan: Measurements, key) -> tuple[Gpb2State, Info]:
        results = [[m.update(s, scan, key) for s in row] for m, row in zip(modes, state.pairs, strict=True)]
        log_likelihood = jnp.stack([jnp.stack([info.log_likelihood for _, info in row]) for row in results], axis=1)
        joint = state.log_probability + log_likelihood
        total = logsumexp(joint)
        posterior = joint - total
        infos = [row[i][1] for i in range(n) for row in results]  # in the order of the joint probabilities
        pairs = tuple(tuple(new for new, _ in row) for row in results)
        return Gpb2State(posterior, pairs), pooled(total, jnp.exp(posterior).ravel(), infos)

    def estimate(state: Gpb2State) -> Estimate:
        merge, probability = merge_of(modes[0]), jnp.exp(logsumexp(state.log_probability, axis=0))
        pairs = tuple(s for row in state.pairs for s in row)
        merged = modes[0].estimate(merge(jnp.exp(state.log_probability).T.ravel(), pairs))
        return merged._replace(modes={name: probability[k] for k, name in enumerate(names)})

    return Filter(init, predict, update, estimate)

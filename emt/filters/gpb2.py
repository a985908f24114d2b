"""Generalised pseudo-Bayes of second order over any filters that can merge their states."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.scipy.special import logsumexp
from jaxtyping import Array, Float

from emt.filters.imm import Params, merge_of, pooled
from emt.types import Estimate, Filter, Info, Measurements, Scalar, State


class Gpb2State(NamedTuple):
    """A state and a probability for every pair of modes: the one before the last prediction, and the one since."""

    log_probability: Float[Array, "n_modes n_modes"]
    """From (row), to (column)."""
    histories: tuple[State, ...]
    """Of every mode, its states from each mode before, with a leading axis."""


def stacked(states: Sequence[State]) -> State:
    """States of one kind as one, with a leading axis."""
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *states)


def unstacked(states: State, n: int) -> tuple[State, ...]:
    """The states along a leading axis."""
    return tuple(jax.tree.map(lambda leaf, k=k: leaf[k], states) for k in range(n))


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
        return Gpb2State(alone, tuple(stacked([mode.init(prior, key)] * n) for mode in modes))

    def predict(state: Gpb2State, dt: Scalar, key) -> Gpb2State:
        weights = [weights_of(state.log_probability[:, j]) for j in range(n)]
        merged = stacked(
            [
                merge_of(mode)(weights[j], unstacked(history, n))
                for j, (mode, history) in enumerate(zip(modes, state.histories, strict=True))
            ]
        )
        joint = logsumexp(state.log_probability, axis=0)[:, None] + log_transition
        return Gpb2State(joint, tuple(jax.vmap(mode.predict, (0, None, None))(merged, dt, key) for mode in modes))

    def update(state: Gpb2State, scan: Measurements, key) -> tuple[Gpb2State, Info]:
        results = [
            jax.vmap(mode.update, (0, None, None))(history, scan, key)
            for mode, history in zip(modes, state.histories, strict=True)
        ]
        joint = state.log_probability + jnp.stack([info.log_likelihood for _, info in results], axis=1)
        total = logsumexp(joint)
        posterior = joint - total
        infos = [info for _, every in results for info in unstacked(every, n)]
        new = Gpb2State(posterior, tuple(new for new, _ in results))
        return new, pooled(total, jnp.exp(posterior).T.ravel(), infos)

    def estimate(state: Gpb2State) -> Estimate:
        merge, probability = merge_of(modes[0]), jnp.exp(logsumexp(state.log_probability, axis=0))
        every = tuple(one for history in state.histories for one in unstacked(history, n))
        merged = modes[0].estimate(merge(jnp.exp(state.log_probability).T.ravel(), every))
        return merged._replace(modes={name: probability[k] for k, name in enumerate(names)})

    return Filter(init, predict, update, estimate)

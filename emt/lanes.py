"""Runs on the last axis: small matrices become a few long vectors instead of many short ones."""

from collections.abc import Callable
from functools import wraps
from typing import Any, TypeVar, cast

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

Mapped = TypeVar("Mapped", bound=Callable[..., Any])
PerRun = Float[Array, "*lanes"]
"""A number of a run: of shape () where a step of one run is written down, of many runs where it is mapped."""


def lanes_last(function: Mapped, *, common: int = 0) -> Mapped:
    """The function, which `vmap` maps by an axis behind those of its arrays instead of one before them.

    A matrix (n, n) of each run becomes (n, n, runs), in memory n² vectors over runs, which processors add and multiply
    at full speed; (runs, n, n) would be runs · n vectors of length n.

    The function must take and return arrays with any axes behind their own, and compute along them: sums and products
    name their axes from the front, and a number that belongs to a run has the shape of what comes behind; a number that
    all runs share stays one. Derivatives are taken forwards (`jax.jvp`, `jax.jacfwd`), not backwards.

    Args:
        common: number of leading arguments that get no axis of runs where all runs share them, such as a matrix that
            multiplies those of all runs at once.
    """

    @jax.custom_batching.custom_vmap
    def mapped(*arguments):
        return function(*arguments)

    @mapped.def_vmap
    def _(axis_size, in_batched, *arguments):
        if not any(jax.tree.leaves(in_batched)):  # derivatives along several directions at one place
            out = function(*arguments)
            return out, jax.tree.map(lambda _: False, out)

        def inwards(leaf, batched):
            if batched:
                return jnp.moveaxis(leaf, 0, -1)
            return jnp.broadcast_to(leaf[..., None], (*leaf.shape, axis_size)) if jnp.ndim(leaf) else leaf

        shared = [not any(jax.tree.leaves(batched)) for batched in in_batched[:common]]
        moved = [
            argument if k < common and shared[k] else jax.tree.map(inwards, argument, batched)
            for k, (argument, batched) in enumerate(zip(arguments, in_batched, strict=True))
        ]
        out = function(*moved)

        def outwards(leaf):
            wide = jnp.broadcast_to(leaf, (*leaf.shape[:-1], axis_size))
            return jnp.moveaxis(wide, -1, 0)

        return jax.tree.map(outwards, out), jax.tree.map(lambda _: True, out)

    return cast(Mapped, wraps(function)(mapped))


def each(function: Mapped) -> Mapped:
    """The function mapped over the leading axis of its arrays, which is put behind those that `function` knows of.

    For one of `lanes_last` that takes modes or particles of a run: `vmap` then puts the runs behind these. A number
    without axes is shared.
    """

    def mapped(*arguments):
        moved = jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 0, -1) if jnp.ndim(leaf) else leaf, arguments)
        return jax.tree.map(lambda leaf: jnp.moveaxis(leaf, -1, 0), function(*moved))

    return cast(Mapped, mapped)


def total(array):
    """Sum over the short first axis, written out: XLA on CPUs calls a routine for sums, which nothing merges with."""
    return sum(array[i] for i in range(1, array.shape[0])) + array[0]

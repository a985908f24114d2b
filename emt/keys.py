"""Every random key of the program is derived here, as a function of (seed, run, purpose, step).

A run is therefore the same alone, in any chunk and on any device; adding a filter changes no other filter; and a
longer experiment extends a shorter one. With JAX's partitionable generator a longer draw begins with the shorter
one (`normal(key, (8, 2))[:5] == normal(key, (5, 2))`), so enlarging the padding changes no detection.
"""

import zlib
from enum import IntEnum

import jax
from jaxtyping import Array, Int, PRNGKeyArray


class Purpose(IntEnum):
    """What a key is for. Values are part of what a seed means: never renumber."""

    TRUTH = 0
    MEASUREMENTS = 1
    FILTER = 2
    PRIOR = 3


def run_key(seed: Int[Array, ""], run: Int[Array, ""]) -> PRNGKeyArray:
    """Key of one Monte Carlo run."""
    return jax.random.fold_in(jax.random.key(seed), run)


def purpose_key(key: PRNGKeyArray, purpose: Purpose) -> PRNGKeyArray:
    """Key of one purpose within a run."""
    return jax.random.fold_in(key, int(purpose))


def filter_number(label: str) -> int:
    """The number by which the keys of a filter differ from those of the others."""
    return zlib.crc32(label.encode())


def filter_key(key: PRNGKeyArray, number: int | Int[Array, ""]) -> PRNGKeyArray:
    """Key of one filter within a run, by its number (see `filter_number`)."""
    return jax.random.fold_in(purpose_key(key, Purpose.FILTER), number)


def step_key(key: PRNGKeyArray, step: Int[Array, ""]) -> PRNGKeyArray:
    """Key of one time step within a purpose."""
    return jax.random.fold_in(key, step)


def start_key(key: PRNGKeyArray) -> PRNGKeyArray:
    """Key for what happens before the first step of a purpose; no step has this number."""
    return jax.random.fold_in(key, 0xFFFFFFFF)

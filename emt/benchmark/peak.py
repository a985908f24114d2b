"""The multiply-add peak of one core, as far as XLA's own code reaches it."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from emt.benchmark.clock import timed
from emt.device import configure

SIZES = ((1, 1024, 32), (1, 1024, 128), (4, 256, 32), (4, 1024, 64), (8, 256, 32), (12, 256, 64))
"""Vectors, their length, and multiply-adds between loading and storing them; all fit a first-level cache of 32 KiB but
for one, for those that are larger."""
OPERATIONS, ATTEMPTS = 4e8, 5
"""Floating-point operations of a kernel, and how often it is timed: the fastest counts, it is a bound."""


class Peak(NamedTuple):
    """The fastest kernel."""

    flops: float
    """Additions and multiplications per second."""
    vectors: int
    length: int
    depth: int


def multiply_adds(vectors: int, length: int, depth: int, loops: int):
    """Compiled a ← a b + c on independent vectors of doubles, `depth` times `loops` times; with its arguments."""

    def body(_, carry):
        b, c, a = carry
        for _ in range(depth):
            a = tuple(one * b + c for one in a)
        return b, c, a

    start = tuple(jnp.full(length, 1.0 + k, jnp.float64) for k in range(vectors))
    arguments = (jnp.full(length, 0.999, jnp.float64), jnp.full(length, 1e-3, jnp.float64), start)
    return jax.jit(lambda *given: jax.lax.fori_loop(0, loops, body, given)).lower(*arguments).compile(), arguments


def measured_peak(operations: float = OPERATIONS) -> Peak:
    """Peak of the core this process runs on, in double precision, by CPU time; a multiply-add counts as two.

    The kernels are compiled by XLA like everything else here: another compiler may come closer to what the core can do.
    """
    configure()
    best = Peak(0.0, 0, 0, 0)
    for vectors, length, depth in SIZES:
        loops = max(1, round(operations / (2.0 * vectors * length * depth)))
        compiled, arguments = multiply_adds(vectors, length, depth, loops)

        def call(compiled=compiled, arguments=arguments):
            return jax.block_until_ready(compiled(*arguments))

        call()
        seconds = min(timed(call)[0] for _ in range(ATTEMPTS))
        flops = 2.0 * vectors * length * depth * loops / max(seconds, 1e-9)
        best = max(best, Peak(flops, vectors, length, depth))
    return best

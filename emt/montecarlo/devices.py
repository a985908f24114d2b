"""Runs spread over devices, and how many go to each at a time."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh, PartitionSpec

ACCELERATOR_LANES = 100_000
"""Runs that an accelerator is given at once: fewer leave its processors waiting for the next kernel. A processor core
is given one chunk, which fits its cache."""


def chunks_at_once(chunk_size: int, devices: Sequence[Any]) -> int:
    """Chunks in one call of a compiled program: on each device one, or as many as fill an accelerator."""
    per_device = 1 if devices[0].platform == "cpu" else max(1, ACCELERATOR_LANES // chunk_size)
    return per_device * len(devices)


def over_runs(
    function: Callable[..., Any], in_axes: tuple[int | None, ...], devices: Sequence[Any], out_axis: int = 0
) -> Any:
    """The jitted function of one run mapped over runs, an equal share on each device.

    Each device runs the program that a single one would run on its share, so the numbers of a run do not depend on how
    many devices there are.

    Args:
        in_axes: the axis of runs of each argument, None for those that all runs share.
        out_axis: that of the results.
    """
    mapped = jax.vmap(function, in_axes=in_axes, out_axes=out_axis)
    if len(devices) == 1:
        return jax.jit(mapped)
    mesh = Mesh(np.array(devices), ("runs",))

    def spec(axis: int | None) -> PartitionSpec:
        return PartitionSpec() if axis is None else PartitionSpec(*[None] * axis, "runs")

    specs = tuple(spec(axis) for axis in in_axes)
    shared = jax.shard_map(mapped, mesh=mesh, in_specs=specs, out_specs=spec(out_axis), check_vma=False)
    return jax.jit(shared)

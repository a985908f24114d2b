"""What the filters of emt are given in some runs, for other packages."""

from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np

from emt.benchmark.peers.base import Scans
from emt.montecarlo.program import Program


def scans_of(program: Program, arrays: Mapping[str, np.ndarray], seed: int, start: int = 0) -> Scans:
    """Scans and, where they are drawn, prior means of the tracked runs of a chunk.

    Args:
        arrays: of the chunk (`montecarlo.chunks.Engine.run_chunk`), with tracks.
        start: number of its first run.
    """
    points, mask = arrays["scans/points"], arrays["scans/mask"]
    if not program.experiment.model.prior.drawn:
        return Scans(points, mask)
    runs = start + jnp.arange(len(points))
    means = jax.vmap(lambda run: program.prior_of_run(program.world.prior, jnp.asarray(seed), run).mean)(runs)
    return Scans(points, mask, np.asarray(means))

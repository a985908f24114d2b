"""How often a filter had to force its shape back into the possible."""

import jax.numpy as jnp

from emt.metrics.base import Metric, register
from emt.status import Status

register(
    Metric(
        "moments_projected",
        "1",
        "neither",
        "fraction of scans in which the projection of image moments changed a mean (of any mode)",
        lambda estimate, truth, info: jnp.where(
            (info.status & int(Status.MOMENTS_PROJECTED)) != 0, 1.0, jnp.zeros_like(info.nis)
        ),
    )
)

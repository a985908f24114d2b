"""What all scenarios share whose true track is the same in every run: only the detections are random."""

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jax.tree_util import register_dataclass
from jaxtyping import Array, Float

from emt.scenarios.detections import DetectionParams, DetectionSettings, capacity_for, params_of, sample_scans
from emt.types import Ellipse, Scenario, Traced, Truth


@register_dataclass
@dataclass(frozen=True)
class GivenTrack:
    """Traced numbers of the scenario."""

    dt: Traced
    position: Float[Array, "n_steps 2"]
    velocity: Float[Array, "n_steps 2"]
    orientation: Float[Array, "n_steps"]
    semi_axes: Float[Array, "n_steps 2"]
    detections: DetectionParams


def given_track(detections: DetectionSettings, runs: int, dt: float, position, velocity, orientation, semi_axes):
    """Traced parameters and static builder of a scenario with this true track.

    Args:
        position, velocity: (n_steps, 2), m and m/s.
        orientation, semi_axes: (n_steps,) or a number, rad; and (n_steps, 2) or a pair, m.
    """
    n_steps = len(position)
    params = GivenTrack(
        dt,
        jnp.asarray(position),
        jnp.asarray(velocity),
        jnp.asarray(np.broadcast_to(np.asarray(orientation, float), (n_steps,))),
        jnp.asarray(np.broadcast_to(np.asarray(semi_axes, float), (n_steps, 2))),
        params_of(detections),
    )
    capacity = capacity_for(detections, n_steps, runs)

    def make(params: GivenTrack) -> Scenario:
        def scans(truth: Truth, key):
            return sample_scans(key, truth, detections, params.detections, capacity)

        def sample_truth(key) -> Truth:
            return Truth.moving(params.position, params.velocity, Ellipse(params.semi_axes, params.orientation))

        return Scenario(jnp.full(n_steps, params.dt), sample_truth, scans)

    return params, make

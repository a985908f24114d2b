"""An object at rest: for single updates and for convergence with the number of scans."""

from dataclasses import dataclass
from typing import ClassVar, Literal

import jax.numpy as jnp
from jax.tree_util import register_dataclass
from jaxtyping import Array, Float
from pydantic import PositiveInt

from emt.registry import SCENARIOS
from emt.scenarios.detections import DetectionParams, DetectionSettings, capacity_for, params_of, sample_scans
from emt.settings import Angle, Duration, Length, PositiveLength, Settings
from emt.types import Ellipse, Scenario, Traced, Truth


class StationarySettings(Settings):
    """An ellipse at rest."""

    kind: Literal["stationary"] = "stationary"
    steps: PositiveInt = 1
    dt: Duration = 1.0
    """Time between scans."""
    position: tuple[Length, Length] = (0.0, 0.0)
    orientation: Angle = 0.0
    semi_axes: tuple[PositiveLength, PositiveLength]
    detections: DetectionSettings
    has_truth: ClassVar[bool] = True

    @property
    def n_steps(self) -> int:
        return self.steps


@register_dataclass
@dataclass(frozen=True)
class Params:
    """Traced numbers of the scenario."""

    dt: Traced
    position: Float[Array, "2"]
    orientation: Traced
    semi_axes: Float[Array, "2"]
    detections: DetectionParams


def build(settings: StationarySettings, runs: int):
    """Traced parameters and static builder of the settings."""
    params = Params(
        settings.dt,
        jnp.asarray(settings.position),
        settings.orientation,
        jnp.asarray(settings.semi_axes),
        params_of(settings.detections),
    )
    detections, n_steps = settings.detections, settings.steps
    capacity = capacity_for(detections, n_steps, runs)

    def make(params: Params) -> Scenario:
        def scans(truth: Truth, key):
            return sample_scans(key, truth, detections, params.detections, capacity)

        def sample_truth(key) -> Truth:
            position = jnp.broadcast_to(params.position, (n_steps, 2))
            axes = jnp.broadcast_to(params.semi_axes, (n_steps, 2))
            return Truth(position, jnp.zeros_like(position), Ellipse(axes, jnp.full(n_steps, params.orientation)))

        return Scenario(jnp.full(n_steps, params.dt), sample_truth, scans)

    return params, make


SCENARIOS.register("stationary", StationarySettings, build)

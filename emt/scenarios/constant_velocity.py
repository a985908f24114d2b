"""A rigid ellipse with random acceleration and a heading of its own that performs a random walk."""

from dataclasses import dataclass
from typing import ClassVar, Literal

import jax
import jax.numpy as jnp
from jax.tree_util import register_dataclass
from jaxtyping import Array, Float
from pydantic import PositiveInt

from emt.keys import step_key
from emt.models.motion import WhiteAcceleration
from emt.registry import SCENARIOS
from emt.scenarios.detections import DetectionParams, DetectionSettings, capacity_for, params_of, sample_scans
from emt.settings import (
    AccelerationDensity,
    Angle,
    AngleVariance,
    Duration,
    Length,
    PositiveLength,
    Settings,
    Speed,
)
from emt.types import Ellipse, Scenario, Traced, Truth


class ConstantVelocitySettings(Settings):
    """Nearly constant velocity; the orientation is an independent random walk."""

    kind: Literal["constant_velocity"] = "constant_velocity"
    dt: Duration
    """Time between scans."""
    steps: PositiveInt
    position: tuple[Length, Length] = (0.0, 0.0)
    """Position one step before the first scan."""
    velocity: tuple[Speed, Speed]
    """Velocity one step before the first scan."""
    orientation: Angle = 0.0
    """Orientation one step before the first scan."""
    acceleration_psd: AccelerationDensity
    """Power spectral density of the acceleration on each axis."""
    orientation_noise: AngleVariance
    """Variance of the step of the orientation's random walk."""
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
    start: Float[Array, "5"]
    """x, y, vx, vy, orientation one step before the first scan."""
    noise: WhiteAcceleration
    orientation_noise: Traced
    semi_axes: Float[Array, "2"]
    detections: DetectionParams


def build(settings: ConstantVelocitySettings, runs: int):
    """Traced parameters and static builder of the settings."""
    params = Params(
        settings.dt,
        jnp.asarray([*settings.position, *settings.velocity, settings.orientation]),
        WhiteAcceleration(settings.acceleration_psd),
        settings.orientation_noise,
        jnp.asarray(settings.semi_axes),
        params_of(settings.detections),
    )
    detections, n_steps = settings.detections, settings.steps
    capacity = capacity_for(detections, n_steps, runs)

    def make(params: Params) -> Scenario:
        def scans(truth: Truth, key):
            return sample_scans(key, truth, detections, params.detections, capacity)

        def sample_truth(key) -> Truth:
            noise = params.noise(params.dt)
            dtype = params.start.dtype

            def step(state, k):
                w = jax.random.normal(step_key(key, k), (5,), dtype)
                shift = jnp.sqrt(noise.position.xx) * w[:2]
                kick = noise.gain.xx * shift + jnp.sqrt(noise.velocity.xx) * w[2:4]
                position = state[:2] + params.dt * state[2:4] + shift
                orientation = state[4] + jnp.sqrt(params.orientation_noise) * w[4]
                state = jnp.concatenate([position, state[2:4] + kick, orientation[None]])
                return state, state

            _, states = jax.lax.scan(step, params.start, jnp.arange(n_steps))
            axes = jnp.broadcast_to(params.semi_axes, (n_steps, 2))
            return Truth(states[:, :4], Ellipse(axes, states[:, 4]))

        return Scenario(jnp.full(n_steps, params.dt), sample_truth, scans)

    return params, make


SCENARIOS.register("constant_velocity", ConstantVelocitySettings, build)

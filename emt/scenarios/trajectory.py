"""A fixed trajectory of straight legs and turns, flown by a rigid ellipse that points along its heading."""

from dataclasses import dataclass
from typing import ClassVar, Literal

import jax.numpy as jnp
import numpy as np
from jax.tree_util import register_dataclass
from jaxtyping import Array, Float
from pydantic import PositiveInt

from emt.registry import SCENARIOS
from emt.scenarios.detections import DetectionParams, DetectionSettings, capacity_for, params_of, sample_scans
from emt.settings import Angle, Duration, Length, PositiveLength, Settings, Speed
from emt.types import Ellipse, Scenario, Traced, Truth


class Leg(Settings):
    """Steps on one heading, or turning evenly from a first to a last heading."""

    steps: PositiveInt
    heading: Angle | tuple[Angle, Angle]
    """One heading, or the headings of the first and the last step of the leg."""
    speed: Speed | None = None
    """Speed on this leg; by default that of the scenario."""


class TrajectorySettings(Settings):
    """A given trajectory: legs of constant or evenly turning heading; the object points along its heading."""

    kind: Literal["trajectory"] = "trajectory"
    dt: Duration
    """Time between scans."""
    speed: Speed
    start: tuple[Length, Length] = (0.0, 0.0)
    """Centre at the first scan."""
    legs: tuple[Leg, ...]
    semi_axes: tuple[PositiveLength, PositiveLength]
    """True semi-axes; the first lies along the heading."""
    detections: DetectionSettings
    has_truth: ClassVar[bool] = True

    @property
    def n_steps(self) -> int:
        return sum(leg.steps for leg in self.legs)


@register_dataclass
@dataclass(frozen=True)
class Params:
    """Traced numbers of the scenario."""

    dt: Traced
    start: Float[Array, "2"]
    heading: Float[Array, "n_steps"]
    speed: Float[Array, "n_steps"]
    semi_axes: Float[Array, "2"]
    detections: DetectionParams


def headings_and_speeds(settings: TrajectorySettings) -> tuple[np.ndarray, np.ndarray]:
    """Heading (rad, not wrapped) and speed (m/s) at every scan."""
    headings, speeds = [], []
    for leg in settings.legs:
        first, last = leg.heading if isinstance(leg.heading, tuple) else (leg.heading, leg.heading)
        headings.append(np.linspace(first, last, leg.steps))
        speeds.append(np.full(leg.steps, settings.speed if leg.speed is None else leg.speed))
    return np.concatenate(headings), np.concatenate(speeds)


def build(settings: TrajectorySettings, runs: int):
    """Traced parameters and static builder of the settings."""
    heading, speed = headings_and_speeds(settings)
    params = Params(
        settings.dt,
        jnp.asarray(settings.start),
        jnp.asarray(heading),
        jnp.asarray(speed),
        jnp.asarray(settings.semi_axes),
        params_of(settings.detections),
    )
    detections, n_steps = settings.detections, settings.n_steps
    capacity = capacity_for(detections, n_steps, runs)

    def make(params: Params) -> Scenario:
        def scans(truth: Truth, key):
            return sample_scans(key, truth, detections, params.detections, capacity)

        def sample_truth(key) -> Truth:
            velocity = params.speed[:, None] * jnp.stack([jnp.cos(params.heading), jnp.sin(params.heading)], axis=1)
            moves = (params.dt * velocity).at[0].set(0.0)
            return Truth(
                params.start[None, :] + jnp.cumsum(moves, axis=0),
                velocity,
                Ellipse(jnp.broadcast_to(params.semi_axes, (n_steps, 2)), params.heading),
            )

        return Scenario(jnp.full(n_steps, params.dt), sample_truth, scans)

    return params, make


SCENARIOS.register("trajectory", TrajectorySettings, build)

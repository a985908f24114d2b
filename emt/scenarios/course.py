"""A vehicle that drives a course given by its speed and turn rate over time, seen as points in its bounding box."""

import itertools
from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

import jax.numpy as jnp
import numpy as np
from jax.tree_util import register_dataclass
from jaxtyping import Array, Float
from pydantic import Field, PositiveInt, field_validator

from emt.registry import SCENARIOS
from emt.scenarios.detections import DetectionParams, DetectionSettings, capacity_for, params_of, sample_scans
from emt.settings import Angle, Duration, Length, PositiveLength, Quantity, Settings, Speed, TurnRate
from emt.types import Ellipse, Scenario, Traced, Truth

Instant = Annotated[float, Quantity("s", ge=0)]


class CourseSettings(Settings):
    """Speed and turn rate piecewise linear in time; the true ellipse is the smallest one about the bounding box."""

    kind: Literal["course"] = "course"
    dt: Duration
    """Time between scans; the first is at time 0."""
    steps: PositiveInt
    start: tuple[Length, Length] = (0.0, 0.0)
    heading: Angle = 0.0
    """Heading at the first scan."""
    speed: Annotated[tuple[tuple[Instant, Speed], ...], Field(min_length=1)]
    """Pairs (time, speed), linear in between and constant beyond."""
    turn_rate: Annotated[tuple[tuple[Instant, TurnRate], ...], Field(min_length=1)] = ((0.0, 0.0),)
    """Pairs (time, anticlockwise turn rate), linear in between and constant beyond."""
    box: tuple[PositiveLength, PositiveLength]
    """Full length along the heading, and width, of the bounding box."""
    detections: DetectionSettings
    has_truth: ClassVar[bool] = True

    @property
    def n_steps(self) -> int:
        return self.steps

    @field_validator("speed", "turn_rate")
    @classmethod
    def _in_order(cls, nodes):
        for (earlier, _), (later, _) in itertools.pairwise(nodes):
            if later <= earlier:
                raise ValueError(f"times must increase, but {later:g} s follows {earlier:g} s")
        return nodes


@register_dataclass
@dataclass(frozen=True)
class Params:
    """Traced numbers of the scenario."""

    dt: Traced
    position: Float[Array, "n_steps 2"]
    velocity: Float[Array, "n_steps 2"]
    heading: Float[Array, "n_steps"]
    semi_axes: Float[Array, "2"]
    detections: DetectionParams


def trajectory(settings: CourseSettings) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Position (m), velocity (m/s) and heading (rad, not wrapped) at the scans.

    In step k the vehicle moves by speed times dt along the middle of its headings before and after the step.
    """
    times = settings.dt * np.arange(settings.steps)
    speed, rate = (np.interp(times, *np.array(nodes).T) for nodes in (settings.speed, settings.turn_rate))
    turned = settings.dt * rate
    heading = settings.heading + np.concatenate([[0.0], np.cumsum(turned)[:-1]])
    middle = heading + 0.5 * turned
    moves = settings.dt * speed[:, None] * np.stack([np.cos(middle), np.sin(middle)], 1)
    position = np.array(settings.start) + np.concatenate([np.zeros((1, 2)), np.cumsum(moves, axis=0)[:-1]])
    return position, speed[:, None] * np.stack([np.cos(heading), np.sin(heading)], 1), heading


def build(settings: CourseSettings, runs: int):
    """Traced parameters and static builder of the settings."""
    position, velocity, heading = trajectory(settings)
    params = Params(
        settings.dt,
        jnp.asarray(position),
        jnp.asarray(velocity),
        jnp.asarray(heading),
        jnp.asarray(np.array(settings.box) / np.sqrt(2.0)),  # the smallest enclosing ellipse, by area
        params_of(settings.detections),
    )
    detections, n_steps = settings.detections, settings.steps
    capacity = capacity_for(detections, n_steps, runs)

    def make(params: Params) -> Scenario:
        def scans(truth: Truth, key):
            return sample_scans(key, truth, detections, params.detections, capacity)

        def sample_truth(key) -> Truth:
            axes = jnp.broadcast_to(params.semi_axes, (n_steps, 2))
            return Truth(params.position, params.velocity, Ellipse(axes, params.heading))

        return Scenario(jnp.full(n_steps, params.dt), sample_truth, scans)

    return params, make


SCENARIOS.register("course", CourseSettings, build)

"""A vehicle that drives a course given by its speed and turn rate over time, seen as points in its bounding box."""

import itertools
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field, PositiveInt, field_validator

from emt.registry import SCENARIOS
from emt.scenarios.detections import DetectionSettings
from emt.scenarios.given_track import given_track
from emt.settings import Angle, Duration, Length, PositiveLength, Quantity, Settings, Speed, TurnRate

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

    @property
    def maneuvers(self) -> tuple[tuple[float, float], ...]:
        """Begin and end of each stretch with a turn rate, in scan numbers from 1."""
        found: list[tuple[float, float]] = []
        for (begin, before), (end, after) in itertools.pairwise(self.turn_rate):
            if before != 0.0 or after != 0.0:
                first, last = 1.0 + begin / self.dt, 1.0 + end / self.dt
                if found and found[-1][1] == first:
                    first = found.pop()[0]
                found.append((first, last))
        return tuple(found)

    @field_validator("speed", "turn_rate")
    @classmethod
    def _in_order(cls, nodes):
        for (earlier, _), (later, _) in itertools.pairwise(nodes):
            if later <= earlier:
                raise ValueError(f"times must increase, but {later:g} s follows {earlier:g} s")
        return nodes


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
    axes = np.array(settings.box) / np.sqrt(2.0)  # the smallest enclosing ellipse, by area
    return given_track(settings.detections, runs, settings.dt, position, velocity, heading, axes)


SCENARIOS.register("course", CourseSettings, build)

"""A fixed trajectory of straight legs and turns, flown by a rigid ellipse that points along its heading."""

import itertools
from typing import ClassVar, Literal

import numpy as np
from pydantic import PositiveInt

from emt.registry import SCENARIOS
from emt.scenarios.detections import DetectionSettings
from emt.scenarios.given_track import given_track
from emt.settings import Angle, Duration, Length, PositiveLength, Settings, Speed


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

    @property
    def maneuvers(self) -> tuple[tuple[float, float], ...]:
        """First and last scan number, from 1, of each leg that turns."""
        ends = itertools.accumulate(leg.steps for leg in self.legs)
        return tuple(
            (end - leg.steps + 1, end)
            for leg, end in zip(self.legs, ends, strict=True)
            if isinstance(leg.heading, tuple)
        )


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
    velocity = speed[:, None] * np.stack([np.cos(heading), np.sin(heading)], axis=1)
    moves = settings.dt * velocity
    moves[0] = 0.0
    position = np.asarray(settings.start) + np.cumsum(moves, axis=0)
    return given_track(settings.detections, runs, settings.dt, position, velocity, heading, settings.semi_axes)


SCENARIOS.register("trajectory", TrajectorySettings, build)

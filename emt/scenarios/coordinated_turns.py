"""An ellipse that moves at constant speed on straights and circular arcs."""

from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import PositiveInt, model_validator

from emt.registry import SCENARIOS
from emt.scenarios.detections import DetectionSettings
from emt.scenarios.given_track import given_track
from emt.settings import Angle, Duration, Length, PositiveLength, Quantity, Settings, Speed, TurnRate

Instant = Annotated[float, Quantity("s", ge=0)]


class Turn(Settings):
    """A turn at a constant rate."""

    start: Instant
    duration: Duration
    rate: TurnRate
    """Anticlockwise."""


class CoordinatedTurnsSettings(Settings):
    """Constant speed with coordinated turns; the ellipse turns with the velocity."""

    kind: Literal["coordinated_turns"] = "coordinated_turns"
    dt: Duration
    """Time between scans."""
    steps: PositiveInt
    first_scan: Instant = 0.0
    """Time of the first scan."""
    position: tuple[Length, Length] = (0.0, 0.0)
    """Position at time 0."""
    velocity: tuple[Speed, Speed]
    """Velocity at time 0."""
    turns: tuple[Turn, ...] = ()
    orientation: Angle | Literal["heading"] = "heading"
    """Orientation of the first semi-axis at time 0."""
    semi_axes: tuple[PositiveLength, PositiveLength]
    detections: DetectionSettings
    has_truth: ClassVar[bool] = True

    @property
    def n_steps(self) -> int:
        return self.steps

    @property
    def maneuvers(self) -> tuple[tuple[float, float], ...]:
        """Begin and end of each turn, in scan numbers from 1."""
        ends = [(turn.start, turn.start + turn.duration) for turn in self.turns]
        return tuple(tuple(1.0 + (t - self.first_scan) / self.dt for t in pair) for pair in ends)  # type: ignore[misc]

    @model_validator(mode="after")
    def _turns_in_order(self):
        for k, (one, other) in enumerate(zip(self.turns[:-1], self.turns[1:], strict=True)):
            if other.start < one.start + one.duration:
                raise ValueError(
                    f"turns: turn {k + 2} starts at {other.start:g} s, before the end of the one before it"
                )
        return self


def trajectory(settings: CoordinatedTurnsSettings) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Position (m), velocity (m/s) and turned angle (rad, not wrapped) at the scans, exact at any time."""
    times = settings.first_scan + settings.dt * np.arange(settings.steps)
    end = float(times[-1])
    edges = sorted({0.0, end, *(t for turn in settings.turns for t in (turn.start, turn.start + turn.duration))})
    position, velocity = complex(*settings.position), complex(*settings.velocity)
    angle = 0.0
    positions, angles = np.empty(settings.steps, complex), np.empty(settings.steps)
    for begin, stop in zip(edges, [*edges[1:], np.inf], strict=True):
        rate = sum(turn.rate for turn in settings.turns if turn.start <= begin < turn.start + turn.duration)

        def moved(elapsed, angle=angle, rate=rate):
            half = 0.5 * rate * elapsed  # a chord: its direction is the mean heading
            return velocity * elapsed * np.exp(1j * (angle + half)) * np.sinc(half / np.pi)

        inside = (times >= begin) & (times < stop)
        positions[inside] = position + moved(times[inside] - begin)
        angles[inside] = angle + rate * (times[inside] - begin)
        if np.isfinite(stop):
            position, angle = position + moved(stop - begin), angle + rate * (stop - begin)
    velocities = velocity * np.exp(1j * angles)
    return (
        np.stack([np.real(positions), np.imag(positions)], 1),
        np.stack([np.real(velocities), np.imag(velocities)], 1),
        angles,
    )


def build(settings: CoordinatedTurnsSettings, runs: int):
    """Traced parameters and static builder of the settings."""
    position, velocity, angle = trajectory(settings)
    vx, vy = settings.velocity
    first = float(np.arctan2(vy, vx)) if settings.orientation == "heading" else settings.orientation
    return given_track(settings.detections, runs, settings.dt, position, velocity, first + angle, settings.semi_axes)


SCENARIOS.register("coordinated_turns", CoordinatedTurnsSettings, build)

"""An object at rest: for single updates and for convergence with the number of scans."""

from typing import ClassVar, Literal

import numpy as np
from pydantic import PositiveInt

from emt.registry import SCENARIOS
from emt.scenarios.detections import DetectionSettings
from emt.scenarios.given_track import given_track
from emt.settings import Angle, Duration, Length, PositiveLength, Settings


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


def build(settings: StationarySettings, runs: int):
    """Traced parameters and static builder of the settings."""
    position = np.tile(settings.position, (settings.steps, 1))
    track = position, np.zeros_like(position), settings.orientation, settings.semi_axes
    return given_track(settings.detections, runs, settings.dt, *track)


SCENARIOS.register("stationary", StationarySettings, build)

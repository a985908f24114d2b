"""An object with bounding boxes drawn into a video: a track of the Stanford Drone Dataset, from the user's file."""

import io
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field, NonNegativeInt, PositiveInt, model_validator

from emt.registry import SCENARIOS
from emt.scenarios.data import DataError, read_data
from emt.scenarios.detections import DetectionSettings
from emt.scenarios.given_track import given_track
from emt.settings import Duration, Settings

COLUMNS = ("track", "xmin", "ymin", "xmax", "ymax", "frame", "lost", "occluded", "generated", "label")
"""Columns of `annotations.txt`: track number, box (pixels, y downwards), frame, three flags, label in quotes."""


class AnnotatedSettings(Settings):
    """An annotated track; the true ellipse is the smallest one about the box.

    Reads `annotations.txt` of the Stanford Drone Dataset (Robicquet et al. 2016): one row per track and frame, ten
    columns separated by blanks. Frames in which the track is marked as lost do not count.
    """

    kind: Literal["annotated"] = "annotated"
    path: str | None = None
    """The file, relative to the configuration or to the working directory."""
    sha256: Annotated[str, Field(pattern="^[0-9a-f]{64}$")] | None = None
    """Expected hash of the file; another content is refused."""
    track: NonNegativeInt
    """Number of the track."""
    frames: tuple[NonNegativeInt, NonNegativeInt] | None = None
    """First and last frame; by default all of the track."""
    every: PositiveInt = 1
    """Only every so many frames become a scan."""
    dt: Duration
    """Time between frames."""
    detections: DetectionSettings
    has_truth: ClassVar[bool] = True

    @model_validator(mode="after")
    def _in_order(self):
        if self.frames is not None and self.frames[1] < self.frames[0]:
            raise ValueError(f"frames: the last frame {self.frames[1]} comes before the first {self.frames[0]}")
        return self


def read_boxes(settings: AnnotatedSettings) -> np.ndarray:
    """Boxes xmin, ymin, xmax, ymax of the chosen frames, (n_steps, 4).

    Raises:
        DataError: the file cannot be read, or does not have the track or some of its frames.
    """
    import pandas as pd

    path, content = read_data(settings.path, settings.sha256)
    try:
        table = pd.read_csv(io.BytesIO(content), sep=r"\s+", header=None, quotechar='"')
    except (ValueError, UnicodeDecodeError) as error:
        raise DataError(f"'{path}' is not a readable table: {error}") from error
    if table.shape[1] != len(COLUMNS):
        raise DataError(f"'{path}' has {table.shape[1]} columns, expected {len(COLUMNS)}: {' '.join(COLUMNS)}")
    table.columns = list(COLUMNS)
    for column in COLUMNS[:7]:
        if table[column].dtype.kind not in "iuf" or not np.isfinite(table[column]).all():
            raise DataError(f"'{path}': column '{column}' holds something that is not a number")
    return _boxes_of(path, table, settings)


def _boxes_of(path: Path, table, settings: AnnotatedSettings) -> np.ndarray:
    tracks = sorted({int(track) for track in table["track"]})
    if settings.track not in tracks:
        near = min(tracks, key=lambda t: abs(t - settings.track))
        raise DataError(f"'{path}' has no track {settings.track} (nearest: {near}; it has {len(tracks)})", "track")
    rows = table[(table["track"] == settings.track) & (table["lost"] == 0)].sort_values("frame")
    frames = rows["frame"].to_numpy(np.int64)
    if not len(frames):
        raise DataError(f"'{path}': track {settings.track} is marked as lost in every frame", "track")
    first, last = settings.frames or (int(frames[0]), int(frames[-1]))
    missing = sorted(set(range(first, last + 1)) - set(frames.tolist()))
    if missing:
        some = ", ".join(map(str, missing[:5])) + (f" and {len(missing) - 5} more" if len(missing) > 5 else "")
        message = f"'{path}': track {settings.track} has frames {frames[0]} to {frames[-1]}, but not {some}"
        raise DataError(f"{message}; choose a part without gaps", "frames")
    if len(set(frames.tolist())) < len(frames):
        raise DataError(f"'{path}': track {settings.track} has two boxes in one frame", "track")
    boxes = rows[(frames >= first) & (frames <= last)][list(COLUMNS[1:5])].to_numpy(np.float64)[:: settings.every]
    if (boxes[:, 2:] <= boxes[:, :2]).any():
        raise DataError(f"'{path}': track {settings.track} has a box without area", "track")
    if len(boxes) < 2:
        raise DataError(f"'{path}': track {settings.track} leaves {len(boxes)} frame, at least 2 are needed", "frames")
    return boxes


def build(settings: AnnotatedSettings, runs: int):
    """Traced parameters and static builder of the settings; the true velocity is the slope of the box centre.

    Raises:
        DataError: the file cannot be used.
    """
    boxes = read_boxes(settings)
    dt = settings.dt * settings.every
    centers, sides = 0.5 * (boxes[:, :2] + boxes[:, 2:]), boxes[:, 2:] - boxes[:, :2]
    velocity = np.gradient(centers, dt, axis=0)
    return given_track(settings.detections, runs, dt, centers, velocity, 0.0, sides / np.sqrt(2.0))


SCENARIOS.register("annotated", AnnotatedSettings, build)

"""Estimates frame by frame, from the tracks of a run folder."""

import math

import numpy as np

from emt.reports.numbers import significant
from emt.reports.table import Column, Table
from emt.status import Status
from emt.store import RunReader

ELLIPSE_FIELDS = ("x", "y", "vx", "vy", "orientation_deg", "semi_axis_1", "semi_axis_2")


def estimates_table(reader: RunReader, run: int = 0, frames: tuple[int, ...] | None = None) -> Table:
    """Every filter's estimate at every frame (numbered from 1) of one run, or at the chosen frames.

    Args:
        reader: a folder whose experiment stores tracks.
        run: run number.
        frames: frame numbers; all by default.
    """
    chunk = next(chunk for chunk in reader.chunks() if chunk.start <= run < chunk.stop)
    arrays, row = reader.read_chunk(chunk), run - chunk.start
    unit = reader.manifest["length_unit"]
    state = reader.manifest["state"]
    is_ellipse = state == ["x", "y", "vx", "vy"]
    fields = ELLIPSE_FIELDS if is_ellipse else tuple(state)
    headings = [
        f"x {unit}",
        f"y {unit}",
        f"vx {unit}/s",
        f"vy {unit}/s",
        "orientation deg",
        f"axis 1 {unit}",
        f"axis 2 {unit}",
    ]
    headings = headings if is_ellipse else list(state)
    columns = [Column("filter", "filter"), Column("frame", "frame", True)]
    columns += [Column(name, heading, True) for name, heading in zip(fields, headings, strict=True)]
    columns += [Column("status", "flags")]
    rows, values = [], []
    for label in reader.manifest["filters"]:
        prefix = f"{label}/track/"
        track = {name.removeprefix(prefix): a[row] for name, a in arrays.items() if name.startswith(prefix)}
        n_steps = len(track["mean"])
        for frame in frames or range(1, n_steps + 1):
            if not 1 <= frame <= n_steps:
                continue
            k = frame - 1
            numbers = [*track["mean"][k]]
            if is_ellipse:
                numbers += [math.degrees(track["orientation"][k]), *track["semi_axes"][k]]
            flags = ", ".join(Status.names_of(int(track["status"][k])))
            printed = {name: significant(float(v), 6) for name, v in zip(fields, numbers, strict=True)}
            rows.append({"filter": label, "frame": str(frame), **printed, "status": flags})
            plain = {name: float(np.float64(v)) for name, v in zip(fields, numbers, strict=True)}
            values.append({"filter": label, "frame": frame, **plain, "status": flags})
    return Table(f"{reader.manifest['identity']['experiment']}: estimates", columns, rows, values)

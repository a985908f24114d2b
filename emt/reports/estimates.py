"""Estimates frame by frame, from the tracks of a run folder."""

import math

import numpy as np

from emt.reports.numbers import significant
from emt.reports.table import Column, Table
from emt.status import Status
from emt.store import RunReader

FIELDS = ("x", "y", "vx", "vy", "orientation_deg", "semi_axis_1", "semi_axis_2")


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
    headings = [
        f"x {unit}",
        f"y {unit}",
        f"vx {unit}/s",
        f"vy {unit}/s",
        "orientation deg",
        f"axis 1 {unit}",
        f"axis 2 {unit}",
    ]
    columns = [Column("filter", "filter"), Column("frame", "frame", True)]
    columns += [Column(name, heading, True) for name, heading in zip(FIELDS, headings, strict=True)]
    columns += [Column("status", "flags")]
    rows, values = [], []
    for label in reader.manifest["filters"]:
        track = {name: arrays[f"{label}/track/{name}"][row] for name in ("mean", "semi_axes", "orientation", "status")}
        n_steps = len(track["mean"])
        for frame in frames or range(1, n_steps + 1):
            if not 1 <= frame <= n_steps:
                continue
            k = frame - 1
            numbers = [*track["mean"][k], math.degrees(track["orientation"][k]), *track["semi_axes"][k]]
            flags = ", ".join(Status.names_of(int(track["status"][k])))
            printed = {name: significant(float(v), 6) for name, v in zip(FIELDS, numbers, strict=True)}
            rows.append({"filter": label, "frame": str(frame), **printed, "status": flags})
            plain = {name: float(np.float64(v)) for name, v in zip(FIELDS, numbers, strict=True)}
            values.append({"filter": label, "frame": frame, **plain, "status": flags})
    return Table(f"{reader.manifest['identity']['experiment']}: estimates", columns, rows, values)

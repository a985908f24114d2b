"""Tables of a single run: every scan, numbered from 1, and an overview."""

from typing import Any

import numpy as np

from emt.averaging import OF_SINGLE_RUNS
from emt.reports.numbers import significant, unit_text
from emt.reports.table import Column, Table
from emt.status import Status

Arrays = dict[str, np.ndarray]


def steps_table(arrays: Arrays, labels: list[str], metrics: list[dict[str, Any]], state: list[str]) -> Table:
    """One row per filter and step of the first run in the arrays; metrics that are averaged as squares stay squared.

    Args:
        state: names of the entries of the filters' means.
    """
    rows = []
    for label in labels:
        track = {
            name.rsplit("/", 1)[1]: array[0] for name, array in arrays.items() if name.startswith(f"{label}/track/")
        }
        for k in range(len(track["mean"])):
            row: dict[str, Any] = {"filter": label, "scan": k + 1}
            row |= dict(zip(state, map(float, track["mean"][k]), strict=True))
            if "semi_axes" in track:
                row |= {"semi_axis_1": float(track["semi_axes"][k, 0]), "semi_axis_2": float(track["semi_axes"][k, 1])}
                row["orientation"] = float(track["orientation"][k])
            row["nis"] = float(track["nis"][k])
            for column, metric in enumerate(metrics):
                if label in metric["without"]:
                    continue
                name = metric["name"] + (" (squared)" if metric["over_time"] == "rms" else "")
                row[name] = float(track["per_step"][k, column])
            rows.append(row | {"status": int(track["status"][k])})
    return Table("steps", [], [], rows)


def overview_table(
    arrays: Arrays, labels: list[str], metrics: list[dict[str, Any]], title: str, length_unit: str
) -> Table:
    """Metrics of the run, what was flagged, and the first failed scan, per filter."""
    shown = [(column, m) for column, m in enumerate(metrics) if m["over_runs"] in OF_SINGLE_RUNS]
    columns = [Column("filter", "filter")]
    columns += [Column(m["name"], f"{m['name']} {unit_text(m['unit'], length_unit)}".strip(), True) for _, m in shown]
    columns += [Column("flags", "flags"), Column("failed", "failed at scan", True)]
    rows = []
    for label in labels:
        values = arrays[f"{label}/values"][0]
        row = {"filter": label, "flags": ", ".join(Status.names_of(int(arrays[f"{label}/status"][0]))) or "none"}
        row |= {m["name"]: significant(float(values[column]), 5) for column, m in shown if label not in m["without"]}
        failed = int(arrays[f"{label}/failed_step"][0])
        rows.append(row | {"failed": str(failed + 1) if failed >= 0 else ""})
    return Table(title, columns, rows, rows)

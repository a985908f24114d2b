"""Root-mean-square errors on stretches of time."""

import math
from typing import Any

import numpy as np

from emt.reports.numbers import unit_text, value_and_error
from emt.reports.table import Column, Table

RULES = ("rms", "pooled")
"""Rules over runs that a stretch of time has as well."""


def root_of(means: np.ndarray, rule: str) -> np.ndarray:
    """Mean squares at each step (..., step) as one root: of their mean ("pooled"), or the mean of roots ("rms")."""
    return np.sqrt(means.mean(axis=-1)) if rule == "pooled" else np.sqrt(means).mean(axis=-1)


def segment_number(sums: np.ndarray, counts: np.ndarray, rule: str) -> dict[str, Any]:
    """Value and standard error, by the jackknife over blocks of runs.

    Args:
        sums: squared errors summed over the runs of each block (block, step), on the stretch.
        counts: runs in each block.
    """
    sums, counts = sums[counts > 0], counts[counts > 0]
    runs = int(counts.sum())
    if not runs:
        return {"value": None, "se": None, "runs_used": 0}
    value, error, blocks = float(root_of(sums.sum(axis=0) / runs, rule)), math.nan, len(counts)
    if blocks > 1:
        without = root_of((sums.sum(axis=0) - sums) / (runs - counts)[:, None], rule)
        error = float(np.sqrt((blocks - 1) / blocks * np.sum((without - without.mean()) ** 2)))
    return {"value": value, "se": error if math.isfinite(error) else None, "runs_used": runs}


def segment_numbers(
    segments: dict[str, list[int]], sums: np.ndarray, counts: np.ndarray, metric: dict[str, Any]
) -> dict[str, Any]:
    """Segment -> number, of one metric of one filter.

    Args:
        segments: first and last scan (from 1) of each.
        sums: (block, step).
        counts: (block,).
    """
    return {
        name: segment_number(sums[:, first - 1 : last], counts, metric["over_runs"])
        for name, (first, last) in segments.items()
    }


def segments_table(summary: dict[str, Any], length_unit: str) -> Table | None:
    """Root-mean-square errors of every filter on every stretch; None if the experiment has none."""
    numbers = summary.get("segments", {})
    units = {m["name"]: unit_text(m["unit"], length_unit) for m in summary["metrics"]}
    names = list(dict.fromkeys(name for one in numbers.values() for metric in one.values() for name in metric))
    if not names:
        return None
    columns = [Column("filter", "filter"), Column("metric", "metric")] + [Column(n, n, True) for n in names]
    rows, values = [], []
    for label, metrics in numbers.items():
        for metric, found in metrics.items():
            row = {"filter": label, "metric": f"{metric} {units[metric]}".strip()}
            for name in names:
                value, error = value_and_error(found[name]["value"], found[name]["se"])
                row[name] = f"{value} ± {error}" if error else value
                values.append(
                    {"experiment": summary["experiment"], "filter": label, "metric": metric}
                    | {"segment": name, **found[name]}
                )
            rows.append(row)
    return Table(f"{summary['experiment']}, on stretches of time", columns, rows, values)

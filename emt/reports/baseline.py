"""Regression of metrics: results beside stored baselines."""

import json
import math
from pathlib import Path
from typing import Any, NamedTuple

from emt.reports.numbers import significant
from emt.reports.table import Column, Table

EXACT_TOLERANCE = 1e-9
"""Largest relative change of a metric on the platform of the baseline."""
Z_LIMIT = 4.0
"""Largest change in combined standard errors on another platform."""
PLATFORM = ("device", "backend", "machine", "cpu", "processors", "jax", "jaxlib")
"""What must be equal for numbers to be equal to rounding."""


class Change(NamedTuple):
    """A metric that is not where the baseline has it."""

    experiment: str
    filter: str
    metric: str
    baseline: float | None
    now: float | None
    measure: str
    """How far it moved, in the terms of the comparison made."""


class BaselineError(Exception):
    """A baseline that cannot be used; the text says what to do."""


def baseline_of(summary: dict[str, Any], environment: dict[str, Any]) -> dict[str, Any]:
    """What is kept of a summary: value, standard error and run count of every metric, and the platform."""
    filters = {
        label: {name: {key: numbers[key] for key in ("value", "se", "runs_used")} for name, numbers in metrics.items()}
        for label, metrics in summary["filters"].items()
    }
    return {
        "experiment": summary["experiment"],
        "runs": summary["runs"],
        "seed": summary["seed"],
        "platform": {key: environment[key] for key in PLATFORM},
        "filters": filters,
    }


def read_baseline(path: Path) -> dict[str, Any]:
    """A stored baseline.

    Raises:
        BaselineError: missing or damaged.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(content["filters"], dict) or not isinstance(content["platform"], dict):
            raise TypeError("not a baseline")
    except OSError as error:
        raise BaselineError(f"{path}: {error.strerror or error}; make it with `emt check --update`") from error
    except (ValueError, KeyError, TypeError) as error:
        raise BaselineError(f"{path}: damaged ({error}); make it anew with `emt check --update`") from error
    return content


def compare(now: dict[str, Any], baseline: dict[str, Any]) -> list[Change]:
    """Everything that moved: beyond rounding on the same platform, beyond chance on another."""
    same_platform = now["platform"] == baseline["platform"]
    changes = []
    if (now["runs"], now["seed"]) != (baseline["runs"], baseline["seed"]):
        detail = f"{now['runs']} runs of seed {now['seed']}, not {baseline['runs']} of {baseline['seed']}"
        return [Change(now["experiment"], "", "", None, None, detail)]
    for label in sorted({*now["filters"], *baseline["filters"]}):
        ours, theirs = now["filters"].get(label, {}), baseline["filters"].get(label, {})
        for name in sorted({*ours, *theirs}):
            a, b = ours.get(name), theirs.get(name)
            moved = "new" if b is None else "missing" if a is None else difference(a, b, exact=same_platform)
            if moved:
                values = (None if b is None else b["value"], None if a is None else a["value"])
                changes.append(Change(now["experiment"], label, name, *values, moved))
    return changes


def difference(now: dict[str, Any], baseline: dict[str, Any], *, exact: bool) -> str:
    """How far a metric moved, in words; empty if it did not."""
    if now["runs_used"] != baseline["runs_used"] and exact:
        return f"{now['runs_used']} runs used, not {baseline['runs_used']}"
    a, b = now["value"], baseline["value"]
    if a is None or b is None:
        return "" if a is b else "no value on one side"
    if exact:
        relative = abs(a - b) / max(abs(b), 1e-12)
        return f"{relative:.1e} relative" if relative > EXACT_TOLERANCE else ""
    error = math.hypot(now["se"] or 0.0, baseline["se"] or 0.0)
    z = abs(a - b) / error if error > 0.0 else (0.0 if math.isclose(a, b, rel_tol=1e-6) else math.inf)
    return f"{z:.1f} standard errors" if z > Z_LIMIT else ""


def changes_table(changes: list[Change]) -> Table:
    """What moved, for people."""
    columns = [
        Column("experiment", "experiment"),
        Column("filter", "filter"),
        Column("metric", "metric"),
        Column("baseline", "baseline", True),
        Column("now", "now", True),
        Column("measure", "moved by"),
    ]
    rows = []
    for change in changes:
        row = {k: v for k, v in change._asdict().items() if isinstance(v, str)}
        numbers = {"baseline": change.baseline, "now": change.now}
        rows.append(row | {k: "" if v is None else significant(v, 8) for k, v in numbers.items()})
    return Table("Metrics that moved", columns, rows, [change._asdict() for change in changes])

"""The answer of a search, as tables and in the user's file."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from emt.config.edit import marked_calibrated, replace_file, with_values
from emt.config.errors import ConfigError, Problem
from emt.config.load import Loaded, check, has_key
from emt.config.source import parse_source
from emt.reports.numbers import significant, unit_text, value_and_error
from emt.reports.table import Column, Table
from emt.tuning.parameters import Parameter, candidate
from emt.tuning.search import Outcome, Plan

MOST_ROWS = 10


def shown(value: Any, unit: str = "") -> str:
    """A value of a parameter, with its unit."""
    return (significant(value, 5) if isinstance(value, float) else str(value)) + unit


def parameters_table(outcome: Outcome) -> Table:
    """What the search changed."""
    columns = [Column("key", "parameter"), Column("start", "start", True), Column("tuned", "tuned", True)]
    values = [
        {"key": p.name, "start": p.start, "tuned": value}
        for p, value in zip(outcome.parameters, outcome.values, strict=True)
    ]
    rows = [
        {"key": p.name, "start": shown(p.start, p.unit), "tuned": shown(value, p.unit)}
        for p, value in zip(outcome.parameters, outcome.values, strict=True)
    ]
    return Table(f"parameters of {outcome.label}", columns, rows, values)


def scores_table(outcome: Outcome, length_unit: str) -> Table:
    """Start beside answer: on the tuning runs, and on runs that had no part in the search."""
    columns = [
        Column("runs", "runs"),
        Column("metric", "metric"),
        Column("start", "start", True),
        Column("tuned", "tuned", True),
        Column("change", "change", True),
        Column("failed", "failed", True),
    ]
    counts = {"tuning": outcome.tuning_runs, "reporting": outcome.reporting_runs}
    rows, values = [], []
    for one in outcome.comparisons:
        gap, error = one.tuned.above(one.start)
        cells = {
            name: "{} ± {}".format(*value_and_error(a, b)) if b > 0.0 else significant(a, 5)
            for name, (a, b) in {
                "start": (one.start.value, one.start.error),
                "tuned": (one.tuned.value, one.tuned.error),
                "change": (gap, error),
            }.items()
        }
        name = f"{one.metric.name} {unit_text(one.metric.unit, length_unit)}".strip()
        failed = f"{one.start.failed} / {one.tuned.failed}"
        rows.append({"runs": f"{one.runs} ({counts[one.runs]})", "metric": name, **cells, "failed": failed})
        numbers = {"start": one.start.value, "tuned": one.tuned.value, "change": gap, "change_se": error}
        values.append({"runs": one.runs, "metric": one.metric.name, **numbers})
    return Table("scores", columns, rows, values)


def tried_table(outcome: Outcome, plan: Plan) -> Table:
    """Candidates by their value on the tuning runs, the best first; every one of them, in order, for machines."""
    names, objective, followed = [p.name for p in outcome.parameters], plan.objective.name, plan.followed.name
    columns = [*(Column(name, name, True) for name in names), Column("value", objective, True)]
    columns += [Column("followed", followed, True)] * (followed != objective) + [Column("failed", "failed", True)]
    sign = 1.0 if plan.objective.better == "lower" else -1.0
    order = sorted(outcome.tried, key=lambda one: sign * one.objective if math.isfinite(one.objective) else math.inf)
    rows = [
        dict(zip(names, map(shown, one.values), strict=True))
        | {
            "value": significant(one.objective, 5)
            + (f" ± {significant(one.error, 2)}" if math.isfinite(one.error) else ""),
            "followed": significant(one.followed, 5),
            "failed": str(one.failed),
        }
        for one in order[:MOST_ROWS]
        if math.isfinite(one.objective)
    ]
    values = [
        dict(zip(names, one.values, strict=True))
        | {objective: one.objective, "se": one.error, followed: one.followed, "failed": one.failed}
        for one in outcome.tried
    ]
    return Table(f"best of {len(outcome.tried)} candidates on the tuning runs", columns, rows, values)


def prepare_text(loaded: Loaded, parameters: Sequence[Parameter], values: Sequence[Any]) -> str:
    """The text of the user's file with these values, marked as calibrated.

    Raises:
        ConfigError: a value is not the file's own, or the changed file would say something else.
    """
    path, file = Path(loaded.source.path), str(loaded.source.path)
    text = path.read_bytes().decode("utf-8-sig")
    changes = {p: str(one.text(value)) for one, value in zip(parameters, values, strict=True) for p in one.paths}
    text = with_values(text, file, changes)
    resolved = loaded.experiment.model_dump(mode="json")
    keys = dict.fromkeys(calibrated_key(resolved, [str(part) for part in key_path]) for key_path in changes)
    text = marked_calibrated(text, file, keys)
    written = check(parse_source(text, path), path)
    wanted = candidate(loaded, parameters, values).experiment
    if written.model_dump(exclude={"sources"}) != wanted.model_dump(exclude={"sources"}):
        message = "the tuned values cannot be written without changing something else, such as a --set; nothing written"
        raise ConfigError([Problem(file, None, "", message)])
    return text


def calibrated_key(resolved: Any, path: list[str]) -> str:
    """The setting that holds a value: the longest part of its key path that names one."""
    length = max(n for n in range(1, len(path) + 1) if has_key(resolved, path[:n]))
    return ".".join(path[:length])


def write_answer(loaded: Loaded, outcome: Outcome) -> None:
    """Writes the answer into the user's file.

    Raises:
        ConfigError: it cannot be written; the file is as it was.
    """
    replace_file(Path(loaded.source.path), prepare_text(loaded, outcome.parameters, outcome.values))

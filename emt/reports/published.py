"""Published numbers beside ours: verdicts from our interval and the printed precision."""

import math
from pathlib import Path
from typing import Any, Literal, NamedTuple

from pydantic import Field, PositiveInt

from emt.config.errors import validate
from emt.config.source import load_source
from emt.reports.claims import Claim
from emt.reports.numbers import significant, unit_text, value_and_error
from emt.reports.table import Column, Table
from emt.settings import Settings

Verdict = Literal["agrees", "close", "differs", "not comparable"]

LEGEND = (
    "agrees: inside our 95 % interval widened by half a unit of the last printed digit.",
    "close: inside that interval when the published value's own sampling error over its runs is added, "
    "or within 5 % of it.",
    "± is our standard error; used: runs without failure / runs.",
)


class Cell(Settings):
    """One printed number."""

    filter: str
    metric: str
    value: str
    """As printed, so that its decimals are known."""
    comparable: bool = True
    """False if the definition or the setting behind the number is known to differ from ours."""


class PublishedTable(Settings):
    """A table of a paper."""

    title: str
    experiment: str
    runs: PositiveInt
    """Monte Carlo runs behind the printed numbers."""
    cells: tuple[Cell, ...]


class Published(Settings):
    """All numbers and claims of a paper that can be compared."""

    paper: str
    citation: str
    definitions: dict[str, str] = Field(default_factory=dict)
    tables: tuple[PublishedTable, ...] = ()
    claims: tuple[Claim, ...] = ()
    benchmarks: tuple[str, ...] = ()
    """Experiments that `emt bench PAPER` times; by default all."""
    animations: tuple[str, ...] = ()
    """Experiments whose animation belongs in the report."""


class Comparison(NamedTuple):
    """A printed number beside ours."""

    cell: Cell
    value: float | None
    se: float | None
    verdict: Verdict
    runs_used: int
    runs: int


def load_published(path: Path) -> Published:
    """Reads and checks a file of published numbers.

    Raises:
        ConfigError: the file is not as it should be.
    """
    return validate(Published, load_source(path))


def half_unit(printed: str) -> float:
    """Half a unit of the last printed digit."""
    decimals = len(printed.partition(".")[2])
    return 0.5 * 10.0**-decimals


def judge(printed: str, published_runs: int, ours: dict[str, Any]) -> Verdict:
    """Verdict on one number, from our value, standard error and spread over runs."""
    value, se, std, n = ours["value"], ours["se"], ours["std"], ours["runs_used"]
    if value is None or n == 0:
        return "not comparable"
    difference = abs(value - float(printed))
    se = 0.0 if se is None else se
    if difference <= 1.96 * se + half_unit(printed):
        return "agrees"
    # the sampling error of the published value scales as ours with the number of runs
    other = se * math.sqrt(n / published_runs) if std is not None else 0.0
    if difference <= 1.96 * math.hypot(se, other) + half_unit(printed) or difference <= 0.05 * abs(float(printed)):
        return "close"
    return "differs"


def compare(table: PublishedTable, summary: dict[str, Any]) -> list[Comparison]:
    """Every cell of a published table beside the summary of our experiment."""
    comparisons = []
    for cell in table.cells:
        ours = summary["filters"].get(cell.filter, {}).get(cell.metric)
        if ours is None:
            comparisons.append(Comparison(cell, None, None, "not comparable", 0, summary["runs"]))
            continue
        verdict = judge(cell.value, table.runs, ours) if cell.comparable else "not comparable"
        comparisons.append(Comparison(cell, ours["value"], ours["se"], verdict, ours["runs_used"], summary["runs"]))
    return comparisons


def comparison_table(table: PublishedTable, summary: dict[str, Any], length_unit: str) -> Table:
    """Published beside reproduced, one row per cell."""
    columns = [
        Column("filter", "filter"),
        Column("metric", "metric"),
        Column("unit", "unit"),
        Column("published", "published", True),
        Column("value", "reproduced", True),
        Column("se", "±", True),
        Column("difference", "diff", True),
        Column("verdict", "verdict"),
        Column("runs", "used", True),
    ]
    units = {metric["name"]: metric["unit"] for metric in summary["metrics"]}
    rows, values = [], []
    for c in compare(table, summary):
        unit = units.get(c.cell.metric, "")
        value, error = value_and_error(c.value, c.se)
        printed = float(c.cell.value)
        difference = "" if c.value is None or printed == 0.0 else f"{100.0 * (c.value / printed - 1.0):+.1f} %"
        rows.append(
            {
                "filter": c.cell.filter,
                "metric": c.cell.metric,
                "unit": unit_text(unit, length_unit),
                "published": c.cell.value,
                "value": value,
                "se": error,
                "difference": difference,
                "verdict": c.verdict,
                "runs": f"{c.runs_used}/{c.runs}",
            }
        )
        values.append(
            {
                "experiment": table.experiment,
                "filter": c.cell.filter,
                "metric": c.cell.metric,
                "published": printed,
                "published_runs": table.runs,
                "value": c.value,
                "se": c.se,
                "verdict": c.verdict,
                "runs_used": c.runs_used,
                "runs": c.runs,
            }
        )
    return Table(f"{table.title} ({table.runs} runs in the paper)", columns, rows, values)


def summary_table(summary: dict[str, Any], length_unit: str) -> Table:
    """All metrics of all filters of one experiment: filters down, metrics across."""
    metrics = [m for m in summary["metrics"] if m["over_runs"] != "std"]
    columns = (
        [Column("filter", "filter")]
        + [Column(m["name"], f"{m['name']} {unit_text(m['unit'], length_unit)}".strip(), True) for m in metrics]
        + [Column("used", "used", True), Column("flags", "flags (runs)")]
    )
    rows, values = [], []
    for label in summary["labels"]:
        numbers, row = summary["filters"][label], {"filter": label}
        for metric in (m for m in metrics if m["name"] in numbers):
            ours = numbers[metric["name"]]
            value, error = value_and_error(ours["value"], ours["se"])
            row[metric["name"]] = f"{value} ± {error}" if error else value
            row["used"] = f"{ours['runs_used']}/{summary['runs']}"
        row["flags"] = ", ".join(f"{name} {n}" for name, n in summary["status"][label]["runs_with"].items())
        rows.append(row)
        for name, ours in numbers.items():
            values.append({"experiment": summary["experiment"], "filter": label, "metric": name, **ours})
    return Table(f"{summary['experiment']}, {summary['runs']} runs, seed {summary['seed']}", columns, rows, values)


def median_table(summary: dict[str, Any], length_unit: str) -> Table:
    """Medians over runs of all metrics of one experiment, for experiments that keep lost runs in the averages."""
    metrics = [m for m in summary["metrics"] if m["over_runs"] == "mean" and m["over_time"] != "end"]
    columns = [Column("filter", "filter")]
    columns += [Column(m["name"], f"{m['name']} {unit_text(m['unit'], length_unit)}".strip(), True) for m in metrics]
    rows, values = [], []
    for label in summary["labels"]:
        numbers, row = summary["filters"][label], {"filter": label}
        for metric in (m for m in metrics if m["name"] in numbers):
            median = numbers[metric["name"]]["median"]
            row[metric["name"]] = "" if median is None else significant(median, 3)
            values.append(
                {"experiment": summary["experiment"], "filter": label, "metric": metric["name"], "median": median}
            )
        rows.append(row)
    return Table(f"{summary['experiment']}, medians over {summary['runs']} runs", columns, rows, values)

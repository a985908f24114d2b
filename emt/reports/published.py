"""Published numbers beside ours: verdicts from our interval and the printed precision."""

import math
from pathlib import Path
from typing import Any, Literal, NamedTuple

from pydantic import Field, PositiveInt

from emt.config.errors import validate
from emt.config.source import load_source
from emt.reports.claims import Claim
from emt.reports.guide import Situation
from emt.reports.numbers import significant, unit_text, value_and_error
from emt.reports.table import Column, Table
from emt.settings import Settings

Verdict = Literal["agrees", "close", "differs", "not comparable", "not confirmed"]
Origin = Literal["published", "unconfirmed", "theory", "independent"]

LEGEND: dict[Origin, tuple[str, ...]] = {
    "published": (
        "agrees: inside our 95 % interval widened by half a unit of the last printed digit.",
        "close: inside that interval when the published value's own sampling error over its runs is added, "
        "or within 5 % of it.",
    ),
    "unconfirmed": (
        "not confirmed: the number is quoted from memory, so it gets no verdict before it has been checked in print.",
    ),
    "theory": ("theory: exact values; agrees: inside our 95 % interval; close: within 5 %.",),
    "independent": (
        "reference: mean ± standard error of another implementation of the same settings (plain NumPy, other random "
        "numbers); agrees: within 1.96 combined standard errors; close: within 4, or within 5 %.",
    ),
}
LEGEND_END = "± is our standard error; used: runs without failure / runs."
Z_AGREES, Z_CLOSE = 1.96, 4.0


class Cell(Settings):
    """One printed number."""

    filter: str
    metric: str
    value: str
    """As printed, so that its decimals are known; with its standard error, "1.23 ± 0.04", where that is known."""
    comparable: bool = True
    """False if the definition or the setting behind the number is known to differ from ours."""


class PublishedTable(Settings):
    """A table of a paper."""

    title: str
    experiment: str
    runs: PositiveInt
    """Monte Carlo runs behind the printed numbers."""
    origin: Origin = "published"
    """Where the numbers come from: print; memory of something in print; theory; another implementation."""
    cells: tuple[Cell, ...] = ()
    rows: dict[str, dict[str, str]] = Field(default_factory=dict)
    """The same in short: filter -> metric -> value."""

    @property
    def all_cells(self) -> tuple[Cell, ...]:
        """Cells and rows."""
        short = [Cell(filter=f, metric=m, value=v) for f, row in self.rows.items() for m, v in row.items()]
        return (*self.cells, *short)


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
    guide: tuple[Situation, ...] = ()
    """Situations for the table of which filter to use when."""


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


def printed_parts(printed: str) -> tuple[str, float | None]:
    """A value as printed, and its standard error where it is given."""
    value, _, error = printed.partition("±")
    return value.strip(), float(error) if error.strip() else None


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


def judge_reference(printed: str, reference_runs: int, ours: dict[str, Any]) -> Verdict:
    """Verdict on a number that another implementation reached, by combined standard errors.

    Where its own is not given, it is taken as ours, scaled by the numbers of runs.
    """
    value, (text, error) = ours["value"], printed_parts(printed)
    if value is None or ours["runs_used"] == 0:
        return "not comparable"
    own = ours["se"] or 0.0
    error = own * math.sqrt(ours["runs_used"] / reference_runs) if error is None else error
    difference, combined = max(abs(value - float(text)) - half_unit(text), 0.0), math.hypot(own, error)
    if difference <= Z_AGREES * combined:
        return "agrees"
    return "close" if difference <= Z_CLOSE * combined or difference <= 0.05 * abs(float(text)) else "differs"


def number_of(summary: dict[str, Any], label: str, metric: str) -> dict[str, Any] | None:
    """Our number of a filter; `metric[segment]` is that of a stretch of time."""
    if not metric.endswith("]"):
        return summary["filters"].get(label, {}).get(metric)
    name, _, segment = metric[:-1].partition("[")
    return summary.get("segments", {}).get(label, {}).get(name, {}).get(segment)


def verdict_on(table: PublishedTable, cell: Cell, ours: dict[str, Any]) -> Verdict:
    """Verdict by the origin of the number."""
    if not cell.comparable:
        return "not comparable"
    if table.origin == "unconfirmed":
        return "not confirmed"
    return (judge_reference if table.origin == "independent" else judge)(cell.value, table.runs, ours)


def compare(table: PublishedTable, summary: dict[str, Any]) -> list[Comparison]:
    """Every cell of a published table beside the summary of our experiment."""
    comparisons = []
    for cell in table.all_cells:
        ours = number_of(summary, cell.filter, cell.metric)
        if ours is None:
            comparisons.append(Comparison(cell, None, None, "not comparable", 0, summary["runs"]))
            continue
        verdict = verdict_on(table, cell, ours)
        comparisons.append(Comparison(cell, ours["value"], ours["se"], verdict, ours["runs_used"], summary["runs"]))
    return comparisons


HEADINGS: dict[Origin, str] = {
    "published": "published",
    "unconfirmed": "from memory",
    "theory": "theory",
    "independent": "reference",
}


def comparison_table(table: PublishedTable, summary: dict[str, Any], length_unit: str) -> Table:
    """Published beside reproduced, one row per cell."""
    columns = [
        Column("filter", "filter"),
        Column("metric", "metric"),
        Column("unit", "unit"),
        Column("published", HEADINGS[table.origin], True),
        Column("value", "reproduced", True),
        Column("se", "±", True),
        Column("difference", "diff", True),
        Column("verdict", "verdict"),
        Column("runs", "used", True),
    ]
    units = {metric["name"]: metric["unit"] for metric in summary["metrics"]}
    rows, values = [], []
    for c in compare(table, summary):
        unit = units.get(c.cell.metric.partition("[")[0], "")
        value, error = value_and_error(c.value, c.se)
        printed = float(printed_parts(c.cell.value)[0])
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
    origin = {"published": f" ({table.runs} runs in the paper)", "independent": f" ({table.runs} runs there)"}
    return Table(f"{table.title}{origin.get(table.origin, '')}", columns, rows, values)


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

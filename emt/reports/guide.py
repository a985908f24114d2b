"""Which filter when: the cheapest that is nearly as good as the best, by situation; and what each costs."""

from collections.abc import Mapping
from typing import Annotated, Any, NamedTuple

from pydantic import Field

from emt.reports.numbers import significant, unit_text, value_and_error
from emt.reports.table import Column, Table
from emt.settings import Settings, UnitInterval

SAME_COST = 1.25
"""Ratio up to which costs count as equal: they are measured in company."""


class Situation(Settings):
    """A situation, the experiment that stands for it, and the filters to choose from."""

    text: str
    experiment: str
    metric: str
    filters: Annotated[tuple[str, ...], Field(min_length=2)]
    within: UnitInterval = 0.05
    """Errors larger than the smallest by up to this share count as equally good."""


class Candidate(NamedTuple):
    """A filter in a situation."""

    label: str
    value: float
    error: float | None
    cost: float
    """Microseconds per run and step."""


def candidates(situation: Situation, summary: dict[str, Any], costs: Mapping[str, float]) -> list[Candidate]:
    """Filters with a value and a cost, the best first."""
    found = []
    for label in situation.filters:
        ours = summary["filters"].get(label, {}).get(situation.metric)
        if ours is not None and ours["value"] is not None and label in costs:
            found.append(Candidate(label, ours["value"], ours["se"], costs[label]))
    return sorted(found, key=lambda one: one.value)


def choice(found: list[Candidate], within: float) -> Candidate:
    """The best of the cheapest among those nearly as good as the best."""
    best = min(one.value for one in found)
    good = [one for one in found if one.value <= (1.0 + within) * best]
    cheapest = min(one.cost for one in good)
    return min((one for one in good if one.cost <= SAME_COST * cheapest), key=lambda one: one.value)


def guide_table(
    situations: tuple[Situation, ...],
    summaries: Mapping[str, dict[str, Any]],
    costs: Mapping[str, Mapping[str, float]],
    units: Mapping[str, str],
) -> Table | None:
    """The choice in every situation whose experiment is at hand; None if there is none.

    Args:
        summaries, costs: by experiment; costs by filter.
        units: length unit of each experiment.
    """
    columns = [
        Column("situation", "situation"),
        Column("use", "use"),
        Column("value", "its error", True),
        Column("cost", "µs per run and step", True),
        Column("others", "others (error; cost relative to it)"),
    ]
    rows, values = [], []
    for situation in situations:
        summary = summaries.get(situation.experiment)
        found = candidates(situation, summary, costs.get(situation.experiment, {})) if summary else []
        if not found or summary is None:
            continue
        chosen = choice(found, situation.within)
        metric = next(m for m in summary["metrics"] if m["name"] == situation.metric)
        unit = unit_text(metric["unit"], units[situation.experiment])
        value, error = value_and_error(chosen.value, chosen.error)
        others = [
            f"{one.label} {significant(one.value, 3)} ({significant(one.cost / chosen.cost, 2)}x)"
            for one in found
            if one is not chosen
        ]
        rows.append(
            {
                "situation": situation.text,
                "use": chosen.label,
                "value": f"{value} ± {error} {unit}".strip() if error else f"{value} {unit}".strip(),
                "cost": significant(chosen.cost, 2),
                "others": ", ".join(others),
            }
        )
        values += [
            {"situation": situation.text, "experiment": situation.experiment, "metric": situation.metric}
            | {"filter": one.label, "value": one.value, "se": one.error, "cost_us": one.cost, "chosen": one is chosen}
            for one in found
        ]
    note = (
        "Chosen is the cheapest of the filters whose error is within 5 % of the smallest; costs within a quarter of "
        "each other count as equal. They are wall-clock times of filter and metrics in the run of this report, on the "
        "machine that made it."
    )
    return Table("Which filter when", columns, rows, values, [note]) if rows else None

"""What the project wants to reach, and whether a measurement reached it."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from emt.benchmark.rivals import BATCHED, PLAIN
from emt.benchmark.standard import WORKLOADS
from emt.reports.numbers import significant
from emt.reports.table import Column, Table

FIRST, LAST = 1_000, 1_000_000
"""Numbers of runs whose memory is compared."""


class Goal(NamedTuple):
    """A bound on a measured number."""

    topic: str
    """Workload, "scaling", "reproduce" or "start" that it belongs to."""
    text: str
    bound: float
    at_least: bool
    """Or else: at most."""
    value: Callable[[Mapping[str, Any]], float | None]
    """Of all results; None where it was not measured."""
    unit: str = "×"

    def reached(self, value: float) -> bool:
        """Whether a measured number keeps the bound."""
        return value >= self.bound if self.at_least else value <= self.bound


def times_faster(workload: str, rival: str) -> Callable[[Mapping[str, Any]], float | None]:
    """How many times longer a rival takes than emt's filter alone."""

    def value(results: Mapping[str, Any]) -> float | None:
        found = results["workloads"].get(workload, {}).get("rivals", ())
        return next((one["ratio"] for one in found if one["name"] == rival), None)

    return value


def end_to_end(results: Mapping[str, Any]) -> float | None:
    """Simulation, filter, metrics and statistics over the filter alone, of W1."""
    parts = results["workloads"].get("vb", {}).get("parts")
    return parts["end_to_end"]["cpu"] / parts["filter"]["cpu"] if parts else None


def warm_start(workload: str) -> Callable[[Mapping[str, Any]], float | None]:
    """Compilation with a filled cache over that with an empty one."""

    def value(results: Mapping[str, Any]) -> float | None:
        found = results["workloads"].get(workload, {}).get("compile")
        return found["warm"]["cpu"] / found["cold"]["cpu"] if found else None

    return value


def memory_growth(results: Mapping[str, Any]) -> float | None:
    """Peak memory of many runs over that of few."""
    found = {row["runs"]: row["memory"] for row in results.get("scaling") or ()}
    return found[LAST] / found[FIRST] if {FIRST, LAST} <= set(found) else None


def whole_reproduction(results: Mapping[str, Any]) -> float | None:
    """Seconds of `emt reproduce` as a whole, at the scale of the papers."""
    found = results.get("reproduce") or {}
    return found.get("wall") if found.get("scale") == "paper" else None


def faster(workload: str, rival: str, bound: float, name: str) -> Goal:
    """The goal to be so many times faster."""
    return Goal(workload, f"{workload}, filter only: faster than {name}", bound, True, times_faster(workload, rival))


GOALS = (
    faster("vb", "pyrecest VBRMTracker", 5000.0, "PyRecEst's VBRMTracker"),
    faster("vb", BATCHED, 8.0, BATCHED),
    Goal("vb", "vb, end to end: of filter only", 4.0, False, end_to_end),
    faster("mem_ekf_star", "pyrecest MEMEKFStarTracker", 1000.0, "PyRecEst's MEMEKFStarTracker"),
    faster("moment_ukf", PLAIN, 8.0, PLAIN),
    *(faster(name, PLAIN, 5.0, PLAIN) for name in ("shape_mixture", "multiple_model", "particle")),
    *(Goal(name, f"{name}, warm start: of cold compilation", 0.2, False, warm_start(name)) for name in WORKLOADS),
    Goal("start", "emt --help", 0.3, False, lambda results: results.get("help_seconds"), "s"),
    Goal("scaling", f"peak memory of {LAST:,} runs: of {FIRST:,} runs", 1.1, False, memory_growth),
    Goal("reproduce", "emt reproduce at paper scale, on two cores", 240.0, False, whole_reproduction, "s"),
)


def verdicts(results: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The goals of everything that was asked for: `goal`, `bound`, `measured` and `reached`, None if not measured."""
    topics = set(results["workloads"]) | {topic for topic in ("scaling", "reproduce") if results.get(topic)}
    topics |= {"start"} if results.get("help_seconds") is not None else set()
    found = []
    for goal in GOALS:
        if goal.topic in topics:
            value = goal.value(results)
            reached = None if value is None else goal.reached(value)
            sign = "≥" if goal.at_least else "≤"
            bound = f"{sign} {goal.bound:,g} {goal.unit}"
            found.append({"goal": goal.text, "bound": bound, "measured": value, "unit": goal.unit, "reached": reached})
    return found


def goals_table(found: list[dict[str, Any]]) -> Table:
    """For people."""
    columns = [
        Column("goal", "goal"),
        Column("bound", "bound", True),
        Column("measured", "measured", True),
        Column("reached", "reached"),
    ]
    rows = [
        {
            "goal": row["goal"],
            "bound": row["bound"],
            "measured": "" if row["measured"] is None else f"{significant(row['measured'])} {row['unit']}",
            "reached": {None: "not measured", True: "yes", False: "no"}[row["reached"]],
        }
        for row in found
    ]
    return Table("Goals", columns, rows, found)

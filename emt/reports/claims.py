"""What a paper states in words, as checks with a verdict."""

import itertools
import math
from collections.abc import Mapping
from typing import Any, Literal

from pydantic import PositiveInt, model_validator

from emt.reports.gathering import filter_results
from emt.reports.numbers import significant, value_and_error
from emt.reports.summary import window_ratio
from emt.reports.table import Column, Table
from emt.settings import Settings
from emt.store import RunReader

ClaimVerdict = Literal["holds", "undecided", "does not hold", "not comparable"]
Z = 1.96
"""Standard errors within which a claim is undecided."""


class Claim(Settings):
    """A statement about one metric, in one of three forms."""

    text: str
    experiment: str
    metric: str
    order: tuple[str, ...] = ()
    """Filters by whose order the values increase."""
    filter: str | None = None
    """The filter that the other two forms are about."""
    at_most: float | None = None
    at_least: float | None = None
    """A bound on the value."""
    window: tuple[PositiveInt, PositiveInt] | None = None
    """First and last scan of a stretch on which the metric is larger than on that of `against`."""
    against: tuple[PositiveInt, PositiveInt] | None = None

    @model_validator(mode="after")
    def _one_form(self):
        bounded = self.at_most is not None or self.at_least is not None
        if (self.window is None) != (self.against is None):
            raise ValueError("give window and against together")
        if (len(self.order) > 1) + bounded + (self.window is not None) != 1:
            raise ValueError("give one of: order (two filters or more), at_most or at_least, window and against")
        if (self.filter is None) != (not bounded and self.window is None):
            raise ValueError("filter: goes with a bound or with windows")
        return self


def verdict_of(gap: float, error: float) -> ClaimVerdict:
    """Verdict on the claim that a gap is positive, from its standard error."""
    if gap > Z * error:
        return "holds"
    return "does not hold" if gap < -Z * error else "undecided"


def order_verdict(claim: Claim, summary: dict[str, Any]) -> tuple[ClaimVerdict, str]:
    """On an order of filters: each gap against the standard error of the difference, taken as independent.

    The filters share their scans, so this is cautious.
    """
    ours = [summary["filters"].get(label, {}).get(claim.metric) for label in claim.order]
    if any(o is None or o["value"] is None for o in ours):
        return "not comparable", ""
    numbers = " < ".join(value_and_error(o["value"], o["se"])[0] for o in ours)
    verdict: ClaimVerdict = "holds"
    for low, high in itertools.pairwise(ours):
        step = verdict_of(high["value"] - low["value"], math.hypot(low["se"] or 0.0, high["se"] or 0.0))
        if step == "does not hold":
            return step, numbers.replace("<", "/")
        if step == "undecided":
            verdict = step
    return verdict, numbers if verdict == "holds" else numbers.replace("<", "/")


def bound_verdict(claim: Claim, summary: dict[str, Any]) -> tuple[ClaimVerdict, str]:
    """On a bound; a value on the bound keeps it."""
    ours = summary["filters"].get(claim.filter, {}).get(claim.metric)
    if ours is None or ours["value"] is None:
        return "not comparable", ""
    value, error = value_and_error(ours["value"], ours["se"])
    number = f"{value} ± {error}" if error else value
    bound = claim.at_most if claim.at_most is not None else claim.at_least
    assert bound is not None
    gap = bound - ours["value"] if claim.at_most is not None else ours["value"] - bound
    return ("holds" if gap >= 0.0 else verdict_of(gap, ours["se"] or 0.0)), number


def window_verdict(claim: Claim, reader: RunReader) -> tuple[ClaimVerdict, str]:
    """On two stretches of time."""
    assert claim.filter is not None
    assert claim.window is not None
    assert claim.against is not None
    names = [metric["name"] for metric in reader.manifest["metrics"]]
    if claim.filter not in reader.manifest["filters"] or claim.metric not in names:
        return "not comparable", ""
    if max(claim.window[1], claim.against[1]) > reader.manifest["steps"]:
        return "not comparable", ""
    results = filter_results(reader, claim.filter, [names.index(claim.metric)])
    ratio, error = window_ratio(results, 0, claim.window, claim.against)
    if math.isnan(error):
        return "not comparable", ""
    return verdict_of(ratio - 1.0, error), f"ratio {significant(ratio, 4)} ± {significant(error, 2)}"


def claims_table(
    claims: tuple[Claim, ...], summaries: Mapping[str, dict[str, Any]], readers: Mapping[str, RunReader]
) -> Table:
    """Every claim with its verdict, for the experiments at hand."""
    columns = [Column("claim", "claim"), Column("numbers", "ours", True), Column("verdict", "verdict")]
    rows, values = [], []
    for claim in claims:
        if claim.experiment not in summaries:
            continue
        if claim.order:
            verdict, numbers = order_verdict(claim, summaries[claim.experiment])
        elif claim.window is not None:
            verdict, numbers = window_verdict(claim, readers[claim.experiment])
        else:
            verdict, numbers = bound_verdict(claim, summaries[claim.experiment])
        rows.append({"claim": claim.text, "numbers": numbers, "verdict": verdict})
        values.append({"experiment": claim.experiment, "metric": claim.metric, "claim": claim.text, "verdict": verdict})
    return Table("Claims in the paper's text", columns, rows, values)

"""Which filter when: choice, numbers of other origins, segments, and the table over time."""

import numpy as np
import pytest

from emt.reports.guide import Candidate, Situation, choice, guide_table
from emt.reports.published import PublishedTable, compare, judge_reference, printed_parts
from emt.reports.segments import segment_number


def of(label, value, cost):
    return Candidate(label, value, 0.1, cost)


@pytest.mark.parametrize(
    ("found", "chosen"),
    [
        ([of("a", 1.0, 9.0), of("b", 1.04, 1.0)], "b"),  # nearly as good and cheaper
        ([of("a", 1.0, 9.0), of("b", 1.06, 1.0)], "a"),  # not as good
        ([of("a", 1.0, 1.2), of("b", 1.04, 1.0)], "a"),  # as cheap
        ([of("a", 1.0, 2.0), of("b", 1.01, 1.0), of("c", 1.02, 1.1)], "b"),
    ],
)
def test_the_cheapest_of_the_good_is_chosen(found, chosen):
    assert choice(found, 0.05).label == chosen


def numbers(value, se=0.1, runs=100):
    return {"value": value, "se": se, "std": 1.0, "median": value, "runs_used": runs}


SUMMARY = {
    "experiment": "p/e",
    "runs": 100,
    "labels": ["a", "b"],
    "metrics": [{"name": "position_rmse", "unit": "L", "over_runs": "pooled", "over_time": "rms"}],
    "filters": {"a": {"position_rmse": numbers(10.0)}, "b": {"position_rmse": numbers(20.0)}},
    "segments": {"a": {"position_rmse": {"turn": numbers(12.0)}}},
}


def test_a_guide_needs_values_and_costs():
    situation = Situation(text="here", experiment="p/e", metric="position_rmse", filters=("a", "b", "lacking"))
    table = guide_table((situation,), {"p/e": SUMMARY}, {"p/e": {"a": 2.0, "b": 1.0}}, {"p/e": "m"})
    assert table is not None
    assert table.rows[0]["use"] == "a"
    assert table.rows[0]["value"] == "10.00 ± 0.10 m"
    assert table.rows[0]["others"] == "b 20.0 (0.50x)"
    assert guide_table((situation,), {"p/e": SUMMARY}, {}, {"p/e": "m"}) is None
    assert guide_table((situation,), {}, {}, {}) is None


def test_a_printed_value_may_have_an_error():
    assert printed_parts("26.09 ± 0.15") == ("26.09", 0.15)
    assert printed_parts("0.758") == ("0.758", None)


@pytest.mark.parametrize(
    ("printed", "verdict"),
    [("10.2 ± 0.1", "agrees"), ("10.45 ± 0.1", "close"), ("10.49 ± 0.01", "close"), ("11.4 ± 0.1", "differs")],
)
def test_references_are_judged_by_combined_errors(printed, verdict):
    assert judge_reference(printed, 100, numbers(10.0)) == verdict


def test_an_error_that_is_not_given_is_ours_scaled_by_runs():
    assert judge_reference("0.30", 100, numbers(0.0, se=0.1)) == "close"
    assert judge_reference("0.30", 4, numbers(0.0, se=0.1)) == "agrees"


@pytest.mark.parametrize(
    ("origin", "value", "verdict"),
    [("published", "10.0", "agrees"), ("unconfirmed", "10.0", "not confirmed"), ("theory", "10.4", "close")],
)
def test_the_verdict_depends_on_the_origin(origin, value, verdict):
    rows = {"a": {"position_rmse": value, "position_rmse[turn]": "12.0", "gw": "1"}}
    table = PublishedTable(title="t", experiment="p/e", runs=100, origin=origin, rows=rows)
    whole, stretch, lacking = compare(table, SUMMARY)
    assert whole.verdict == verdict
    assert stretch.value == 12.0
    assert lacking.verdict == "not comparable"


def test_a_segment_is_a_root_of_means_with_a_jackknife_error():
    rng = np.random.default_rng(0)
    squares = rng.chisquare(2, size=(40, 7))
    sums, counts = squares.reshape(8, 5, 7).sum(axis=1), np.full(8, 5)
    pooled, per_step = (segment_number(sums, counts, rule) for rule in ("pooled", "rms"))
    assert pooled["value"] == pytest.approx(np.sqrt(squares.mean()))
    assert per_step["value"] == pytest.approx(np.sqrt(squares.mean(axis=0)).mean())
    blocks = np.array([np.sqrt(np.delete(squares.reshape(8, 5, 7), k, axis=0).mean()) for k in range(8)])
    assert pooled["se"] == pytest.approx(np.sqrt(7 / 8 * ((blocks - blocks.mean()) ** 2).sum()))
    assert segment_number(sums[:0], counts[:0], "rms")["value"] is None

"""Verdicts on statements in words, and ratios of windows in time."""

import numpy as np
import pytest
from pydantic import ValidationError

from emt.reports.claims import Claim, bound_verdict, order_verdict
from emt.reports.gathering import FilterResults
from emt.reports.summary import window_ratio

BASE = {"text": "t", "experiment": "e", "metric": "m"}


def summary(**filters):
    return {"filters": {label: {"m": {"value": v, "se": se}} for label, (v, se) in filters.items()}}


def claim(**form) -> Claim:
    return Claim.model_validate({**BASE, **form})


def test_a_bound_is_kept_broken_or_undecided():
    at_most = claim(filter="a", at_most=0.1)
    assert bound_verdict(at_most, summary(a=(0.1, 0.0)))[0] == "holds"
    assert bound_verdict(at_most, summary(a=(0.12, 0.02))) == ("undecided", "0.120 ± 0.020")
    assert bound_verdict(at_most, summary(a=(0.2, 0.02)))[0] == "does not hold"
    at_least = claim(filter="a", at_least=0.5)
    assert bound_verdict(at_least, summary(a=(0.6, 0.1)))[0] == "holds"
    assert bound_verdict(at_least, summary(a=(0.02, 0.02)))[0] == "does not hold"
    assert bound_verdict(at_least, summary(b=(0.02, 0.02)))[0] == "not comparable"


def test_an_order_is_as_strong_as_its_weakest_step():
    order = claim(order=["a", "b"])
    assert order_verdict(order, summary(a=(1.0, 0.1), b=(2.0, 0.1)))[0] == "holds"
    assert order_verdict(order, summary(a=(1.0, 0.1), b=(1.1, 0.1)))[0] == "undecided"
    assert order_verdict(order, summary(a=(2.0, 0.1), b=(1.0, 0.1)))[0] == "does not hold"


@pytest.mark.parametrize(
    "form",
    [
        {},
        {"order": ["a"]},
        {"filter": "a"},
        {"at_most": 1.0},
        {"filter": "a", "at_most": 1.0, "order": ["a", "b"]},
        {"filter": "a", "window": [1, 2]},
        {"filter": "a", "order": ["a", "b"]},
    ],
    ids=str,
)
def test_a_claim_has_one_form(form):
    with pytest.raises(ValidationError):
        claim(**form)


def test_the_ratio_of_windows_and_its_error():
    """Against the spread of ratios over repetitions."""
    rng = np.random.default_rng(0)

    def ratio(n_blocks=40):
        sums = np.concatenate([rng.gamma(4.0, 1.0, (n_blocks, 50)), rng.gamma(4.0, 2.0, (n_blocks, 50))], axis=1)
        none = np.zeros(0)
        results = FilterResults(none, sums[:, :, None], np.ones(n_blocks))
        return window_ratio(results, 0, (51, 100), (1, 50))

    found = np.array([ratio() for _ in range(300)])
    assert found[:, 0].mean() == pytest.approx(2.0, abs=0.02)
    assert found[:, 0].std() == pytest.approx(found[:, 1].mean(), rel=0.15)

"""Yao, Saltus and Dani 2020 at reduced size against an independent implementation of the same settings."""

from functools import cache

import numpy as np
import pytest

from emt.config.load import load_experiment
from emt.metrics.base import find_metric
from emt.tuning.scoring import Batch
from emt.tuning.trial import build_trial

RUNS = 104
METRICS = ("position_rmse", "velocity_rmse", "iou")

# filter: (numbers, tolerances) of position, velocity and IoU; numbers of 200 (B, C) or 300 runs
INDEPENDENT = {
    "linear": {
        "ukf_cv": ((1.64, 0.22, 0.695), (0.12, 0.03, 0.006)),
        "lan_li": ((1.55, 0.39, 0.806), (0.1, 0.05, 0.01)),
    },
    "coordinated_turn": {
        "ukf_ct": ((1.72, 0.34, 0.700), (0.12, 0.03, 0.006)),
        "lan_li": ((1.55, 0.88, 0.812), (0.1, 0.05, 0.01)),
    },
    "complex": {
        "ukf_imm": ((16.20, 0.84, 0.645), (0.6, 0.05, 0.006)),
        "ukf_ct": ((16.36, 1.01, 0.647), (0.6, 0.05, 0.006)),
        "lan_li_imm": ((29.61, 5.94, 0.706), (1.0, 0.2, 0.006)),
    },
    "car": {"ukf_imm": ((7.16, None, 0.695), (0.4, None, 0.008)), "ukf_ct": ((6.79, None, 0.715), (0.4, None, 0.008))},
}
LOOSE = {
    ("linear", "ukf_cv", "{diagonal: [10, 20, 10]}"): (1.83, 0.796),
    ("coordinated_turn", "ukf_ct", "{diagonal: [100, 100, 100]}"): (2.25, 0.775),
}


@cache
def scores(experiment: str, label: str, *overrides: str):
    """Every metric of one filter on the first runs."""
    loaded = load_experiment(f"yao2020/{experiment}", overrides)
    batch = Batch(loaded, label, [find_metric(name) for name in METRICS], 0, RUNS)
    return batch.score([build_trial(loaded.experiment, label)])[0]


@pytest.mark.slow
@pytest.mark.parametrize("experiment", INDEPENDENT)
def test_agrees_with_an_independent_implementation(experiment):
    """Within the stated tolerance, widened by three standard errors of the reduced number of runs."""
    for label, (numbers, tolerances) in INDEPENDENT[experiment].items():
        for name, score, theirs, tolerance in zip(METRICS, scores(experiment, label), numbers, tolerances, strict=True):
            if theirs is not None:
                assert abs(score.value - theirs) <= tolerance + 3.0 * score.error, (label, name, score.value)


@pytest.mark.slow
@pytest.mark.parametrize("experiment", LOOSE, ids=lambda case: case[0])
def test_a_loose_prior_of_the_shape(experiment):
    name, label, cov = experiment
    position, _, iou = scores(name, label, f"filters.{label}.moment_cov={cov}")
    theirs_position, theirs_iou = LOOSE[experiment]
    assert position.value == pytest.approx(theirs_position, abs=0.12 + 3.0 * position.error)
    assert iou.value == pytest.approx(theirs_iou, abs=0.006 + 3.0 * iou.error)


@pytest.mark.slow
def test_orderings_on_the_complex_trajectory():
    imm, ct, matrix = (scores("complex", label) for label in ("ukf_imm", "ukf_ct", "lan_li_imm"))
    assert max(imm[0].value, ct[0].value) < 0.7 * matrix[0].value
    assert max(imm[1].value, ct[1].value) < 0.3 * matrix[1].value
    assert imm[1].value < ct[1].value
    assert matrix[2].value > max(imm[2].value, ct[2].value) + 0.03


@pytest.mark.slow
@pytest.mark.parametrize(("experiment", "label"), [("coordinated_turn", "ukf_ct"), ("complex", "lan_li_imm")])
def test_single_precision_agrees_within_monte_carlo_error(experiment, label):
    for double, single in zip(
        scores(experiment, label), scores(experiment, label, "monte_carlo.dtype=float32"), strict=True
    ):
        assert single.failed == double.failed == 0
        assert abs(single.value - double.value) < 3.0 * double.error
        assert np.isfinite(single.shares).all()

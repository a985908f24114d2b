"""Errors of parameters, mirrored runs, association and the distance of whole objects."""

import jax.numpy as jnp
import numpy as np
import pytest

from emt.conformance.sampling_kinds import ARM
from emt.metrics.base import Ending, find_metric
from emt.types import Articulated, Ellipse, Estimate, Info, Truth

STATE = np.array([1.0, 1.2, 0.01, 0.8, 1.9, 0.02, 1.1, 0.03])
ZERO = Info(jnp.asarray(0.0), jnp.asarray(0.0), jnp.asarray(0))


def pair(**changes):
    """(estimate, truth) that differ in some entries of the state."""
    mean = STATE.copy()
    for name, change in changes.items():
        mean[ARM.state.index(name)] += change
    estimate = Estimate(jnp.asarray(mean), jnp.eye(8), Articulated(jnp.asarray(mean), ARM))
    return estimate, Truth(jnp.asarray(STATE), Articulated(jnp.asarray(STATE), ARM))


def value(name, estimate, truth, info=ZERO):
    return float(find_metric(name).per_step(estimate, truth, info))


def test_errors_of_parameters():
    estimate, truth = pair(length_a=-0.2, alpha_a=2 * np.pi + 0.1, alpha_c=4 * np.pi - 0.3, alpha_b_rate=0.5)
    assert value("length_a_error", estimate, truth) == pytest.approx(0.2)
    assert value("alpha_a_error", estimate, truth) == pytest.approx(0.1)
    assert value("alpha_c_folded_error", estimate, truth) == pytest.approx(0.3)
    assert value("alpha_b_rate_error", estimate, truth) == pytest.approx(0.5)
    assert value("length_a_estimate", estimate, truth) == pytest.approx(0.8)
    assert value("shape_distance", *pair()) == pytest.approx(0.0, abs=1e-12)


def test_the_folded_error_does_not_see_the_sign():
    estimate, truth = pair(alpha_c=-2.4)  # 1.1 to -1.3
    assert value("alpha_c_folded_error", estimate, truth) == pytest.approx(0.2)
    assert value("mirrored", estimate, truth) == 1.0
    assert value("mirrored", *pair(alpha_c=-1.0)) == 0.0
    assert float(find_metric("mirrored").at_end(Ending(estimate, truth, jnp.asarray(0.0)))) == 1.0
    mirrored, _ = pair(alpha_c=-2.2)
    assert value("shape_distance", mirrored, truth) == pytest.approx(0.0, abs=1e-9)


def test_names_and_units_follow_the_object():
    estimate, _ = pair()
    assert find_metric("alpha_c_folded_error").applies_to(estimate)
    assert not find_metric("alpha_a_folded_error").applies_to(estimate)
    assert not find_metric("nothing_error").applies_to(estimate)
    assert not find_metric("iou").applies_to(estimate)
    assert [find_metric(f"{n}_error").unit_of(estimate) for n in ("length_a", "alpha_a", "alpha_a_rate")] == [
        "L",
        "rad",
        "rad/s",
    ]
    ellipse = Estimate(jnp.zeros(4), jnp.eye(4), Ellipse(jnp.ones(2), jnp.asarray(0.0)))
    for name in ("alpha_a_error", "mirrored", "shape_distance", "hub_association"):
        assert not find_metric(name).applies_to(ellipse)


def test_the_distance_of_objects_grows_with_their_gap():
    small, large = (value("shape_distance", *pair(length_a=g)) for g in (0.05, 0.2))
    assert 0.0 < small < 0.05
    assert small < large < 0.2


def test_association_counts_the_points_of_its_component():
    estimate, truth = pair()
    confusion = np.zeros((5, 5))
    confusion[1] = [0.0, 1.5, 0.5, 0.0, 0.0]  # two points of the upper arm
    info = ZERO._replace(confusion=jnp.asarray(confusion))
    metric = find_metric("upper_association")
    assert float(metric.per_step(estimate, truth, info)) == pytest.approx(0.75)
    assert float(metric.counts(estimate, truth, info)) == pytest.approx(2.0)
    assert float(find_metric("hub_association").counts(estimate, truth, info)) == 0.0
    assert value("hub_association", estimate, truth, info) == 0.0

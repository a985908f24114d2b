"""Metrics against slow references, axioms and known values."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import emt.metrics.catalogue  # noqa: F401 - fills the catalogue
from emt.metrics.base import METRICS, find_metric, has
from emt.metrics.iou import iou
from emt.metrics.kinematic import (
    nees,
    orientation_error_squared_deg,
    position_error_squared,
    velocity_error_squared,
    wrapped_orientation_error_squared_deg,
)
from emt.metrics.wasserstein import (
    center_distance_squared,
    gaussian_wasserstein,
    gaussian_wasserstein_squared,
    shape_distance_squared,
)
from emt.registry import UnknownName
from emt.shapes.ellipse import equivalent_ellipse
from emt.types import Ellipse, Estimate, Info, StarConvex, Truth
from tests.filters.cases import FAST_COMPILE
from tests.reference import gaussian_wasserstein as reference

ANGLE, AXIS, PLACE = st.floats(-10.0, 10.0), st.floats(0.01, 100.0), st.floats(-100.0, 100.0)
ELLIPSE = st.tuples(PLACE, PLACE, AXIS, AXIS, ANGLE)
"""x, y, semi-axes, orientation."""


def estimate_of(e, velocity=(0.0, 0.0), cov=None) -> Estimate:
    x, y, a, b, angle = map(float, e)
    mean = jnp.array([x, y, *velocity])
    return Estimate(
        mean, jnp.eye(4) if cov is None else jnp.asarray(cov), Ellipse(jnp.array([a, b]), jnp.asarray(angle))
    )


def truth_of(e, velocity=(0.0, 0.0)) -> Truth:
    x, y, a, b, angle = map(float, e)
    return Truth.moving(jnp.array([x, y]), jnp.array(velocity, float), Ellipse(jnp.array([a, b]), jnp.asarray(angle)))


def matrix(e):
    return reference.extent_matrix(e[4], np.array(e[2:4]))


gw_squared, gw = jax.jit(gaussian_wasserstein_squared), jax.jit(gaussian_wasserstein)
overlap = jax.jit(iou, compiler_options=FAST_COMPILE)


@given(ELLIPSE, ELLIPSE)
def test_wasserstein_is_the_matrix_formula(e1, e2):
    estimate, truth = estimate_of(e1), truth_of(e2)
    scale = np.trace(matrix(e1)) + np.trace(matrix(e2))
    centre = (e1[0] - e2[0]) ** 2 + (e1[1] - e2[1]) ** 2
    assert float(center_distance_squared(estimate, truth)) == pytest.approx(centre, rel=1e-12, abs=1e-300)
    # the reference takes matrix roots and loses half the digits where the extents are nearly equal
    expected = reference.extent_term(matrix(e2), matrix(e1))
    assert float(shape_distance_squared(estimate, truth)) == pytest.approx(expected, abs=1e-7 * scale)
    both = float(gw_squared(estimate, truth))
    assert both == pytest.approx(centre + expected, abs=1e-7 * (scale + centre))
    assert float(gw(estimate, truth)) == pytest.approx(np.sqrt(both), rel=1e-14)


def test_wasserstein_against_fifty_digits(golden):
    pairs = json.loads((golden / "gaussian_wasserstein.json").read_text(encoding="utf-8"))["pairs"]
    assert len(pairs) > 5
    for pair in pairs:
        e1, e2 = pair["e1"], pair["e2"]
        scale = np.sum((np.array(e1[:2]) - e2[:2]) ** 2) + np.trace(matrix(e1)) + np.trace(matrix(e2))
        assert abs(float(gw_squared(estimate_of(e1), truth_of(e2))) - pair["gw_squared"]) <= 1e-14 * scale, pair["kind"]


@given(ELLIPSE)
def test_identical_ellipses_have_distance_zero_exactly(e):
    assert float(gw(estimate_of(e), truth_of(e))) == 0.0


@given(ELLIPSE, ELLIPSE, ELLIPSE)
def test_wasserstein_is_a_metric(e1, e2, e3):
    d12, d23, d13 = (float(gw(estimate_of(a), truth_of(b))) for a, b in ((e1, e2), (e2, e3), (e1, e3)))
    assert d12 >= 0.0
    assert d12 == pytest.approx(float(gw(estimate_of(e2), truth_of(e1))), rel=1e-9, abs=1e-9)
    assert d13 <= (d12 + d23) * (1.0 + 1e-9) + 1e-9


def test_wasserstein_of_circles_is_known():
    """|c - c'|² + 2 (r - r')²."""
    squared = float(gw_squared(estimate_of((3.0, 4.0, 2.0, 2.0, 0.7)), truth_of((0.0, 0.0, 5.0, 5.0, -0.2))))
    assert squared == pytest.approx(25.0 + 2.0 * 9.0, rel=1e-14)


def test_tiny_differences_are_not_lost():
    """Where root formulas return noise of 1e-8: axes 10 and 10 + 1e-9."""
    found = float(gw(estimate_of((0.0, 0.0, 10.0, 4.0, 0.0)), truth_of((0.0, 0.0, 10.0 + 1e-9, 4.0, 0.0))))
    assert found == pytest.approx(1e-9, rel=1e-5)


def test_kinematic_errors():
    estimate, truth = (
        estimate_of((3.0, 4.0, 2.0, 1.0, 0.5), (1.0, 1.0)),
        truth_of((0.0, 0.0, 2.0, 1.0, 0.4), (4.0, 5.0)),
    )
    assert float(position_error_squared(estimate, truth)) == 25.0
    assert float(velocity_error_squared(estimate, truth)) == 25.0
    assert float(orientation_error_squared_deg(estimate, truth)) == pytest.approx(np.degrees(0.1) ** 2, rel=1e-12)


@pytest.mark.parametrize(
    ("axes", "angle", "raw", "wrapped"),
    [
        ((2.0, 1.0), np.pi, 180.0, 0.0),
        ((2.0, 1.0), -2.0 * np.pi, 360.0, 0.0),
        ((1.0, 2.0), np.pi / 2, 90.0, 0.0),
        ((2.0, 1.0), np.pi / 2, 90.0, 90.0),
        ((2.0, 1.0), 0.75 * np.pi, 135.0, 45.0),
        ((1.0, 2.0), 0.0, 0.0, 90.0),
        ((2.0, 1.0), 10.0 * np.pi + 0.1, 1800.0 + np.degrees(0.1), np.degrees(0.1)),
    ],
)
def test_orientation_raw_and_wrapped(axes, angle, raw, wrapped):
    """Raw differences are not wrapped; wrapped ones are between the longer axes, modulo half a turn."""
    estimate, truth = estimate_of((0.0, 0.0, *axes, angle)), truth_of((0.0, 0.0, 2.0, 1.0, 0.0))
    assert float(orientation_error_squared_deg(estimate, truth)) == pytest.approx(raw**2, rel=1e-9)
    assert np.sqrt(float(wrapped_orientation_error_squared_deg(estimate, truth))) == pytest.approx(wrapped, abs=1e-9)


@given(st.integers(0, 10_000))
def test_nees_is_the_quadratic_form(seed):
    rng = np.random.default_rng(seed)
    factor, error = rng.normal(size=(4, 4)), rng.normal(size=4)
    scale = np.array([30.0, 10.0, 2.0, 0.5])
    cov = (factor @ factor.T + 0.1 * np.eye(4)) * np.outer(scale, scale)
    estimate = estimate_of((*error[:2], 1.0, 1.0, 0.0), tuple(error[2:]), cov)
    expected = error @ np.linalg.solve(cov, error)
    assert float(nees(estimate, truth_of((0.0, 0.0, 1.0, 1.0, 0.0)))) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("e", [(0.0, 0.0, 6.0, 2.5, 0.4), (5.0, -3.0, 2.0, 2.0, 0.0), (0.0, 0.0, 1.0, 3.0, 2.0)])
def test_outline_of_an_ellipse_stands_for_that_ellipse(e):
    """As a star-convex shape about its own centre, and about another point inside it."""
    _, _, a, b, angle = e
    phi = 2.0 * np.pi * np.arange(720) / 720
    for inside in ((0.0, 0.0), (0.3 * a, -0.2 * b)):
        x, y = np.array(inside)
        # the outline seen from (x, y) in the body frame
        u, v = np.cos(phi), np.sin(phi)
        p, q, r = (u / a) ** 2 + (v / b) ** 2, x * u / a**2 + y * v / b**2, (x / a) ** 2 + (y / b) ** 2 - 1.0
        radii = (-q + np.sqrt(q**2 - p * r)) / p
        offset, found = equivalent_ellipse(StarConvex(jnp.asarray(radii), jnp.asarray(angle)))
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        np.testing.assert_allclose(np.asarray(offset), turn @ -np.array(inside), atol=1e-9)
        ours = reference.extent_matrix(float(found.orientation), np.asarray(found.semi_axes))
        np.testing.assert_allclose(ours, reference.extent_matrix(angle, np.array([a, b])), rtol=1e-9, atol=1e-9)
        # so every metric sees the ellipse
        centre = np.array(e[:2]) + turn @ np.array(inside)
        shape = StarConvex(jnp.asarray(radii), jnp.asarray(angle))
        estimate = Estimate(jnp.array([*centre, 0.0, 0.0]), jnp.eye(4), shape)
        assert float(gw(estimate, truth_of(e))) == pytest.approx(0.0, abs=1e-8)
        assert float(overlap(estimate, truth_of(e))) == pytest.approx(1.0, abs=1e-8)


def test_outline_of_a_cusp_does_not_break():
    """Radii of zero, as a filter may report: no area, no moments, nothing that is not a number."""
    offset, found = equivalent_ellipse(StarConvex(jnp.zeros(12), jnp.asarray(0.0)))
    assert np.isfinite(np.asarray(offset)).all()
    assert (np.asarray(found.semi_axes) == 0.0).all()


def test_intersection_over_union():
    one = (0.0, 0.0, 3.0, 1.0, 0.3)
    assert float(overlap(estimate_of(one), truth_of(one))) == pytest.approx(1.0, abs=1e-12)
    assert float(overlap(estimate_of(one), truth_of((50.0, 0.0, 3.0, 1.0, 0.3)))) == 0.0
    assert float(overlap(estimate_of((0.0, 0.0, 1.5, 0.5, 0.3)), truth_of(one))) == pytest.approx(0.25, rel=1e-12)
    assert float(overlap(estimate_of((0.0, 0.0, 1.0, 3.0, 0.3 + np.pi / 2)), truth_of(one))) == pytest.approx(
        1.0, abs=1e-12
    )


def test_catalogue_is_complete_and_described():
    names = {
        "gw",
        "gw_std",
        "gw_center_sq",
        "gw_extent_sq",
        "position_rmse",
        "velocity_rmse",
        "orientation_rmse_deg",
        "orientation_rmse_deg_std",
        "orientation_rmse_wrapped_deg",
        "nees",
        "iou",
    }
    assert names <= set(METRICS)
    for name, metric in METRICS.items():
        assert metric.name == name
        assert metric.definition
        assert metric.unit
        truth = truth_of((0.0, 0.0, 3.0, 1.0, 0.3))
        info = Info(*map(jnp.asarray, (-3.0, 2.0, 0)))
        if not has(metric, estimate_of((0.5, 0.0, 3.0, 1.0, 0.3)), info):
            continue
        value = metric.per_step(estimate_of((0.5, 0.0, 3.0, 1.0, 0.3)), truth, info)
        assert value.shape == ()
        assert np.isfinite(float(value))


def of_each(metric, e1, e2):
    info = Info(jnp.asarray(0.0), jnp.asarray(0.0), jnp.asarray(0))
    return float(jax.jit(metric.per_step)(estimate_of(e1), truth_of(e2), info))


@given(ELLIPSE, ELLIPSE)
def test_the_soft_overlap_is_a_share_like_the_overlap(e1, e2):
    soft = METRICS["soft_iou"]
    value = of_each(soft, e1, e2)
    assert 0.0 <= value <= 1.0 + 1e-12
    assert value == pytest.approx(of_each(soft, e2, e1), rel=1e-9, abs=1e-300)
    assert of_each(soft, e1, e1) == pytest.approx(1.0, abs=1e-9)


def test_the_soft_overlap_is_the_integral_of_bumps():
    """2s / (1 + s²) for similar ellipses of area ratio s; for parted ones by summation over a grid."""
    for s in (0.3, 1.0, 2.5):
        value = of_each(METRICS["soft_iou"], (0, 0, 4 * s**0.5, 2 * s**0.5, 0.4), (0, 0, 4, 2, 0.4))
        assert value == pytest.approx(2 * s / (1 + s * s), rel=1e-12)
    x, y = np.meshgrid(np.linspace(-12, 12, 481), np.linspace(-12, 12, 481))

    def bump(cx, cy, a, b, angle):
        u, v = (x - cx) * np.cos(angle) + (y - cy) * np.sin(angle), (y - cy) * np.cos(angle) - (x - cx) * np.sin(angle)
        return np.exp(-2.0 * (u * u / a**2 + v * v / b**2))

    e1, e2 = (0.5, -0.2, 3.0, 1.0, 0.3), (-0.4, 0.6, 2.0, 1.5, 1.2)
    f, g = bump(*e1), bump(*e2)
    expected = (f * g).sum() / ((f * f).sum() + (g * g).sum() - (f * g).sum())
    assert of_each(METRICS["soft_iou"], e1, e2) == pytest.approx(expected, rel=1e-9)


def test_a_metric_of_a_mode_belongs_to_filters_with_that_mode():
    metric = find_metric("mode_ct_probability")
    estimate = estimate_of((0.0, 0.0, 1.0, 1.0, 0.0))
    assert not metric.applies_to(estimate)
    assert metric.applies_to(estimate._replace(modes={"ct": jnp.asarray(0.25)}))
    assert not metric.applies_to(estimate._replace(modes={"cv": jnp.asarray(0.25)}))
    with pytest.raises(UnknownName, match="mode_NAME_probability"):
        find_metric("mode_probability")

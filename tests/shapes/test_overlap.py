"""Overlap of ellipses against stored 50-digit values, polygon clipping and geometric identities."""

import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely import Polygon

from emt.shapes.overlap import ellipse_intersection_area, ellipse_iou

GOLDEN = Path(__file__).parents[3] / "shared" / "golden" / "ellipse_iou.json"
IOU = jax.jit(jax.vmap(ellipse_iou))
AREA = jax.jit(jax.vmap(ellipse_intersection_area))


def _arguments(first, second, dtype=np.float64):
    """Rows [cx, cy, a, b, theta] as batched arguments of the overlap functions."""
    split = []
    for rows in (np.atleast_2d(first), np.atleast_2d(second)):
        rows = jnp.asarray(rows, dtype)
        split += [rows[:, :2], rows[:, 2:4], rows[:, 4]]
    return split


def _iou(first, second, dtype=np.float64):
    return np.asarray(IOU(*_arguments(first, second, dtype)), np.float64)


def _area(first, second):
    return np.asarray(AREA(*_arguments(first, second)))


def _boundary(ellipse, t):
    cx, cy, a, b, theta = ellipse
    u, v = a * np.cos(t), b * np.sin(t)
    cosine, sine = np.cos(theta), np.sin(theta)
    return np.stack([cx + cosine * u - sine * v, cy + sine * u + cosine * v], -1)


def _polygon_iou(first, second, vertices=8192):
    """IoU by clipping of polygons with the area of the ellipses, relative to the first center."""
    t = 2 * np.pi / vertices * np.arange(vertices)
    stretch = np.sqrt(2 * np.pi / vertices / np.sin(2 * np.pi / vertices))
    shift, scale = np.array([*first[:2], 0, 0, 0]), np.array([1, 1, stretch, stretch, 1])
    polygons = [Polygon(_boundary((e - shift) * scale, t)) for e in (first, second)]
    intersection = polygons[0].intersection(polygons[1]).area
    return intersection / (np.pi * (first[2] * first[3] + second[2] * second[3]) - intersection)


def _random(rng, n, spread=8.0, decades=1.5):
    return np.column_stack(
        [rng.normal(0, spread, (n, 2)), 10 ** rng.uniform(0, decades, (n, 2)), rng.uniform(-7, 7, n)]
    )


def _tangent(rng, n, side, decades=1.5):
    """Pairs with a common point and normals that agree (`side` = 1) or oppose each other (-1)."""
    first, second = _random(rng, n, decades=decades), _random(rng, n, decades=decades)
    t = rng.uniform(0, 2 * np.pi, n)
    for one, two, angle in zip(first, second, t, strict=True):
        nx, ny = np.cos(angle) / one[2], np.sin(angle) / one[3]
        turn = one[4] - two[4]
        mx, my = np.cos(turn) * nx - np.sin(turn) * ny, np.sin(turn) * nx + np.cos(turn) * ny
        other = np.arctan2(side * my * two[3], side * mx * two[2])
        two[:2] += _boundary(one, angle) - _boundary(two, other)
    return first, second


def _near(rng, n):
    first = _random(rng, n)
    size = 10 ** rng.uniform(-15, -1, (n, 1))
    lengths = np.column_stack([first[:, 2:4], first[:, 2:4], np.ones(n)])
    return first, first + size * lengths * rng.normal(size=(n, 5))


def _needles(rng, n):
    long = 10 ** rng.uniform(0, 3, (n, 2))
    first, second = _random(rng, n, 1.0), _random(rng, n, 1.0)
    first[:, 2:4] = np.column_stack([long[:, 0], long[:, 0] / 1000])
    second[:, 2:4] = np.column_stack([long[:, 1], long[:, 1] / 1000])
    parallel = np.arange(n) % 2 == 0
    second[parallel, :2] = first[parallel, :2] + rng.normal(size=(parallel.sum(), 2)) * first[parallel, 3:4]
    second[parallel, 4] = first[parallel, 4] + rng.normal(size=parallel.sum()) * 1e-3
    return first, second


def _four_points(rng, n):
    first = _random(rng, n)
    first[:, 2] = first[:, 3] * rng.uniform(1.5, 8, n)
    second = first.copy()
    second[:, :2] += 0.1 * rng.normal(size=(n, 2)) * first[:, 3:4]
    second[:, 4] += np.pi / 2 + 0.5 * rng.normal(size=n)
    return first, second


def _coaxial(rng, n):
    first, second = _random(rng, n), _random(rng, n)
    second[:, [0, 1, 4]] = first[:, [0, 1, 4]]
    shift = np.where(np.arange(n) % 3 == 0, 0.0, rng.uniform(-1, 1, n)) * (first[:, 2] + second[:, 2])
    second[:, :2] += shift[:, None] * np.stack([np.cos(first[:, 4]), np.sin(first[:, 4])], -1)
    circles = np.arange(n) % 4 == 0
    first[circles, 3], second[circles, 3] = first[circles, 2], second[circles, 2]
    return first, second


FAMILIES = {
    "random": lambda rng: (_random(rng, 200), _random(rng, 200)),
    "inner tangent": lambda rng: _tangent(rng, 60, 1),
    "outer tangent": lambda rng: _tangent(rng, 60, -1),
    "elongated tangent": lambda rng: _tangent(rng, 40, 1, decades=3.0),
    "near coincident": lambda rng: _near(rng, 80),
    "needles": lambda rng: _needles(rng, 60),
    "four points": lambda rng: _four_points(rng, 60),
    "coaxial": lambda rng: _coaxial(rng, 60),
}


@pytest.mark.skipif(not GOLDEN.exists(), reason="stored 50-digit values are not available")
def test_stored_values():
    data = json.loads(GOLDEN.read_text())
    pairs = data["pairs"]
    first, second = (np.array([pair[key] for pair in pairs]) for key in ("e1", "e2"))
    tolerance = min(1e-6, *data["tolerance"]["float64"].values())
    np.testing.assert_allclose(_iou(first, second), [p["iou"] for p in pairs], rtol=0, atol=tolerance)
    union = np.pi * (first[:, 2] * first[:, 3] + second[:, 2] * second[:, 3])
    error = _area(first, second) - [p["intersection"] for p in pairs]
    assert np.max(np.abs(error) / union) < tolerance
    single = np.abs(_iou(first, second, np.float32) - [p["iou"] for p in pairs])
    assert np.median(single) < 1e-5


@pytest.mark.parametrize("family", FAMILIES)
def test_polygon_clipping(family):
    first, second = FAMILIES[family](np.random.default_rng(20))
    expected = [_polygon_iou(one, two) for one, two in zip(first, second, strict=True)]
    np.testing.assert_allclose(_iou(first, second), expected, rtol=0, atol=1e-6)


_number = st.floats(-20, 20).map(lambda v: round(v, 6))
_semi_axis = st.floats(0.02, 20)
_ellipse = st.tuples(_number, _number, _semi_axis, _semi_axis, st.floats(-7, 7)).map(np.array)


@settings(deadline=None)
@given(first=_ellipse, second=_ellipse)
def test_symmetric_and_bounded(first, second):
    value, area = _iou(first, second), _area(first, second)
    np.testing.assert_allclose(value, _iou(second, first), rtol=0, atol=1e-9)
    assert 0 <= value[0] <= 1
    smaller = np.pi * min(first[2] * first[3], second[2] * second[3])
    assert 0 <= area[0] <= smaller * (1 + 1e-12)


@settings(deadline=None)
@given(
    first=_ellipse,
    second=_ellipse,
    angle=st.floats(-4, 4),
    shift=st.tuples(_number, _number),
    scale=st.floats(1e-3, 1e3),
)
def test_invariant_under_similarity(first, second, angle, shift, scale):
    cosine, sine = np.cos(angle), np.sin(angle)
    moved = []
    for cx, cy, a, b, theta in (first, second):
        x, y = cosine * cx - sine * cy + shift[0], sine * cx + cosine * cy + shift[1]
        moved.append(np.array([scale * x, scale * y, scale * a, scale * b, theta + angle]))
    np.testing.assert_allclose(_iou(*moved), _iou(first, second), rtol=0, atol=1e-8)
    union = np.pi * (first[2] * first[3] + second[2] * second[3])
    np.testing.assert_allclose(_area(*moved) / scale**2, _area(first, second), rtol=0, atol=1e-8 * union)


@settings(deadline=None)
@given(ellipse=_ellipse, size=st.floats(-16, -3), noise=st.tuples(*[st.floats(-1, 1)] * 4))
def test_identical_and_nearly_identical(ellipse, size, noise):
    cx, cy, a, b, theta = ellipse
    np.testing.assert_allclose(_iou(ellipse, ellipse), 1, rtol=0, atol=1e-12)
    same = np.array([[cx, cy, a, b, theta + np.pi], [cx, cy, b, a, theta + np.pi / 2]])
    np.testing.assert_allclose(_iou(np.stack([ellipse] * 2), same), 1, rtol=0, atol=1e-6)
    step = 10.0**size * min(a, b)
    near = ellipse + step * np.array([*noise, 0.0])
    assert _iou(ellipse, near)[0] >= 1 - 8 * 10.0**size - 1e-6


@settings(deadline=None)
@given(outer=_ellipse, ratio=st.floats(0.01, 1), angle=st.floats(-4, 4), place=st.floats(0, 1))
def test_contained(outer, ratio, angle, place):
    cx, cy, a, b, theta = outer
    inner = np.array([cx, cy, ratio * a, ratio * b, theta])
    inner[:2] = _boundary([cx, cy, place * (1 - ratio) * a, place * (1 - ratio) * b, theta], angle)
    np.testing.assert_allclose(_iou(outer, inner), ratio**2, rtol=0, atol=1e-9)
    np.testing.assert_allclose(_area(outer, inner), np.pi * ratio**2 * a * b, rtol=1e-8)


def test_vectorised_equals_loop():
    rng = np.random.default_rng(3)
    first, second = _random(rng, 40), _random(rng, 40)
    arguments = _arguments(first, second)
    for function, batched in ((ellipse_iou, IOU), (ellipse_intersection_area, AREA)):
        single = jax.jit(function)
        loop = [single(*(column[k] for column in arguments)) for k in range(40)]
        np.testing.assert_allclose(batched(*arguments), np.array(loop), rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_finite_for_extreme_inputs(dtype):
    rng = np.random.default_rng(4)
    n, decades = 4000, 6 if dtype == np.float32 else 60
    values = []
    for _ in range(2):
        center = rng.choice([0.0, 1.0, -1e6], (n, 2)) * 10 ** rng.uniform(-6, 3, (n, 2))
        axes = 10 ** rng.uniform(-decades, decades, (n, 2))
        values.append(np.column_stack([center, axes, rng.choice([0, np.pi / 4, np.pi / 2, -7.0, 100.0], n)]))
    values[1][::3, :2] = values[0][::3, :2]
    values[1][::5, 2:] = values[0][::5, 2:]
    iou, area = IOU(*_arguments(*values, dtype)), AREA(*_arguments(*values, dtype))
    assert iou.dtype == area.dtype == dtype
    assert np.all(np.isfinite(iou))
    assert np.all((iou >= 0) & (iou <= 1))
    assert np.all(np.isfinite(area))
    assert np.all(area >= 0)


def test_far_from_the_origin():
    rng = np.random.default_rng(5)
    first, second = np.round(_random(rng, 100), 3), np.round(_random(rng, 100), 3)
    shift = np.array([1e6, -2e6, 0, 0, 0])
    np.testing.assert_allclose(_iou(first + shift, second + shift), _iou(first, second), rtol=0, atol=1e-8)

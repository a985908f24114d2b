"""Deterministic samples: distances and their gradients, moments, and the cache."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad

from emt.sampling import lcd, rules
from emt.sampling.lcd import parts, standardised, symmetric_set, widest
from emt.sampling.rules import lcd_set, standard_points


@pytest.fixture
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("EMT_CACHE", str(tmp_path))
    return tmp_path / "lcd"


@pytest.mark.parametrize("dimension", [1, 2, 5])
def test_parts_against_adaptive_quadrature(dimension):
    points, last = np.random.default_rng(dimension).normal(size=(4, dimension)), widest(dimension)
    ours = parts(points)

    def integral(f):
        return quad(f, 0, last, epsabs=1e-12, epsrel=1e-12, limit=400)[0]

    half = 0.5 * dimension
    assert ours.normal == pytest.approx(integral(lambda b: b * (b * b / (1 + b * b)) ** half), rel=1e-10)
    mixed = [
        integral(lambda b, r=r: b * (2 * b * b / (1 + 2 * b * b)) ** half * np.exp(-r / (2 * (1 + 2 * b * b))))
        for r in (points**2).sum(axis=1)
    ]
    assert ours.mixed == pytest.approx(np.mean(mixed), rel=1e-10)
    squares = ((points[:, None] - points[None]) ** 2).sum(axis=-1).ravel()
    among = [integral(lambda b, s=s: b * np.exp(-s / (4 * b * b)) if b > 0 else 0.0) for s in squares]
    assert ours.points == pytest.approx(np.mean(among), rel=1e-9)


@pytest.mark.parametrize("count", [10, 11])
def test_half_of_a_symmetric_set_tells_its_distance_and_gradient(count):
    rng = np.random.default_rng(count)
    half, other = rng.normal(size=(2, 5, 3))

    def whole(half):
        return parts(lcd.mirrored(half, count)).distance

    value, slope = lcd.of_half(half, count)
    assert value - lcd.of_half(other, count)[0] == pytest.approx(whole(half) - whole(other), rel=1e-11)
    for i, j in [(0, 0), (2, 1), (4, 2)]:
        move = np.zeros_like(half)
        move[i, j] = 1e-5
        difference = (lcd.of_half(half + move, count)[0] - lcd.of_half(half - move, count)[0]) / 2e-5
        assert slope[i, j] == pytest.approx(difference, rel=1e-7)


def test_the_distance_does_not_see_rotations():
    rng = np.random.default_rng(2)
    points, turn = rng.normal(size=(7, 3)), np.linalg.qr(rng.normal(size=(3, 3)))[0]
    assert parts(points @ turn).distance == pytest.approx(parts(points).distance, rel=1e-9)


@pytest.mark.parametrize(("dimension", "count"), [(1, 2), (1, 5), (2, 7), (3, 8)])
def test_sets_are_symmetric_near_and_standard(dimension, count):
    points = symmetric_set(dimension, count, restarts=2)
    assert points.shape == (count, dimension)
    np.testing.assert_array_equal(points[0 : count - 1 : 2], -points[1:count:2])
    assert count % 2 == 0 or not points[-1].any()
    standard = standardised(points)
    np.testing.assert_allclose(standard.T @ standard / count, np.eye(dimension), atol=1e-12)
    assert 0.0 < parts(points).distance <= parts(standard).distance
    others = [standardised(lcd.mirrored(rng.normal(size=(count // 2, dimension)), count))
              for rng in map(np.random.default_rng, range(5))]  # fmt: skip
    assert dimension == 1 or parts(standard).distance < min(parts(other).distance for other in others)


def test_of_equally_good_sets_the_first_is_taken(monkeypatch):
    """Not the one that rounding favours."""
    points, turn = symmetric_set(2, 7, restarts=1), np.linalg.qr(np.random.default_rng(3).normal(size=(2, 2)))[0]

    def favoured(distance):
        """What is found with a second set, better by so much."""
        found = [SimpleNamespace(fun=1.0, x=points[:6:2].ravel()),
                 SimpleNamespace(fun=1.0 - distance, x=(points @ turn)[:6:2].ravel())]  # fmt: skip
        monkeypatch.setattr("scipy.optimize.minimize", lambda *_, **__: found.pop(0))
        return symmetric_set(2, 7, restarts=2)

    np.testing.assert_array_equal(favoured(1e-12), points)
    np.testing.assert_array_equal(favoured(1e-6), points @ turn)


def test_too_few_samples():
    with pytest.raises(ValueError, match="5 samples are too few for dimension 3: at least 6"):
        standard_points("lcd", 3, 5)


@given(st.sampled_from(["unscented", "cubature"]), st.integers(1, 12))
def test_rules_have_the_moments_of_a_standard_normal(rule, dimension):
    points, weights = standard_points(rule, dimension)
    assert weights.sum() == pytest.approx(1.0, abs=1e-12)
    np.testing.assert_allclose(weights @ points, 0.0, atol=1e-12)
    np.testing.assert_allclose((weights[:, None] * points).T @ points, np.eye(dimension), atol=1e-12)
    if rule == "unscented":
        np.testing.assert_allclose(weights @ points**4, 3.0, rtol=1e-9)  # by its default kappa
        with pytest.raises(ValueError, match="not finite"):
            standard_points(rule, dimension, kappa=-float(dimension))


def test_sets_are_kept(cache, monkeypatch):
    first = lcd_set(2, 6)
    assert [path.name for path in cache.iterdir()] == ["v2-d2-n6-s0.json"]
    monkeypatch.setattr(rules, "symmetric_set", None)  # now it can only be read
    np.testing.assert_array_equal(lcd_set(2, 6), first)


@pytest.mark.parametrize("damage", ["", "{}", "[]", '{"points": [[1, 2]]}', "\x00", None])
def test_damaged_sets_are_made_anew(cache, damage):
    first = lcd_set(2, 6)
    path = cache / "v2-d2-n6-s0.json"
    content = json.loads(path.read_text())
    if damage is None:
        content["points"][0][0] += 1e-3
        damage = json.dumps(content)
    path.write_text(damage)
    np.testing.assert_array_equal(lcd_set(2, 6), first)
    assert rules._read(path, 2, 6) is not None


def test_a_cache_that_cannot_be_written_costs_only_time(cache, monkeypatch):
    cache.parent.joinpath("lcd").write_text("a file where the folder should be")
    assert lcd_set(1, 4).shape == (4, 1)
    monkeypatch.setenv("EMT_CACHE", "off")
    assert lcd_set(1, 4).shape == (4, 1)

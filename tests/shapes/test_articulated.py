"""Connected objects in their place: points on them, distances to them, and what their points cannot tell."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from emt.conformance.sampling_kinds import ARM
from emt.linalg import Vec2
from emt.shapes.articulated import angle_period, boundary_points, distances, mirrored_parameters, sources
from emt.shapes.connected import ConnectedSettings, connected

STATE = jnp.array([1.0, 1.2, 0.0, 0.8, 1.9, 0.0, 1.1, 0.0])
BODIES = connected(
    ConnectedSettings.model_validate(
        {
            "parameters": {"a": "length", "turn": "angle", "tilt": "angle"},
            "origin": [0.5, -0.2],
            "components": {
                "hub": {"kind": "disc", "radius": 0.4, "center": [2.0, 0.0]},
                "boom": {"kind": "segment", "length": "a", "angle": {"turn": 1.0}},
                "cab": {"kind": "rectangle", "semi_axes": [0.6, 0.3], "after": "boom", "angle": {"tilt": 1.0}},
                "rim": {"kind": "ellipse", "semi_axes": ["a", 0.5], "points": "outline", "offset": "30 deg"},
                "frame": {"kind": "rectangle", "semi_axes": ["a", 0.2], "points": "outline"},
                "tank": {"kind": "ellipse", "semi_axes": [0.5, 0.2], "after": "boom"},
            },
        }
    )
)
BODY_STATE = jnp.array([1.4, 0.7, 0.0, 0.4, 0.0])
UNIT = st.floats(0.0, 1.0, exclude_max=True)


@given(st.tuples(UNIT, UNIT, UNIT))
def test_sources_lie_on_their_components(u):
    for plan, state in ((ARM, STATE), (BODIES, BODY_STATE)):
        points = sources(plan, state, jnp.array(u))
        for k in range(len(plan.components)):
            assert float(distances(plan, state, Vec2.of(points[k]))[k]) == pytest.approx(0.0, abs=1e-9)


def test_sources_cover_surfaces_evenly():
    u = jnp.asarray(np.random.default_rng(0).uniform(size=(20_000, 3)))
    points = np.asarray(jax.jit(jax.vmap(lambda x: sources(BODIES, BODY_STATE, x)))(u))
    centers = points.mean(axis=0)
    tip = np.array([0.5, -0.2]) + 1.4 * np.array([np.cos(0.7), np.sin(0.7)])
    np.testing.assert_allclose(centers, [[2.0, 0.0], (np.array([0.5, -0.2]) + tip) / 2, tip, *[[0.5, -0.2]] * 2, tip],
                               atol=0.03)  # fmt: skip
    variances = np.linalg.eigvalsh(np.einsum("nki,nkj->kij", points - centers, points - centers) / len(points))
    a, b = 1.4, 0.2
    sides = [b * b * (a + b / 3) / (a + b), a * a * (b + a / 3) / (a + b)]
    expected = [[0.04, 0.04], [0.0, 1.4**2 / 12], [0.03, 0.12], [0.125, 0.98], sides, [0.01, 0.0625]]
    np.testing.assert_allclose(variances, expected, rtol=0.05, atol=1e-9)


@given(st.tuples(st.floats(-3.0, 3.0), st.floats(-3.0, 3.0)))
def test_distances_are_those_to_the_nearest_of_many_points(p):
    """By brute force; only the distance to an ellipse is taken along the ray, so is never smaller."""
    t = np.linspace(0.0, 1.0, 401)
    found = np.asarray(distances(ARM, STATE, Vec2.of(jnp.array(p))))
    for k in range(1, 5):
        on = np.stack([np.asarray(sources(ARM, STATE, jnp.array([x, 0.0, 0.0]))[k]) for x in (0.0, 1.0)])
        line = on[0] + t[:, None] * (on[1] - on[0])
        assert found[k] == pytest.approx(np.hypot(*(line - p).T).min(), abs=2e-3)
    corner = np.array([1.4, 0.2])
    gap = np.abs(np.subtract(p, [0.5, -0.2])) - corner
    box = np.hypot(*np.maximum(gap, 0.0)) if (gap > 0).any() else -gap.max()
    found = np.asarray(distances(BODIES, BODY_STATE, Vec2.of(jnp.array(p))))
    assert found[4] == pytest.approx(box, abs=1e-9)
    assert found[0] == pytest.approx(max(np.hypot(p[0] - 2.0, p[1]) - 0.4, 0.0), abs=1e-12)


def test_discs_take_no_part_in_outlines():
    found = distances(BODIES, BODY_STATE, Vec2.of(jnp.array([2.0, 0.0])), outlines=True)
    assert float(found[0]) == np.inf
    inside = Vec2.of(jnp.array([0.5, -0.2]) + 1.4 * jnp.array([np.cos(0.7), np.sin(0.7)]))
    assert float(distances(BODIES, BODY_STATE, inside)[2]) == 0.0
    assert float(distances(BODIES, BODY_STATE, inside, outlines=True)[2]) == pytest.approx(0.3)


def test_boundary_points_lie_on_outlines_and_weigh_their_lengths():
    for plan, state in ((ARM, STATE), (BODIES, BODY_STATE)):
        points, weights = boundary_points(plan, state)
        for point in np.asarray(points):
            gaps = distances(plan, state, Vec2.of(jnp.asarray(point)), outlines=True)
            assert float(gaps.min()) == pytest.approx(0.0, abs=1e-9)
        assert weights.shape == (len(points),)
    _, weights = boundary_points(ARM, STATE)
    assert float(weights.sum()) == pytest.approx(1.0 + 0.8 + 2 * 0.75)


def test_only_the_claw_is_ambiguous():
    assert mirrored_parameters(ARM) == (ARM.state.index("alpha_c"),)
    assert mirrored_parameters(BODIES) == ()
    flipped = STATE.at[6].set(-STATE[6])
    here, there = (np.asarray(sources(ARM, s, jnp.array([0.3, 0.0, 0.0]))) for s in (STATE, flipped))
    np.testing.assert_allclose(here[[0, 1, 2, 4, 3]], there, atol=1e-12)


def test_periods():
    assert angle_period(ARM, 1) == pytest.approx(2 * np.pi)
    assert angle_period(ARM, 6) == pytest.approx(4 * np.pi)
    turned = STATE.at[6].add(angle_period(ARM, 6)).at[1].add(angle_period(ARM, 1))
    u = jnp.array([0.4, 0.2, 0.1])
    np.testing.assert_allclose(sources(ARM, turned, u), sources(ARM, STATE, u), atol=1e-12)

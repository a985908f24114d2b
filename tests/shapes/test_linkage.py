"""Connected objects: placement along chains, and residuals of points on links and discs."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from emt.linalg import Vec2
from emt.shapes.linkage import Link, disc_residual_moments, in_frames, place, segment_residual, turns_of

# an upper arm, a lower arm turned against it by its own parameter, a branch of fixed length from the upper arm
LINKS = (
    Link(None, ((1, 1.0),), 0.0, 0),
    Link(0, ((2, 1.0),), -np.pi, 3),
    Link(0, ((2, -0.5), (1, 0.25)), 0.3, 0.75),
)
NUMBER = st.floats(-3.0, 3.0)
ORIGIN = Vec2(jnp.asarray(0.5), jnp.asarray(-0.25))


@given(st.tuples(NUMBER, NUMBER, NUMBER, NUMBER))
def test_placement_against_complex_numbers(x):
    first, second, third = place(LINKS, jnp.array(x), ORIGIN)
    elbow = 0.5 - 0.25j + x[0] * np.exp(1j * x[1])
    hand = elbow + x[3] * np.exp(1j * (x[1] + x[2] - np.pi))
    branch = elbow + 0.75 * np.exp(1j * (x[1] - 0.5 * x[2] + 0.25 * x[1] + 0.3))
    for segment, start, end in [(first, 0.5 - 0.25j, elbow), (second, elbow, hand), (third, elbow, branch)]:
        tip = segment.at(jnp.asarray(1.0))
        np.testing.assert_allclose([segment.start.x, segment.start.y], [start.real, start.imag], atol=1e-12)
        np.testing.assert_allclose([tip.x, tip.y], [end.real, end.imag], atol=1e-12)


@given(st.tuples(NUMBER, NUMBER, NUMBER, NUMBER), st.tuples(NUMBER, NUMBER))
def test_from_frame_to_frame_a_point_is_where_its_links_say(x, at):
    """With a link that turns against the last one but oppositely, which shares its sine and cosine."""
    links = (*LINKS, Link(1, ((2, 0.5), (1, -0.25)), -0.3, 1.5), Link(3, ((1, 1.0),), 0.0, 2))
    parameters, point = jnp.array(x), Vec2(*map(jnp.asarray, at))
    turns = turns_of(links, parameters)
    for found, segment in zip(
        in_frames(links, turns, parameters, ORIGIN, point), place(links, parameters, ORIGIN), strict=True
    ):
        expected = segment.local(point)
        np.testing.assert_allclose([found.x, found.y], [expected.x, expected.y], atol=1e-13)
    assert turns[3].cos is turns[2].cos


@given(share=st.floats(0.0, 1.0), dx=NUMBER, dy=NUMBER, angle=NUMBER)
def test_the_residual_is_a_rigid_motion_of_the_point(share, dx, dy, angle):
    segment = place(LINKS, jnp.array([1.3, angle, 0.4, 0.9]), ORIGIN)[0]
    on = segment.at(jnp.asarray(share))
    there = segment_residual(segment.length, jnp.asarray(share), segment.local(on))
    np.testing.assert_allclose(there.array(), 0.0, atol=1e-12)
    away = segment_residual(segment.length, jnp.asarray(share), segment.local(Vec2(on.x + dx, on.y + dy)))
    assert float(away.x**2 + away.y**2) == pytest.approx(dx * dx + dy * dy, abs=1e-10)


def test_disc_moments_are_those_of_noisy_points():
    """Over points of the disc with noise, h has mean zero and the stated variance."""
    radius, sigma, n = 0.3, 0.1, 400_000
    keys = jax.random.split(jax.random.key(0), 3)
    r, phase = radius * jnp.sqrt(jax.random.uniform(keys[0], (n,))), 2 * jnp.pi * jax.random.uniform(keys[1], (n,))
    z = np.stack([r * jnp.cos(phase), r * jnp.sin(phase)], 1)
    y = z + sigma * np.asarray(jax.random.normal(keys[2], (n, 2)))
    squares = (y**2).sum(axis=1)
    _, variance = disc_residual_moments(
        jnp.asarray(radius), Vec2(jnp.asarray(0.0), jnp.asarray(0.0)), jnp.asarray(sigma**2), Vec2.of(jnp.zeros(2))
    )
    means = squares - 0.5 * radius**2 - 2 * sigma**2
    assert abs(means.mean()) < 4 * means.std() / np.sqrt(n)
    assert squares.var() == pytest.approx(float(variance), rel=0.02)
    at = Vec2(jnp.asarray(1.0), jnp.asarray(2.0))
    mean, _ = disc_residual_moments(jnp.asarray(radius), Vec2.of(jnp.array([0.4, 1.2])), jnp.asarray(sigma**2), at)
    assert float(mean) == pytest.approx(0.36 + 0.64 - 0.045 - 0.02, rel=1e-12)

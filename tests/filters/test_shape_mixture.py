"""Trackers of connected objects against plain NumPy, each other, and what they must not do."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from emt.conformance.sampling_kinds import ARM
from emt.filters.base import guarded
from emt.filters.connected_model import ConnectedModel
from emt.filters.shape_mixture import Belief, build, merger
from emt.filters.shape_mixture_settings import ShapeMixtureSettings
from emt.linalg import Sym2
from emt.montecarlo.program import cast
from emt.sampling.rules import lcd_set
from emt.scans import as_scan
from emt.shapes.articulated import sources
from emt.shapes.connected import ConnectedSettings, connected
from emt.types import Measurements, StatePrior
from tests.reference import shape_mixture as reference

SIGMA2, Q, STEPS = 1e-2, 1e-5, 60
START = np.array([0.9, 1.5, 0.0, 1.1, 1.6, 0.0, 1.5, 0.0])
COV = 1e-2 * np.eye(8)
TRUTH = np.array([1.0, np.pi / 2, 0.0, 1.0, np.pi / 2, 0.0, np.pi / 2, 0.0])
EVEN = [[0.2] * 5] * 5
STICKY = 0.6 * np.eye(5) + 0.1 * (1.0 - np.eye(5))


@cache
def data(n=STEPS):
    """(points, their components) of the arm at rest."""
    rng = np.random.default_rng(7)
    parts = rng.integers(0, 5, n)
    seen = jax.vmap(lambda u: sources(ARM, jnp.asarray(TRUTH), u))(jnp.asarray(rng.uniform(size=(n, 3))))
    return np.asarray(seen)[np.arange(n), parts] + np.sqrt(SIGMA2) * rng.normal(size=(n, 2)), parts


def model_of(plan=ARM, sigma2=SIGMA2, q=Q) -> ConnectedModel:
    return ConnectedModel(jnp.full(len(plan.state), q), Sym2(*map(jnp.asarray, (sigma2, 0.0, sigma2))), plan)


def tracked(settings: dict, points, parts=None, plan=ARM, start=START, cov=COV, sigma2=SIGMA2, predict=True):
    """(means, infos) after every scan; points of shape (scan, point, 2)."""
    params, make = build(ShapeMixtureSettings.model_validate({"kind": "shape_mixture", **settings}))
    flt = guarded(make(cast(params, np.float64), model_of(plan, sigma2)))
    points = np.asarray(points)
    points = points if points.ndim == 3 else points[:, None, :]
    n, m = points.shape[:2]
    told = None if parts is None else jnp.asarray(np.reshape(parts, (n, m)))
    scans = Measurements(jnp.asarray(points), jnp.ones((n, m), bool), jnp.zeros(n, bool), told)
    key = jax.random.key(0)

    def step(state, scan):
        state = flt.predict(state, jnp.asarray(1.0), key) if predict else state
        state, info = flt.update(state, scan, key)
        return state, (flt.estimate(state), info)

    prior = StatePrior(jnp.asarray(start), jnp.asarray(cov))
    estimates, infos = jax.jit(lambda scans: jax.lax.scan(step, flt.init(prior, key), scans)[1])(scans)
    assert not (np.asarray(infos.status) & 3).any()
    return np.asarray(estimates.mean), infos


SAMPLES = {"count": 18}


@pytest.mark.parametrize(
    ("settings", "options"),
    [
        ({}, {}),
        ({"sensor_noise": "augmented", "samples": {"count": 22}}, {"augmented": True}),
        ({"gate": 0.9}, {"gate": 0.9}),
        (
            {"clutter": {"probability": 0.2, "low": [-2.0, -2.0], "high": [2.0, 3.0]}},
            {"clutter": (0.2, 20.0)},
        ),
    ],
    ids=["weighted", "augmented", "gate", "clutter"],
)
def test_random_switch_agrees_with_plain_numpy(settings, options):
    points, _ = data()
    ours, _ = tracked({"samples": SAMPLES, **settings}, points)
    samples = lcd_set(11, 22) if options.get("augmented") else lcd_set(9, 18)
    theirs = reference.random_switch(points, START, COV, SIGMA2, Q, samples, **options)
    np.testing.assert_allclose(ours[0], theirs[0], rtol=1e-10)
    np.testing.assert_allclose(ours, theirs, rtol=1e-7, atol=1e-8)


@pytest.mark.parametrize("method", ["imm", "gpb2"])
def test_markov_switch_agrees_with_plain_numpy(method):
    points = data()[0][:30]
    chain = {"transition": STICKY.tolist(), "method": method}
    ours, _ = tracked({"samples": SAMPLES, "markov": chain}, points)
    theirs = reference.markov(points, START, COV, SIGMA2, Q, lcd_set(9, 18), STICKY, method == "gpb2")
    np.testing.assert_allclose(ours[0], theirs[0], rtol=1e-10)
    np.testing.assert_allclose(ours, theirs, rtol=1e-7, atol=1e-8)


def test_an_even_markov_switch_is_the_random_switch():
    points = data(200)[0]
    random, _ = tracked({"samples": SAMPLES}, points)
    even, _ = tracked({"samples": SAMPLES, "markov": {"transition": EVEN}}, points)
    np.testing.assert_allclose(even[0], random[0], rtol=1e-10, atol=1e-13)
    np.testing.assert_allclose(even, random, atol=1e-5)


def test_stay_is_short_for_a_matrix():
    points = data()[0][:10]
    a, _ = tracked({"samples": SAMPLES, "markov": {"stay": 0.6}}, points)
    b, _ = tracked({"samples": SAMPLES, "markov": {"transition": STICKY.tolist()}}, points)
    np.testing.assert_allclose(a, b, rtol=1e-12)


@pytest.mark.parametrize("association", ["direct", "nearest", "known"])
def test_hard_association_uses_one_component_at_a_time(association):
    points, parts = data()
    ours, infos = tracked({"samples": SAMPLES, "association": association}, points, parts)
    x, cov = START, COV
    for k, y in enumerate(points[:20]):
        x, cov = reference.MOVE @ x, reference.MOVE @ cov @ reference.MOVE.T + Q * np.eye(8)
        found = [reference.component(x, cov, y, SIGMA2, lcd_set(9, 18), m) for m in range(5)]
        if association == "direct":
            chosen = int(np.argmax([f[2] for f in found]))
        elif association == "known":
            chosen = parts[k]
        else:
            gaps = [max(np.hypot(*y) - 0.3, 0.0)]
            for start, beta, length in reference.frames(x):
                along = np.array([np.cos(beta), np.sin(beta)])
                gaps.append(np.linalg.norm(y - start - np.clip((y - start) @ along, 0.0, length) * along))
            chosen = int(np.argmin(gaps))
        x, cov = found[chosen][:2]
        np.testing.assert_allclose(ours[k], x, rtol=1e-8, atol=1e-10)
        np.testing.assert_array_equal(infos.confusion[k], np.eye(5)[parts[k]][:, None] * np.eye(5)[chosen])


def test_points_of_one_scan_come_one_after_the_other():
    points, _ = data()
    once, _ = tracked({"samples": SAMPLES}, points[:12].reshape(3, 4, 2), predict=False)
    alone, _ = tracked({"samples": SAMPLES}, points[:12], predict=False)
    np.testing.assert_allclose(once, alone[3::4], rtol=1e-9)


def test_what_a_gate_keeps_out():
    far = np.array([[9.0, 9.0]])
    kept, infos = tracked({"samples": SAMPLES, "gate": 0.999}, far)
    np.testing.assert_allclose(kept[0], reference.MOVE @ START, rtol=1e-12)
    assert infos.status[0] != 0
    moved, _ = tracked({"samples": SAMPLES}, far)
    assert np.abs(moved[0] - kept[0]).max() > 0.1
    clutter = {"probability": 0.1, "low": [-10.0, -10.0], "high": [10.0, 10.0]}
    ignored, _ = tracked({"samples": SAMPLES, "clutter": clutter}, far)
    np.testing.assert_allclose(ignored[0], kept[0], atol=1e-9)


def test_known_clutter_moves_nothing():
    points, _ = data()
    kept, infos = tracked({"samples": SAMPLES, "association": "known"}, points[:1], np.array([-1]))
    np.testing.assert_allclose(kept[0], reference.MOVE @ START, rtol=1e-12)
    assert not np.asarray(infos.confusion).any()


def test_angles_are_brought_within_a_period_before_they_are_mixed():
    merge = merger(ARM)
    turned = START.copy()
    turned[[1, 6]] += 2.0 * np.pi, -4.0 * np.pi  # the claw's angle counts by halves
    beliefs = (Belief(jnp.asarray(START), jnp.asarray(COV)), Belief(jnp.asarray(turned), jnp.asarray(COV)))
    mean, cov = merge(jnp.array([0.6, 0.4]), beliefs)
    np.testing.assert_allclose(mean, START, atol=1e-12)
    np.testing.assert_allclose(cov, COV, atol=1e-12)


BODY = {
    "parameters": {"a": "length", "b": "length", "turn": "angle"},
    "components": {"body": {"kind": "ellipse", "semi_axes": ["a", "b"], "angle": {"turn": 1.0}}},
}


@pytest.mark.parametrize("points", ["surface", "outline"])
@pytest.mark.parametrize("kind", ["ellipse", "rectangle"])
def test_a_body_is_sized_from_its_points(kind, points):
    """Semi-axes and direction of an ellipse or rectangle, from a poor start."""
    part = {**BODY["components"]["body"], "kind": kind, "points": points}
    plan = connected(ConnectedSettings.model_validate({**BODY, "components": {"body": part}}))
    rng, truth, n = np.random.default_rng(1), jnp.array([2.0, 0.8, 0.5, 0.0]), 1200
    seen = jax.vmap(lambda u: sources(plan, truth, u)[0])(jnp.asarray(rng.uniform(size=(n, 3))))
    seen = np.asarray(seen) + 0.05 * rng.normal(size=(n, 2))
    settings = {"sensor_noise": "augmented", "samples": {"count": 24}}
    start, cov = np.array([1.5, 1.2, 0.3, 0.0]), np.diag([0.2, 0.2, 0.1, 1e-8])
    means, _ = tracked(settings, seen, plan=plan, start=start, cov=cov, sigma2=0.05**2)
    tail = means[-300:].mean(axis=0)
    np.testing.assert_allclose(tail[:2], truth[:2], rtol=0.12)
    assert abs(np.sin(tail[2] - 0.5)) < 0.12


def test_an_empty_scan_leaves_the_prediction():
    params, make = build(ShapeMixtureSettings.model_validate({"kind": "shape_mixture", "samples": SAMPLES}))
    flt = guarded(make(params, model_of()))
    key = jax.random.key(0)
    state = flt.predict(flt.init(StatePrior(jnp.asarray(START), jnp.asarray(COV)), key), jnp.asarray(1.0), key)
    after, info = flt.update(state, as_scan(jnp.zeros((0, 2))), key)
    np.testing.assert_array_equal(flt.estimate(after).mean, flt.estimate(state).mean)
    assert int(info.status) == 0

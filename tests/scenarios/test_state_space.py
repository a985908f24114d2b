"""Simulated points: legs, random switches, measurements, and functions of the user's."""

import sys
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pydantic import ValidationError

from emt.config.errors import ConfigError
from emt.config.load import load_experiment
from emt.models.motion import WhiteAcceleration
from emt.models.state_space.motions import ConstantVelocity, LinearMotion, SpeedChange
from emt.models.switching import SwitchingSettings, unreachable
from emt.montecarlo.chunks import Engine
from emt.montecarlo.program import Program, cast
from emt.scenarios.state_space import StateSpaceScenarioSettings, build
from tests.filters.point_cases import QUICK, kinematic, white

MEASUREMENT = {"kind": "position", "noise_cov": [[4.0, 1.5], [1.5, 9.0]]}
STRAIGHT = {"kind": "constant_velocity"}
LEGS = [
    {"steps": 3, "mode": "cv", "motion": STRAIGHT},
    {"steps": 6, "mode": "turn", "motion": {"kind": "constant_turn", "rate": "4 deg/s"}},
    {"steps": 5, "mode": "wide", "motion": {"kind": "speed_change", "acceleration": 8.0}},
    {"steps": 4, "mode": "cv", "motion": STRAIGHT},
    {"steps": 2, "mode": "wide", "motion": {"kind": "constant_velocity", "acceleration": [3.0, -1.0]}},
]
BASE = {"kind": "state_space", "dt": 2.0, "start": {"mean": [10.0, -20.0, 60.0, 80.0]}, "measurement": MEASUREMENT}


def settings_of(**changes) -> StateSpaceScenarioSettings:
    return StateSpaceScenarioSettings.model_validate({**BASE, **changes})


def simulate(settings: StateSpaceScenarioSettings, runs: int = 1):
    """(truth, scans) of several runs; leading axes run, step."""
    params, make = build(settings, runs)

    def one(params, run):
        scenario, keys = make(params), jax.random.split(jax.random.fold_in(jax.random.key(7), run))
        truth = scenario.sample_truth(keys[0])
        return truth, scenario.sample_scans(truth, keys[1])

    compiled = jax.jit(jax.vmap(one, in_axes=(None, 0)), compiler_options=QUICK)
    return jax.tree.map(np.asarray, compiled(cast(params, np.float64), jnp.arange(runs)))


@cache
def flight():
    """Legs without noise: (settings, states from the start on, modes)."""
    settings = settings_of(legs=LEGS)
    truth, _ = simulate(settings)
    return settings, np.vstack([BASE["start"]["mean"], truth.state[0]]), truth


def test_a_straight_leg_keeps_its_velocity():
    _, states, _ = flight()
    np.testing.assert_allclose(states[1:4, :2], [10.0, -20.0] + 2.0 * np.arange(1, 4)[:, None] * [60.0, 80.0])
    np.testing.assert_allclose(states[1:4, 2:], [[60.0, 80.0]] * 3)


def test_a_turn_keeps_speed_and_radius():
    """Anticlockwise by 8 degrees per step of 2 seconds, about one point at the distance v / ω."""
    _, states, _ = flight()
    leg, rate = states[3:10], np.radians(4.0)
    np.testing.assert_allclose(np.hypot(*leg[:, 2:].T), 100.0, rtol=1e-13)
    headings = np.unwrap(np.arctan2(leg[:, 3], leg[:, 2]))
    np.testing.assert_allclose(np.diff(headings), 2.0 * rate, rtol=1e-12)
    across = np.stack([-leg[:, 3], leg[:, 2]], axis=1)
    centers = leg[:, :2] + across / rate
    np.testing.assert_allclose(centers, np.broadcast_to(centers[0], centers.shape), atol=1e-9)
    np.testing.assert_allclose(np.hypot(*(leg[:, :2] - centers).T), 100.0 / rate, rtol=1e-13)


def test_a_change_of_speed_follows_the_velocity():
    """v T + a T² / 2 along the way, and a T more speed per step; the heading stays."""
    _, states, _ = flight()
    leg = states[9:15]
    heading = leg[0, 2:] / np.linalg.norm(leg[0, 2:])
    times = 2.0 * np.arange(6)
    np.testing.assert_allclose(leg[:, 2:], (100.0 + 8.0 * times)[:, None] * heading, rtol=1e-12)
    way = (100.0 * times + 0.5 * 8.0 * times**2)[:, None] * heading
    np.testing.assert_allclose(leg[:, :2], leg[0, :2] + way, rtol=1e-12)


def test_a_known_acceleration_is_held_over_its_leg():
    _, states, _ = flight()
    leg, push, times = states[18:21], np.array([3.0, -1.0]), np.array([2.0, 4.0])[:, None]
    np.testing.assert_allclose(leg[1:, 2:], leg[0, 2:] + times * push, rtol=1e-12)
    np.testing.assert_allclose(leg[1:, :2], leg[0, :2] + times * leg[0, 2:] + 0.5 * times**2 * push, rtol=1e-12)


def test_a_point_at_rest_does_not_gain_speed():
    """It has no direction to go in, and nothing that is not a number."""
    motion, still = SpeedChange(jnp.asarray(8.0), None), jnp.asarray([1.0, 2.0, 0.0, 0.0])
    moved, jacobian = motion.linearised(still, jnp.asarray(0.0), jnp.asarray(2.0))
    np.testing.assert_array_equal(moved, still)
    assert np.isfinite(np.asarray(jacobian)).all()


def test_maneuvers_and_true_modes_of_legs():
    settings, _, truth = flight()
    assert settings.n_steps == 20
    assert settings.maneuvers == ((4, 14), (19, 20))  # two legs that adjoin are one
    assert settings.modes == ("cv", "turn", "wide")
    assert settings.true_modes == ("cv",) * 3 + ("turn",) * 6 + ("wide",) * 5 + ("cv",) * 4 + ("wide",) * 2
    assert truth.shape.modes == settings.modes
    np.testing.assert_array_equal(truth.mode[0], [settings.modes.index(name) for name in settings.true_modes])


def test_legs_without_modes_tell_none():
    legs = [{key: value for key, value in leg.items() if key != "mode"} for leg in LEGS]
    settings = settings_of(legs=legs)
    params, make = build(settings, 1)
    truth = jax.eval_shape(lambda params: make(params).sample_truth(jax.random.key(0)), cast(params, np.float64))
    assert truth.mode is None
    assert truth.shape.modes == ()
    assert settings.true_modes is None


CHAIN = [[0.9, 0.1, 0.0], [0.2, 0.5, 0.3], [0.0, 0.4, 0.6]]
SWITCHING = {
    "motions": {
        "still": STRAIGHT,
        "turn": {"kind": "constant_turn", "rate": 0.1, "noise": {"kind": "white_acceleration", "psd": 0.1}},
        "gain": {"kind": "constant_velocity", "acceleration": [1.0, 0.0]},
    },
    "switching": {"transition": CHAIN},
    "first": "turn",
}


def test_random_switches_follow_the_chain():
    """Frequencies within 4 standard errors; the first switch leaves the stated mode."""
    runs, steps = 150, 60
    truth, _ = simulate(settings_of(**SWITCHING, steps=steps, dt=1.0), runs)
    modes = truth.mode
    assert truth.shape.modes == ("still", "turn", "gain")
    for i in range(3):
        follows = modes[:, 1:][modes[:, :-1] == i]
        for j in range(3):
            p = CHAIN[i][j]
            assert (follows == j).mean() == pytest.approx(p, abs=4.0 * np.sqrt(p * (1.0 - p) / len(follows)))
    for j in range(3):
        p = CHAIN[1][j]
        assert (modes[:, 0] == j).mean() == pytest.approx(p, abs=4.0 * np.sqrt(p * (1.0 - p) / runs))
    # and the state moves as its mode says: the mode of a step is that of the motion towards it
    states = truth.state
    gained = states[:, 1:, 2:] - states[:, :-1, 2:]
    np.testing.assert_array_equal(gained[modes[:, 1:] == 0], 0.0)
    np.testing.assert_allclose(gained[modes[:, 1:] == 2], [[1.0, 0.0]] * (modes[:, 1:] == 2).sum(), atol=1e-12)


def test_the_start_and_the_process_noise_have_their_covariances():
    start = {"mean": [10.0, -20.0, 60.0, 80.0], "cov": {"diagonal": [100.0, 4.0, 9.0, 0.0]}}
    motion = {"kind": "constant_velocity", "noise": {"kind": "white_acceleration", "psd": 3.0}}
    truth, _ = simulate(settings_of(motion=motion, steps=2, start=start), 4000)
    F, Q = kinematic(2.0), white(3.0, 2.0)
    noise = truth.state[:, 1] - truth.state[:, 0] @ F.T
    scale = np.sqrt(np.diag(Q))
    np.testing.assert_allclose(np.cov(noise.T) / np.outer(scale, scale), Q / np.outer(scale, scale), atol=0.08)
    first = np.diag([100.0, 4.0, 9.0, 0.0])
    expected = F @ first @ F.T + Q
    scale = np.sqrt(np.diag(expected))
    found = np.cov(truth.state[:, 0].T)
    np.testing.assert_allclose(found / np.outer(scale, scale), expected / np.outer(scale, scale), atol=0.08)
    np.testing.assert_allclose(truth.state[:, 0].mean(axis=0), F @ start["mean"], atol=1.0)


def test_measurement_noise_has_its_covariance_and_scans_may_be_empty():
    truth, scans = simulate(settings_of(motion=STRAIGHT, steps=40, detection_probability=0.7), 100)
    gaps = scans.points[:, :, 0] - truth.state[:, :, :2]
    np.testing.assert_allclose(np.cov(gaps.reshape(-1, 2).T), MEASUREMENT["noise_cov"], rtol=0.1)
    np.testing.assert_allclose(gaps.mean(axis=(0, 1)), 0.0, atol=0.2)
    assert scans.mask.shape == (100, 40, 1)
    assert scans.mask.mean() == pytest.approx(0.7, abs=0.03)
    lag = (gaps[:, 1:] * gaps[:, :-1]).mean(axis=(0, 1)) / gaps.var(axis=(0, 1))
    np.testing.assert_allclose(lag, 0.0, atol=0.07)  # one scan tells nothing of the next
    _, all_seen = simulate(settings_of(motion=STRAIGHT, steps=40), 2)
    assert all_seen.mask.all()


def test_ranges_and_bearings_are_of_the_sensor():
    measurement = {"kind": "range_bearing", "range_std": 0.5, "bearing_std": "1 deg", "sensor": [100.0, 50.0]}
    truth, scans = simulate(settings_of(motion=STRAIGHT, steps=30, measurement=measurement), 100)
    d = truth.state[:, :, :2] - [100.0, 50.0]
    off = scans.points[:, :, 0] - np.stack([np.hypot(d[..., 0], d[..., 1]), np.arctan2(d[..., 1], d[..., 0])], -1)
    assert off[..., 0].std() == pytest.approx(0.5, rel=0.05)
    assert off[..., 1].std() == pytest.approx(np.radians(1.0), rel=0.05)


@pytest.mark.bits
def test_a_longer_experiment_extends_a_shorter_one():
    short, long = (simulate(settings_of(**SWITCHING, steps=n, detection_probability=0.5), 2) for n in (5, 9))
    for ours, theirs in zip(jax.tree.leaves(short), jax.tree.leaves(long), strict=True):
        np.testing.assert_array_equal(ours, theirs[:, :5])
    assert not np.array_equal(long[0].state[0], long[0].state[1])


def test_the_growth_series_of_the_report():
    """x ← 1 + sin(0.04 π t) + x / 2 + v from x = 1 at t = 1, with gamma noise v; y = x² / 5, and x / 2 - 2 after 30."""
    settings = load_experiment("azimian2005/growth").experiment.scenario
    truth, scans = simulate(settings, 200)
    t, x = np.arange(2, 61), truth.state[:, :, 0]
    before = np.concatenate([np.ones((200, 1)), x[:, :-1]], axis=1)
    v = x - (1.0 + np.sin(0.04 * np.pi * t) + 0.5 * before)
    assert v.min() > 0.0
    assert v.mean() == pytest.approx(1.5, abs=4.0 * np.sqrt(0.75 / v.size))
    assert v.var() == pytest.approx(0.75, rel=0.06)
    n = scans.points[:, :, 0, 0] - np.where(t <= 30, 0.2 * x**2, 0.5 * x - 2.0)
    assert n.var() == pytest.approx(1e-5, rel=0.06)
    assert np.abs(n).max() < 6.0 * np.sqrt(1e-5)


def test_matrices_of_constant_velocity_are_the_named_motion():
    F, Q = kinematic(2.0), white(3.0, 2.0)
    named = {
        "kind": "constant_velocity",
        "acceleration": [1.0, -2.0],
        "noise": {"kind": "white_acceleration", "psd": 3.0},
    }
    linear = {
        "kind": "linear", "states": ["x", "y", "vx", "vy"], "transition": F.tolist(), "noise_cov": Q.tolist(),
        "offset": [2.0, -4.0, 2.0, -4.0],
    }  # fmt: skip
    matrix = {"kind": "linear", "matrix": np.eye(2, 4).tolist(), "noise_cov": MEASUREMENT["noise_cov"]}
    truth, scans = simulate(settings_of(motion=named, steps=6), 3)
    same, seen = simulate(settings_of(motion=linear, steps=6, measurement=matrix), 3)
    np.testing.assert_allclose(same.state, truth.state, rtol=1e-12)
    np.testing.assert_allclose(seen.points, scans.points, rtol=1e-12)
    motion = ConstantVelocity(jnp.asarray([1.0, -2.0]), WhiteAcceleration(jnp.asarray(3.0)))
    as_matrix = LinearMotion(*map(jnp.asarray, (F, np.array([2.0, -4.0, 2.0, -4.0]), Q)))
    x, dt, time = jnp.asarray([1.0, 2.0, 3.0, 4.0]), jnp.asarray(2.0), jnp.asarray(0.0)
    for ours, theirs in zip(motion.linearised(x, time, dt), as_matrix.linearised(x, time, dt), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-14)
    np.testing.assert_allclose(motion.noise_cov(dt), as_matrix.noise_cov(dt), rtol=1e-14)


def test_lengths_and_angles_have_units():
    start = {"mean": ["1 km", 0.0, "36 km/h", 0.0], "cov": {"diagonal": ["100 m^2", 1.0, 1.0, 1.0]}}
    settings = settings_of(motion={"kind": "constant_turn", "rate": "90 deg/s"}, steps=1, dt="1 s", start=start)
    assert settings.start.mean == pytest.approx((1000.0, 0.0, 10.0, 0.0))
    assert settings.start.cov[0][0] == 100.0
    assert settings.motion.rate == pytest.approx(np.pi / 2)


def test_chains_by_changes_leave_the_rest_to_staying():
    names = ("a", "b", "c")
    chain = SwitchingSettings.model_validate({"changes": {"a": {"b": 0.1, "c": 0.2}, "c": {"a": 1.0}}})
    np.testing.assert_allclose(chain.matrix(names), [[0.7, 0.1, 0.2], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
    assert chain.faults(names) == []
    np.testing.assert_allclose(
        SwitchingSettings(stay=0.95).matrix(("a", "b", "c", "d")), 0.95 * np.eye(4) + 0.05 / 3.0 * (1.0 - np.eye(4))
    )
    assert unreachable(chain.matrix(names), (1.0, 0.0, 0.0), names) == ()
    assert unreachable(chain.matrix(names), (0.0, 1.0, 0.0), names) == ("a", "c")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"motion": STRAIGHT}, "steps: is required"),
        ({"motion": STRAIGHT, "legs": LEGS, "steps": 3}, "give one of motion, legs or motions"),
        ({"steps": 3}, "give one of motion, legs or motions"),
        ({"legs": LEGS, "steps": 3}, "steps: the legs have their own"),
        ({"legs": [LEGS[0], {"steps": 2, "motion": STRAIGHT}]}, "legs: give the mode of all or of none"),
        ({"motions": SWITCHING["motions"], "steps": 3}, "switching: goes with motions"),
        ({"motion": STRAIGHT, "steps": 3, "first": "cv"}, "first: unknown motion 'cv'"),
        ({**SWITCHING, "steps": 3, "first": "tun"}, "first: unknown motion 'tun' .did you mean 'turn'"),
        ({**SWITCHING, "steps": 3, "switching": {"changes": {"still": {"trn": 0.1}}}}, "'trn' .did you mean 'turn'"),
        ({**SWITCHING, "steps": 3, "switching": {"changes": {"still": {"turn": 0.6, "gain": 0.6}}}}, "sum to 1.2"),
        ({**SWITCHING, "steps": 3, "switching": {"changes": {"still": {"still": 0.6}}}}, "'still' to itself"),
        ({"legs": [LEGS[0], {"steps": 1, "mode": "x", "motion": {"kind": "growth"}}]}, r"legs\[1\].motion: its state"),
        ({"motion": {"kind": "growth"}, "steps": 3, "start": {"mean": [1.0]}}, "measures x, y; the state is level"),
        ({"motion": STRAIGHT, "steps": 3, "start": {"mean": [0.0]}}, "mean: expected 4 numbers, got 1"),
        ({"motion": STRAIGHT, "steps": 3, "detection_probability": 1.2}, "less than or equal to 1"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_what_cannot_be(changes, message):
    with pytest.raises(ValidationError, match=message):
        settings_of(**changes)


# functions of the user's

FUNCTIONS = '''
"""A pendulum, and the place of its end."""

import jax.numpy as jnp


def swing(state, time, dt):
    angle, rate = state
    rate = rate - dt * 9.81 * jnp.sin(angle)
    return jnp.stack([angle + dt * rate, rate])


def end(state, time):
    return jnp.stack([jnp.sin(state[0]), -jnp.cos(state[0])])
'''
PENDULUM = """
title: A pendulum
monte_carlo: {runs: 64, chunk: 64, seed: 1}
scenario:
  kind: state_space
  dt: 0.05
  steps: 40
  motion: &swing
    kind: function
    function: 'pendulum_functions:swing'
    states: [angle, rate]
    noise_cov: [1.0e-6, 1.0e-3]
  start: &start {mean: [1.0, 0.0], cov: {diagonal: [0.04, 0.04]}}
  measurement: &end {kind: function, function: 'pendulum_functions:end', noise_cov: [0.01, 0.01]}
model:
  kind: state_space
  motion: *swing
  measurement: *end
  prior: *start
start_with: predict
filters:
  ekf: {kind: ekf}
metrics: [nees, nis, run_rmse]
"""


@pytest.fixture
def pendulum(tmp_path, monkeypatch):
    """The folder in which a user writes experiment and functions."""
    (tmp_path / "pendulum.yaml").write_text(PENDULUM, encoding="utf-8")
    (tmp_path / "pendulum_functions.py").write_text(FUNCTIONS, encoding="utf-8")
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.delitem(sys.modules, "pendulum_functions", raising=False)
    return str(tmp_path / "pendulum.yaml")


def test_functions_of_the_user_are_motion_and_measurement(pendulum):
    """A filter that differentiates them tracks the pendulum, and is consistent with what it is told."""
    experiment = load_experiment(pendulum).experiment
    assert experiment.model.states == ("angle", "rate")
    engine = Engine(Program.of(experiment), 1, 64)
    engine.compile()
    arrays = engine.run_chunk(0, 64, tracked=64)
    assert not arrays["ekf/status"].any()
    nees, nis, rmse = arrays["ekf/values"].mean(axis=0)
    assert 1.6 < nees < 2.6
    assert nis == pytest.approx(2.0, abs=0.15)
    assert rmse < 0.3
    states = arrays["truth/state"]
    angle, rate = states[:, :-1, 0], states[:, :-1, 1]
    ahead = rate - 0.05 * 9.81 * np.sin(angle)
    assert (states[:, 1:, 1] - ahead).std() == pytest.approx(np.sqrt(1e-3), rel=0.1)
    assert (states[:, 1:, 0] - angle - 0.05 * ahead).std() == pytest.approx(1e-3, rel=0.1)


def test_a_function_that_is_not_there_is_named(pendulum):
    with pytest.raises(ConfigError, match="pendulum_functions:swnig"):
        load_experiment(pendulum, ["scenario.motion.function='pendulum_functions:swnig'"])

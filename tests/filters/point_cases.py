"""Random problems of points, their filters run on them, and the textbook's steps beside."""

import json
from collections.abc import Callable
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import emt.filters.catalogue  # noqa: F401 - registers the filters
from emt.config.load import load_experiment
from emt.filters.base import guarded
from emt.models.motion import WhiteAcceleration
from emt.models.state_space.measurements import GrowthMeasurement, LinearMeasurement, Position, RangeBearing
from emt.models.state_space.model import StateSpaceModel, state_space_model
from emt.models.state_space.motions import ConstantVelocity, Growth, LinearMotion, SpeedChange
from emt.registry import FILTERS
from emt.status import FAILURE
from emt.types import Estimate, Info, Measurements, Point, StatePrior
from tests.filters.cases import FAST_COMPILE, cast, pick, stack
from tests.reference import kalman, unscented

N_STEPS = 14
KINEMATIC = ("x", "y", "vx", "vy")
TIGHT = 1e-9
"""Largest difference from the oracles, relative to the largest entry of each kind."""


class World(NamedTuple):
    """A model, a prior and scans to track, or several with a leading axis."""

    model: StateSpaceModel
    prior: StatePrior
    scans: Measurements
    dt: Any
    key: Any


class Answer(NamedTuple):
    """What a filter says, with a leading time axis."""

    estimate: Estimate
    info: Info
    state: Any
    """Its own state after each scan."""


def world_of(model: StateSpaceModel, mean, cov, values, mask=None, dt=1.0, seed=0) -> World:
    """Measurements (step, number) as scans; those masked out hold numbers that must not matter."""
    values = np.asarray(values, float)
    mask = np.ones(len(values), bool) if mask is None else np.asarray(mask)
    points = np.where(mask[:, None], values, 1e3)[:, None, :]
    scans = Measurements(points, mask[:, None], np.zeros(len(values), bool))
    prior = StatePrior(np.asarray(mean, float), np.asarray(cov, float))
    steps = np.broadcast_to(dt, len(values)).astype(float)
    return World(*cast((model, prior, scans, steps), float), jax.random.key(seed))


def one_motion(motion, measurement, start_time=0.0, names=KINEMATIC) -> StateSpaceModel:
    """A model with a single motion."""
    point = Point(names, measurement.noise_cov().shape[0])
    return StateSpaceModel((motion,), measurement, jnp.ones((1, 1)), jnp.ones(1), start_time, point, ("motion",))


def build(settings: dict) -> tuple[Any, Callable]:
    """Traced parameters, and the function that makes the guarded filter of them and a model."""
    entry = FILTERS.get(settings["kind"])
    params, make = entry.builder(entry.settings.model_validate(settings))
    return cast(params, np.float64), lambda params, model: guarded(make(params, model))


def track(make: Callable, first: bool, params, world: World) -> Answer:
    """One run; `first` tells whether the first scan is preceded by a prediction."""
    flt = make(params, world.model)

    def step(state, now):
        k, scan, dt = now
        keys = jax.random.split(jax.random.fold_in(world.key, k))
        ahead = flt.predict(state, dt, keys[0])
        if not first:
            ahead = jax.tree.map(lambda a, b: jnp.where(k > 0, a, b), ahead, state)
        state, info = flt.update(ahead, scan, keys[1])
        return state, Answer(flt.estimate(state), info, state.state)

    start = flt.init(world.prior, world.key)
    return jax.lax.scan(step, start, (jnp.arange(len(world.dt)), world.scans, world.dt))[1]


QUICK = FAST_COMPILE | {"xla_cpu_parallel_codegen_split_count": 1}
"""Also without the cost of distributing the work of compiling over threads."""
PROGRAMS: dict[str, Callable] = {}
TRACED = (
    "resample_below", "alpha", "beta", "kappa", "floor", "unlikely_below", "principal_above", "activate_above",
    "probability_bounds", "likelihood_bounds",
)  # fmt: skip
"""Settings that are numbers of a compiled program."""


def tracked(settings: dict, world: World, first: bool = True, batch: bool = False) -> Answer:
    """The answer of a filter to one problem, or to several with a leading axis, as NumPy arrays."""
    params, make = build(settings)
    fixed = json.dumps([{k: v for k, v in settings.items() if k not in TRACED}, first, batch])
    if fixed not in PROGRAMS:
        run = partial(track, make, first)
        mapped = jax.vmap(run, in_axes=(None, 0)) if batch else run
        PROGRAMS[fixed] = jax.jit(mapped, compiler_options=QUICK)
    return jax.tree.map(np.asarray, PROGRAMS[fixed](params, world))


def assert_close(actual, expected, tolerance: float = TIGHT, what: str = "") -> None:
    """Largest difference, relative to the largest magnitude of the expected quantity."""
    actual, expected = np.asarray(actual, float), np.asarray(expected, float)
    assert actual.shape == expected.shape, what
    assert np.isfinite(actual).all(), what
    error = np.abs(actual - expected).max() / max(np.abs(expected).max(), 1e-300)
    assert error <= tolerance, f"{what}: relative error {error:.3g}"


def gappy(rng, n: int = N_STEPS) -> np.ndarray:
    """Which scans hold something: not all, and two empty ones after each other."""
    mask = rng.uniform(size=n) < 0.8
    mask[[4, 5]], mask[0] = False, True
    return mask


def random_cov(rng, n: int) -> np.ndarray:
    factor = rng.normal(size=(n, n))
    return factor @ factor.T + 0.1 * np.eye(n)


def simulated(rng, model: StateSpaceModel, mean, cov, dt, gaps: bool = True) -> World:
    """A point that starts at a draw of its prior, by the textbook; scans with a measurement each, or with gaps."""
    world = world_of(model, mean, cov, np.zeros((len(dt), model.point.measured)), gappy(rng) if gaps else None, dt)
    state, values = rng.multivariate_normal(mean, cov), []
    for s in textbook(world):
        is_growth = isinstance(model.motions[0], Growth)
        noise = rng.gamma(3.0, 0.5, 1) if is_growth else rng.multivariate_normal(np.zeros(len(s.Q)), s.Q)
        state = s.f(state) + noise
        values.append(kalman.wrapped(s.h(state) + rng.multivariate_normal(np.zeros(len(s.R)), s.R), s.angles))
    points = jnp.where(world.scans.mask[:, :, None], jnp.asarray(values)[:, None, :], 1e3)
    return world._replace(scans=world.scans._replace(points=points))


@cache
def linear_worlds() -> list[World]:
    """x ← F x + b + v and z = H x + w with random matrices."""
    worlds = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        turn = np.linalg.qr(rng.normal(size=(4, 4)))[0]
        motion = LinearMotion(*map(jnp.asarray, (0.97 * turn + 0.05, rng.normal(size=4), 0.3 * random_cov(rng, 4))))
        seen = LinearMeasurement(jnp.asarray(rng.normal(size=(2, 4))), jnp.asarray(random_cov(rng, 2)))
        model, mean, cov = one_motion(motion, seen), 5.0 * rng.normal(size=4), 4.0 * random_cov(rng, 4)
        worlds.append(simulated(rng, model, mean, cov, np.ones(N_STEPS)))
    return worlds


@cache
def bearing_worlds(turning: bool = False) -> list[World]:
    """A point that crosses the ray on which bearings jump from π to -π, at constant velocity or gaining speed."""
    worlds = []
    for seed in range(6):
        rng = np.random.default_rng(100 + seed)
        noise = WhiteAcceleration(jnp.asarray(rng.uniform(0.05, 0.5)))
        motion = SpeedChange(jnp.asarray(0.4), noise) if turning else ConstantVelocity(jnp.zeros(2), noise)
        sensor = rng.normal(size=2)
        seen = RangeBearing(jnp.asarray(sensor), jnp.asarray(0.5), jnp.asarray(0.05))
        model, mean, cov = one_motion(motion, seen), np.array([-30.0, 10.0, 0.5, -3.0]), np.diag([4.0, 4.0, 0.2, 0.2])
        dt = rng.uniform(0.5, 1.5, N_STEPS)
        mean = mean + np.array([*sensor, 0.0, 0.0])
        worlds.append(simulated(rng, model, mean, cov, dt))
    return worlds


@cache
def growth_worlds(gaps: bool = True) -> list[World]:
    """The growth series, whose motion and measurement depend on time; the measurement changes on the way."""
    worlds = []
    for seed in range(4):
        rng = np.random.default_rng(200 + seed)
        motion = Growth(jnp.asarray(0.04 * np.pi), jnp.asarray(2.0), 3)
        model = one_motion(motion, GrowthMeasurement(jnp.asarray(0.01), jnp.asarray(8.0)), 1.0, ("level",))
        worlds.append(simulated(rng, model, np.ones(1), 0.75 * np.eye(1), np.ones(N_STEPS), gaps))
    return worlds


def kinematic(dt: float) -> np.ndarray:
    """F of constant velocity in order x, y, vx, vy."""
    return np.kron([[1.0, dt], [0.0, 1.0]], np.eye(2))


def white(psd: float, dt: float) -> np.ndarray:
    """Q of white acceleration in that order."""
    return psd * np.kron([[dt**3 / 3.0, dt**2 / 2.0], [dt**2 / 2.0, dt]], np.eye(2))


class Step(NamedTuple):
    """A step of an oracle's world: motion, its Jacobian and noise, measurement, its Jacobian and noise."""

    f: Callable
    jacobian_f: Callable
    Q: np.ndarray
    h: Callable
    jacobian_h: Callable
    R: np.ndarray
    angles: tuple[bool, ...]


def textbook(world: World) -> list[Step]:
    """The steps of a world in NumPy, written anew."""
    motion, seen = world.model.motions[0], world.model.measurement
    R, time, steps = np.asarray(seen.noise_cov()), float(world.model.start_time), []
    for dt in np.asarray(world.dt):
        time += dt
        match motion:
            case LinearMotion():
                F, b = np.asarray(motion.transition), np.asarray(motion.offset)
                move = lambda x, F=F, b=b: F @ x + b, lambda x, F=F: F, np.asarray(motion.cov)
            case ConstantVelocity():
                F = kinematic(dt)
                move = lambda x, F=F: F @ x, lambda x, F=F: F, white(float(motion.noise.psd), dt)
            case SpeedChange():
                move = *gaining(float(motion.acceleration), dt), white(float(motion.noise.psd), dt)
            case _:
                drive = 1.0 + np.sin(0.04 * np.pi * time)
                move = lambda x, drive=drive: drive + 0.5 * x, lambda x: 0.5 * np.eye(1), 0.75 * np.eye(1)
        match seen:
            case LinearMeasurement() | Position():
                H = np.asarray(seen.matrix) if isinstance(seen, LinearMeasurement) else np.eye(2, 4)
                see = lambda x, H=H: H @ x, lambda x, H=H: H
            case RangeBearing():
                see = ranging(np.asarray(seen.sensor))
            case _ if time <= 8.0:
                see = lambda x: 0.2 * x * x, lambda x: np.diag(0.4 * x)
            case _:
                see = lambda x: 0.5 * x - 2.0, lambda x: 0.5 * np.eye(1)
        steps.append(Step(*move, *see, R, (False, True) if isinstance(seen, RangeBearing) else ()))
    return steps


def gaining(a: float, dt: float) -> tuple[Callable, Callable]:
    """Acceleration along the velocity: f and its Jacobian."""

    def f(x):
        push = dt * a * x[2:] / np.linalg.norm(x[2:])
        return np.concatenate([x[:2] + dt * x[2:] + 0.5 * dt * push, x[2:] + push])

    def jacobian(x):
        speed = np.linalg.norm(x[2:])
        push = dt * a * (np.eye(2) / speed - np.outer(x[2:], x[2:]) / speed**3)
        upper = np.hstack([np.eye(2), dt * np.eye(2) + 0.5 * dt * push])
        return np.vstack([upper, np.hstack([np.zeros((2, 2)), np.eye(2) + push])])

    return f, jacobian


def ranging(sensor: np.ndarray) -> tuple[Callable, Callable]:
    """Range and bearing: h and its Jacobian."""

    def h(x):
        d = x[:2] - sensor
        return np.array([np.hypot(*d), np.arctan2(d[1], d[0])])

    def jacobian(x):
        dx, dy = x[:2] - sensor
        r = np.hypot(dx, dy)
        return np.array([[dx / r, dy / r, 0.0, 0.0], [-dy / r**2, dx / r**2, 0.0, 0.0]])

    return h, jacobian


def ekf_step(x, P, z, s: Step):
    """One scan of the extended filter, which is the Kalman filter of a linear model; z is None for an empty one."""
    x, P = kalman.extended_predict(x, P, s.f, s.jacobian_f, s.Q)
    return (x, P, 0.0, 0.0) if z is None else kalman.extended_update(x, P, z, s.h, s.jacobian_h, s.R, s.angles)


def augmented_prediction(x, P, s: Step, scaling):
    """Moments of the points that hold the process noise, without a measurement."""
    n = len(x)
    stacked = np.zeros((2 * n, 2 * n))
    stacked[:n, :n], stacked[n:, n:] = P, s.Q
    points = unscented.sigma_points(np.concatenate([x, np.zeros(n)]), stacked, scaling)
    w_mean, w_cov = unscented.weights(2 * n, scaling)
    moved = unscented.moments(np.stack([s.f(p[:n]) + p[n:] for p in points]), w_mean)
    return moved.mean, unscented.covariance(moved.deviations, moved.deviations, w_cov)


def ukf_step(rule: str, scaling, x, P, z, s: Step):
    """One scan of the unscented filter in one of its forms."""
    if z is None:
        ahead = (
            augmented_prediction(x, P, s, scaling)
            if rule == "augmented"
            else unscented.predict(x, P, s.f, s.Q, scaling)
        )
        return *ahead, 0.0, 0.0
    if rule == "augmented":
        return unscented.augmented_step(x, P, z, lambda x, v: s.f(x) + v, s.Q, s.h, s.R, scaling, s.angles)
    step = unscented.redrawn_step if rule == "redrawn" else unscented.kept_step
    return step(x, P, z, s.f, s.Q, s.h, s.R, scaling, s.angles)


def oracle(step: Callable, world: World):
    """Means, covariances, log-likelihoods and normalised squares of a sequence."""
    x, P, rows = np.asarray(world.prior.mean), np.asarray(world.prior.cov), []
    for k, s in enumerate(textbook(world)):
        z = np.asarray(world.scans.points[k, 0]) if bool(world.scans.mask[k, 0]) else None
        x, P, log_likelihood, nis = step(x, P, z, s)
        rows.append((x, P, log_likelihood, nis))
    return tuple(np.array(column) for column in zip(*rows, strict=True))


def assert_oracle(answer: Answer, expected) -> None:
    """A filter says what its oracle does, covariances are symmetric to the last bit, and nothing went wrong."""
    found = answer.estimate.mean, answer.estimate.cov, answer.info.log_likelihood, answer.info.nis
    for name, ours, theirs in zip(("mean", "cov", "log-likelihood", "nis"), found, expected, strict=True):
        assert_close(ours, theirs, what=name)
    np.testing.assert_array_equal(answer.estimate.cov, np.swapaxes(answer.estimate.cov, 1, 2))
    assert not (answer.info.status & int(FAILURE)).any()


def answers(settings: dict, worlds: list[World]) -> list[Answer]:
    """One answer per world."""
    both = tracked(settings, stack(worlds), batch=True)
    return [pick(both, k) for k in range(len(worlds))]


KALMAN, PREDICTOR, STEADY = (
    {"kind": "kalman"},
    {"kind": "kalman", "form": "predictor"},
    {"kind": "kalman", "steady_state": True},
)


EKF = {"kind": "ekf"}
UKF = {"kind": "ukf", "alpha": 0.8, "beta": 1.5, "kappa": 0.5}
RULES = ("redrawn", "propagated", "augmented")
SCALING = unscented.Scaling(0.8, 1.5, 0.5)


@cache
def maneuver(name: str = "azimian2005/maneuver") -> StateSpaceModel:
    """The model of a shipped experiment."""
    return state_space_model(load_experiment(name).experiment.model)


def some_cannot_be() -> StateSpaceModel:
    """The four models, of which the last one cannot be reached and the third one only from the second."""
    model = maneuver()
    transition = [[0.9, 0.1, 0.0, 0.0], [0.05, 0.9, 0.05, 0.0], [0.1, 0.0, 0.9, 0.0], [0.2, 0.0, 0.0, 0.8]]
    return StateSpaceModel(
        model.motions, model.measurement, jnp.asarray(transition), jnp.asarray([1.0, 0.0, 0.0, 0.0]), 0.0,
        model.point, model.names,
    )  # fmt: skip


def maneuver_world(model: StateSpaceModel, steps: int = 12, seed: int = 0) -> World:
    """A straight way and a turn by 4 degrees per second, with an empty scan."""
    rng = np.random.default_rng(seed)
    heading = np.radians(4.0) * np.maximum(np.arange(1, steps + 1) - steps // 3, 0)
    way = np.cumsum(150.0 * np.stack([np.cos(heading), np.sin(heading)], 1), axis=0)
    mask = np.arange(steps) != steps // 2
    cov = np.diag([900.0, 900.0, 100.0, 100.0])
    return world_of(model, [20.0, -10.0, 145.0, 5.0], cov, way + 30.0 * rng.normal(size=(steps, 2)), mask)

"""Every filter with its slow oracle, and random tracking problems to run them on.

A new filter is covered by all tests of this folder once it has a row in `CASES`.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import emt.filters.catalogue  # noqa: F401 - registers the filters
from emt.filters.base import TrackingModel, guarded
from emt.filters.feldmann import FeldmannSettings
from emt.filters.gp_ett import GpEttSettings
from emt.filters.mem_ekf_star import MemEkfStarSettings
from emt.filters.vb_random_matrix import VbRandomMatrixSettings
from emt.linalg import Sym2
from emt.models.motion import WhiteAcceleration
from emt.registry import FILTERS
from emt.settings import Settings
from emt.types import Ellipse, Estimate, Filter, Info, Measurements, Prior, StarConvex
from tests.reference import feldmann, gp_ett, mem_ekf_star, vb

N_RUNS, N_STEPS, CAPACITY = 8, 12, 9


class Problem(NamedTuple):
    """One tracking problem, or several with a leading axis."""

    params: Any
    model: TrackingModel
    prior: Prior
    scans: Measurements
    dt: Any


class Report(NamedTuple):
    """What an oracle says after every step, as NumPy arrays with a leading time axis."""

    mean: np.ndarray
    cov: np.ndarray
    outline: np.ndarray
    """Extent matrix of an ellipse, radii of a star-convex shape."""
    orientation: np.ndarray


Oracle = Callable[[Settings, Problem], Report]


@dataclass(frozen=True)
class Case:
    """A filter under test."""

    label: str
    settings: Settings
    oracle: Oracle
    in_units: Callable[[Any, float, float], Any]
    """(params, length, time) -> the same parameters in units `length` times and `time` times smaller."""
    tolerance: float = 1e-9
    """Relative difference from the oracle over a whole sequence."""
    source: Literal["filled", "outline"] = "filled"
    """Where on the object the filter expects the points."""
    order_free: bool = True
    """The order of the points of a scan does not matter."""
    turns: bool = True
    """Turning the world turns the answer by any angle; if not, by half a turn at least."""
    unwrapped: bool = True
    """The orientation is a state, not read from a matrix."""
    any_length_unit: bool = True
    """No constant of the filter is a length."""
    known_shape: Settings | None = None
    """Settings under which the prior shape is taken as the truth."""

    def __str__(self) -> str:
        return self.label

    def params(self, settings: Settings | None = None, dtype=np.float64):
        """Traced parameters as arrays."""
        settings = self.settings if settings is None else settings
        params, _ = FILTERS.get(settings.kind).builder(settings)
        return cast(params, dtype)

    def build(self, params, model: TrackingModel, guard: bool = True) -> Filter:
        """The filter, guarded as in experiments unless asked otherwise."""
        _, make = FILTERS.get(self.settings.kind).builder(self.settings)
        flt = make(params, model)
        return guarded(flt) if guard else flt


def cast(tree, dtype):
    """Every leaf as an array; the floating-point ones in this precision."""

    def leaf(x):
        array = np.asarray(x)
        return jnp.asarray(array.astype(dtype) if array.dtype.kind == "f" else array)

    return jax.tree.map(leaf, tree)


def stack(problems):
    """Pytrees of equal structure as one with a leading axis."""
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *problems)


def pick(tree, i):
    """Entry `i` of the leading axis of every leaf."""
    return jax.tree.map(lambda leaf: leaf[i], tree)


def track(case: Case, problem: Problem, guard: bool = True) -> tuple[Estimate, Info]:
    """One run, predicting before every scan; estimates and diagnostics with a leading time axis."""
    flt = case.build(problem.params, problem.model, guard)
    key = jax.random.key(0)

    def step(state, now):
        scan, dt = now
        state, info = flt.update(flt.predict(state, dt, key), scan, key)
        return state, (flt.estimate(state), info)

    return jax.lax.scan(step, flt.init(problem.prior, key), (problem.scans, problem.dt))[1]


FAST_COMPILE = {"xla_backend_optimization_level": 0, "xla_cpu_use_fusion_emitters": False}
"""For programs that run once: compiling takes longer than running."""


@cache
def tracker(case: Case, guard: bool = True):
    """Jitted `track` of one problem."""
    return jax.jit(partial(track, case, guard=guard), compiler_options=FAST_COMPILE)


@cache
def batch_tracker(case: Case):
    """Jitted `track` of problems with a leading axis."""
    return jax.jit(jax.vmap(partial(track, case)), compiler_options=FAST_COMPILE)


def extent_matrices(semi_axes, orientation):
    """L diag(l1², l2²) Lᵀ with any leading axes, in NumPy."""
    semi_axes, orientation = np.asarray(semi_axes, np.float64), np.asarray(orientation, np.float64)
    c, s = np.cos(orientation), np.sin(orientation)
    turn = np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], -2)
    return (turn * semi_axes[..., None, :] ** 2) @ np.swapaxes(turn, -1, -2)


def report(estimate: Estimate) -> Report:
    """Estimates in the form the oracles report."""
    shape = estimate.shape
    outline = (
        np.asarray(shape.radii)
        if isinstance(shape, StarConvex)
        else extent_matrices(shape.semi_axes, shape.orientation)
    )
    return Report(np.asarray(estimate.mean), np.asarray(estimate.cov), outline, np.asarray(shape.orientation))


def differences(case: Case, actual: Report, expected: Report) -> dict[str, float]:
    """Largest difference of each quantity, relative to its largest entry at that step."""

    def relative(a, b, axes):
        scale = np.maximum(np.abs(b).max(axis=axes, keepdims=True), 1e-300)
        return float((np.abs(a - b) / scale).max()) if np.isfinite(a).all() else np.inf

    found = {
        "position": relative(actual.mean[..., :2], expected.mean[..., :2], -1),
        "velocity": relative(actual.mean[..., 2:], expected.mean[..., 2:], -1),
        "position cov": relative(actual.cov[..., :2, :2], expected.cov[..., :2, :2], (-2, -1)),
        "velocity cov": relative(actual.cov[..., 2:, 2:], expected.cov[..., 2:, 2:], (-2, -1)),
        "cross cov": relative(actual.cov[..., :2, 2:], expected.cov[..., :2, 2:], (-2, -1)),
    }
    if case.unwrapped:
        found["orientation"] = float(np.abs(actual.orientation - expected.orientation).max())
    shape_axes = -1 if case.source == "outline" else (-2, -1)
    found["outline"] = relative(actual.outline, expected.outline, shape_axes)
    return found


def assert_same(case: Case, actual: Report, expected: Report, tolerance: float) -> None:
    """All reported quantities agree."""
    found = differences(case, actual, expected)
    assert max(found.values()) <= tolerance, found


def random_problem(
    case: Case, seed: int, n_steps: int = N_STEPS, capacity: int = CAPACITY, empty: bool = True, settings=None
) -> Problem:
    """A manoeuvring object, random numbers of points per scan (zero and one among them), a wrong prior."""
    rng = np.random.default_rng(seed)
    factor = rng.normal(size=(4, 4))
    cov = factor @ factor.T + np.diag([4.0, 4.0, 1.0, 1.0])
    sensor = rng.normal(size=(2, 2))
    noise = 0.2 * np.eye(2) + 0.1 * sensor @ sensor.T if case.source == "filled" else 0.04 * np.eye(2)
    axes = np.array([6.0, 2.5]) * rng.uniform(0.8, 1.25, 2)
    angle = rng.uniform(-np.pi, np.pi)
    dt = rng.uniform(0.5, 1.5, n_steps)
    mean = np.array([*rng.uniform(-50.0, 50.0, 2), *rng.uniform(-5.0, 5.0, 2)])
    position, velocity, heading = mean[:2] + rng.normal(size=2), mean[2:] + rng.normal(size=2), angle + 0.2
    points, mask = np.zeros((n_steps, capacity, 2)), np.zeros((n_steps, capacity), bool)
    for k in range(n_steps):
        position, velocity = position + dt[k] * velocity, velocity + 0.3 * rng.normal(size=2)
        heading += 0.05 * rng.normal()
        # one point, a full scan and an empty one in every sequence
        n = {0: 1, 1: capacity, 2: 0 if empty else 2}.get(k, int(rng.integers(0 if empty else 1, capacity + 1)))
        around = rng.uniform(0.0, 2.0 * np.pi, capacity)
        radius = np.sqrt(rng.uniform(size=capacity)) if case.source == "filled" else np.ones(capacity)
        body = radius[:, None] * axes * np.stack([np.cos(around), np.sin(around)], 1)
        turn = np.array([[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]])
        drawn = position + body @ turn.T + rng.normal(size=(capacity, 2)) @ np.linalg.cholesky(noise).T
        slots = np.sort(rng.permutation(capacity)[:n])
        points[k, slots], mask[k, slots] = drawn[:n], True
    model = TrackingModel(WhiteAcceleration(rng.uniform(0.05, 0.3)), Sym2.of(noise), 0.25)
    ellipse = Ellipse(axes * rng.uniform(0.8, 1.25, 2), np.asarray(angle))
    scans = Measurements(points, mask, np.zeros(n_steps, bool))
    world = cast((model, Prior(mean, cov, ellipse), scans, dt), np.float64)
    return Problem(case.params(settings), *world)


@cache
def problems(case: Case) -> Problem:
    """The random problems shared by the tests, stacked."""
    return stack([random_problem(case, seed) for seed in range(N_RUNS)])


@cache
def solved(case: Case) -> tuple[Estimate, Info]:
    """Estimates and diagnostics of the shared problems."""
    return batch_tracker(case)(problems(case))


def ragged(scans: Measurements) -> list[np.ndarray]:
    """The real points of every scan, in float64."""
    return [np.asarray(p)[np.asarray(m)] for p, m in zip(scans.points, scans.mask, strict=True)]


def textbook_motion(model: TrackingModel, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """F and Q of nearly constant velocity, in order x, y, vx, vy."""
    psd = float(model.noise.psd)
    F = np.kron([[1.0, dt], [0.0, 1.0]], np.eye(2))
    Q = psd * np.kron([[dt**3 / 3.0, dt**2 / 2.0], [dt**2 / 2.0, dt]], np.eye(2))
    return F, Q


def _reports(rows) -> Report:
    return Report(*(np.array(column) for column in zip(*rows, strict=True)))


def _world(problem: Problem):
    prior = jax.tree.map(lambda x: np.asarray(x, np.float64), problem.prior)
    noise = np.asarray(problem.model.sensor_noise.array(), np.float64)
    return prior, noise, float(problem.model.extent_scale), np.asarray(problem.dt, np.float64)


def vb_oracle(settings: VbRandomMatrixSettings, problem: Problem) -> Report:
    """Sequence of `tests.reference.vb`."""
    prior, noise, scale, times = _world(problem)
    a = np.array(settings.shape)
    state = (
        prior.mean,
        prior.cov,
        float(prior.ellipse.orientation),
        settings.orientation_variance,
        a,
        (a - 1.0) * prior.ellipse.semi_axes**2,
    )
    rows = []
    for dt, y in zip(times, ragged(problem.scans), strict=True):
        F, Q = textbook_motion(problem.model, dt)
        state = vb.predict(*state, F, Q, settings.orientation_noise, settings.forgetting)
        state = vb.update(*state, y, noise, scale, settings.iterations)
        x, P, theta, _, a, b = state
        rows.append((x, P, extent_matrices(vb.semi_axes(a, b), theta), theta))
    return _reports(rows)


def mem_oracle(settings: MemEkfStarSettings, problem: Problem) -> Report:
    """Sequence of `tests.reference.mem_ekf_star`."""
    prior, noise, scale, times = _world(problem)
    shape = np.array([prior.ellipse.orientation, *prior.ellipse.semi_axes])
    state = (prior.mean, prior.cov, shape, np.array(settings.shape_cov))
    rows = []
    for dt, y in zip(times, ragged(problem.scans), strict=True):
        state = mem_ekf_star.predict(*state, *textbook_motion(problem.model, dt), np.array(settings.shape_noise))
        state = mem_ekf_star.update(*state, y, scale * np.eye(2), noise)
        angle, axes = mem_ekf_star.ellipse_read_out(state[2])
        rows.append((state[0], state[1], extent_matrices(axes, angle), angle))
    return _reports(rows)


def feldmann_oracle(settings: FeldmannSettings, problem: Problem) -> Report:
    """Sequence of `tests.reference.feldmann`, under the settings' rule of forgetting."""
    prior, noise, scale, times = _world(problem)
    extent = extent_matrices(prior.ellipse.semi_axes, prior.ellipse.orientation)
    state = (prior.mean, prior.cov, extent, settings.weight)
    rows = []
    for dt, y in zip(times, ragged(problem.scans), strict=True):
        F, Q = textbook_motion(problem.model, dt)
        match settings.decay.kind:
            case "time_constant":
                state = feldmann.predict(*state, F, Q, dt, settings.decay.time)
            case "weight":
                state = feldmann.predict_weight_decay(*state, F, Q, settings.decay.factor)
            case "inverse_wishart":
                state = feldmann.predict_inverse_wishart_decay(*state, F, Q, settings.decay.factor)
        state = feldmann.update(*state, y, noise, scale)
        first = settings.read_out == "first_quadrant"
        angle, axes = feldmann.gottingen_read_out(state[2]) if first else feldmann.major_axis_read_out(state[2])
        rows.append((state[0], state[1], extent_matrices(axes, angle), angle))
    return _reports(rows)


def gp_oracle(settings: GpEttSettings, problem: Problem) -> Report:
    """Sequence of `tests.reference.gp_ett`."""
    prior, noise, _, times = _world(problem)
    n = settings.basis_angles
    basis = 2.0 * np.pi * np.arange(n) / n
    shape = (settings.radius_std, settings.offset_std, settings.length_scale)
    K = gp_ett.kernel(basis, basis, *shape)
    K_inv = gp_ett.kernel_inverse(K, 1e-6)
    a, b = prior.ellipse.semi_axes
    radii = a * b / np.hypot(b * np.cos(basis), a * np.sin(basis))
    x = np.concatenate([prior.mean[:2], [prior.ellipse.orientation], prior.mean[2:], [0.0], radii])
    P = np.zeros((6 + n, 6 + n))
    plane = np.ix_([0, 1, 3, 4], [0, 1, 3, 4])
    P[plane], P[6:, 6:] = prior.cov, K
    P[2, 2], P[5, 5] = settings.orientation_variance, settings.turn_rate_variance
    std = np.sqrt(float(problem.model.noise.psd))
    turn_std, noise_std = np.sqrt(settings.turn_acceleration_psd), np.sqrt(noise[0, 0])
    rows = []
    for dt, y in zip(times, ragged(problem.scans), strict=True):
        x, P = gp_ett.predict(x, P, K, dt, settings.forgetting_rate, std, turn_std)
        x, P = gp_ett.update(x, P, y, basis, K_inv, *shape, noise_std)
        rows.append((x[[0, 1, 3, 4]], P[plane], x[6:], x[2]))
    return _reports(rows)


def _same(params, length, time):
    return params


def _mem_units(params, length, time):
    scale = jnp.array([1.0, length, length])
    unit = scale[:, None] * scale[None, :]
    return type(params)(params.shape_cov * unit, params.shape_noise * unit)


def _time_constant_units(params, length, time):
    return type(params)(params.weight, time * params.decay)


def _gp_units(params, length, time):
    return type(params)(
        length**2 * params.radius_var,
        length**2 * params.offset_var,
        params.length_scale,
        params.orientation_variance,
        params.turn_rate_variance / time**2,
        params.turn_acceleration_psd / time**3,
        params.forgetting_rate / time,
        length**2 * params.outline_variance,
    )


MEM_COV = ((0.1, 0.02, -0.01), (0.02, 0.5, 0.05), (-0.01, 0.05, 0.2))
MEM_NOISE = ((0.01, 0.001, 0.0), (0.001, 0.02, 0.004), (0.0, 0.004, 0.01))
SURE = ((1e-12, 0.0, 0.0), (0.0, 1e-12, 0.0), (0.0, 0.0, 1e-12))
STILL = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
VB = VbRandomMatrixSettings(shape=(12.0, 9.0), orientation_variance=0.1, orientation_noise=0.01, forgetting=0.97)
GP = GpEttSettings(
    basis_angles=12,
    length_scale=0.6,
    orientation_variance=0.01,
    turn_rate_variance=1e-3,
    turn_acceleration_psd=1e-4,
    forgetting_rate=1e-3,
)


def _feldmann(label: str, decay: dict, read_out: str, in_units=_same) -> Case:
    settings = FeldmannSettings(weight=9.0, decay=decay, read_out=read_out)
    known = FeldmannSettings(weight=1e12, decay={"kind": "weight", "factor": 1.0}, read_out=read_out)
    return Case(
        label,
        settings,
        feldmann_oracle,
        in_units,
        unwrapped=False,
        known_shape=known if decay["kind"] == "weight" else None,
    )


CASES = [
    Case(
        "vb_random_matrix",
        VB,
        vb_oracle,
        _same,
        turns=False,
        known_shape=VbRandomMatrixSettings(
            shape=(1e9, 1e9), orientation_variance=1e-9, orientation_noise=0.0, forgetting=1.0
        ),
    ),
    Case(
        "mem_ekf_star",
        MemEkfStarSettings(shape_cov=MEM_COV, shape_noise=MEM_NOISE),
        mem_oracle,
        _mem_units,
        order_free=False,
        known_shape=MemEkfStarSettings(shape_cov=SURE, shape_noise=STILL),
    ),
    _feldmann("feldmann", {"kind": "time_constant", "time": 20.0}, "major_axis", _time_constant_units),
    _feldmann("feldmann_weight", {"kind": "weight", "factor": 0.9}, "major_axis"),
    _feldmann("feldmann_inverse_wishart", {"kind": "inverse_wishart", "factor": 0.97}, "first_quadrant"),
    Case(
        "gp_ett",
        GP,
        gp_oracle,
        _gp_units,
        tolerance=1e-6,
        source="outline",
        any_length_unit=False,
    ),
]
"""One row per filter and rule; see `Case`."""

MAIN = [case for case in CASES if case.label in ("vb_random_matrix", "mem_ekf_star", "feldmann", "gp_ett")]
"""One row per filter."""

POINTS = {"kalman", "ekf", "ukf", "particle", "multiple_model", "likely_model_set", "model_group_switching"}
"""Filters of points."""
ELSEWHERE = {"sampled_posterior", "moment_ukf", "lan_li", "imm", "shape_mixture", *POINTS}
"""Filters with files of tests of their own."""

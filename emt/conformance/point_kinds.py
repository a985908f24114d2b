"""Kinds of golden vectors about points: Kalman filters, interacting and variable-structure multiple models."""

from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from emt.conformance.golden import Quantity, array
from emt.filters.gaussian import Belief, Kernel
from emt.filters.kalman import kalman_kernel
from emt.filters.multiple_model import Bank, multiple_model
from emt.filters.ukf import ukf_kernel
from emt.filters.unscented import Spread
from emt.filters.variable_structure import likely_model_set
from emt.models.state_space.measurements import FunctionMeasurement, LinearMeasurement, Measurement
from emt.models.state_space.model import StateSpaceModel
from emt.models.state_space.motions import LinearMotion
from emt.scans import as_scan
from emt.types import Point, StatePrior

INTERLEAVED = ("x", "vx", "y", "vy")
"""Order of the state in the vectors of FilterPy."""
ZERO, ONE = jnp.zeros(()), jnp.ones(())


def _model(motions, measurement: Measurement, transition, start, names=INTERLEAVED) -> StateSpaceModel:
    modes = tuple(f"m{k + 1}" for k in range(len(motions)))
    point = Point(names, measurement.noise_cov().shape[0])
    return StateSpaceModel(tuple(motions), measurement, array(transition), array(start), 0.0, point, modes)


def _range_bearing(state, time):
    return jnp.stack([jnp.hypot(state[0], state[2]), jnp.arctan2(state[2], state[0])])


def _nonlinear_case(case: dict) -> tuple[StateSpaceModel, LinearMotion]:
    """The model of a case of an extended or unscented filter; bearings are subtracted plainly there."""
    motion = LinearMotion(array(case["F"]), jnp.zeros(4), array(case["Q"]))
    measurement = FunctionMeasurement(array(case["R"]), _range_bearing, ())
    return _model([motion], measurement, [[1.0]], [1.0]), motion


def _kernel_steps(kernel: Kernel, case: dict) -> Iterator[tuple[dict, Any, Any, Any]]:
    """(expected, prediction, belief, innovation) of every step."""
    predict, update = jax.jit(kernel.predict), jax.jit(kernel.update)
    belief = Belief(array(case["x0"]), array(case["P0"]))
    for step in case["steps"]:
        now = predict(belief, ZERO, ONE)
        belief, innovation = update(now, array(step["z"]), ZERO)
        yield step, now, belief, innovation


def _moments(step: dict, now: Any, belief: Belief) -> Iterator[Quantity]:
    yield Quantity("predicted mean", now.belief.mean, step["x_prior"])
    yield Quantity("predicted covariance", now.belief.cov, step["P_prior"])
    yield Quantity("mean", belief.mean, step["x"])
    yield Quantity("covariance", belief.cov, step["P"])


def compare_ekf(content: dict) -> Iterator[Quantity]:
    """Sequences of an extended Kalman filter with range and bearing."""
    for case in content["cases"]:
        model, motion = _nonlinear_case(case)
        for step, now, belief, innovation in _kernel_steps(kalman_kernel(model, motion), case):
            _, jacobian = model.measurement.linearised(now.belief.mean, ZERO)
            yield Quantity("Jacobian", jacobian, step["H"])
            yield from _moments(step, now, belief)
            yield Quantity("log-likelihood", innovation.log_likelihood, step["log_likelihood"])


def compare_ukf(content: dict) -> Iterator[Quantity]:
    """Sequences of an unscented Kalman filter with sigma points drawn anew after the prediction."""
    for case in content["cases"]:
        model, motion = _nonlinear_case(case)
        spread = Spread(*(jnp.asarray(float(case[name])) for name in ("alpha", "kappa", "beta")))
        for step, now, belief, _ in _kernel_steps(ukf_kernel(model, motion, spread, "redrawn"), case):
            yield Quantity("sigma points", now.points, step["sigmas_f"])
            yield from _moments(step, now, belief)


def compare_imm(content: dict) -> Iterator[Quantity]:
    """Sequences of an IMM whose models start from means of their own."""
    for case in content["cases"]:
        motions = [LinearMotion(array(f), jnp.zeros(4), array(q)) for f, q in zip(case["F"], case["Q"], strict=True)]
        measurement = LinearMeasurement(array(case["H"]), array(case["R"]))
        flt = multiple_model(_model(motions, measurement, case["M"], case["mu0"]), "imm", ZERO)
        predict, update, estimate, key = (
            jax.jit(flt.predict),
            jax.jit(flt.update),
            jax.jit(flt.estimate),
            jax.random.key(0),
        )
        state = Bank(array(case["mu0"]), Belief(array(case["x0"]), array(case["P0"])), ZERO)
        for step in case["steps"]:
            state = predict(state, ONE, key)
            yield Quantity("predicted probabilities", state.probability, step["cbar"])
            yield Quantity("predicted means of models", state.beliefs.mean, step["model_x_prior"])
            state, _ = update(state, as_scan(array(step["z"])[None, :]), key)
            yield Quantity("probabilities", state.probability, step["mu"])
            yield Quantity("means of models", state.beliefs.mean, step["model_x"])
            yield Quantity("covariances of models", state.beliefs.cov, step["model_P"])
            combined = estimate(state)
            yield Quantity("mean", combined.mean, step["x"])
            yield Quantity("covariance", combined.cov, step["P"])


def _mask(numbers: Any, n: int) -> np.ndarray:
    """0 or 1 for each model of a set given by numbers from 1."""
    return np.isin(np.arange(1, n + 1), np.asarray(numbers, int).ravel()).astype(float)


def compare_vsimm(content: dict) -> Iterator[Quantity]:
    """Sequences of a variable-structure IMM that adds adjacent models and drops unlikely ones; sets must be equal.

    Its matrix has columns of sum 1. Strategy 2 keeps at least `n_min` models, strategy 1 all that are not unlikely.
    """
    for case in content["cases"]:
        accelerations, first = np.asarray(case["a"], float), np.asarray(case["pmup0"], float).ravel()
        n = accelerations.shape[1]
        transition, noise = np.asarray(case["P"], float).T, array(case["Sigmaw"])
        pushes = np.asarray(case["Bq"], float) @ accelerations
        motions = [LinearMotion(array(case["A"]), array(pushes[:, k]), noise) for k in range(n)]
        measurement = LinearMeasurement(array(case["C"]), array(case["Sigmav"]))
        start = np.concatenate([first, np.zeros(n - len(first))])
        model = _model(motions, measurement, transition, start, ("x", "y", "vx", "vy"))
        low, high = (jnp.asarray(float(t)) for t in case["thresholds"])
        keep = int(case["n_min"]) if case["strategy"] == 2 else 0
        flt = likely_model_set(model, low, high, keep, True, tuple(range(len(first))))
        predict, update, estimate, key = (
            jax.jit(flt.predict),
            jax.jit(flt.update),
            jax.jit(flt.estimate),
            jax.random.key(0),
        )
        state = flt.init(StatePrior(array(case["xp0"]).ravel(), array(case["P0"])), key)
        for k, step in enumerate(case["steps"]):
            state = predict(state, ONE, key) if k else state
            yield Quantity("active set before", state.active, _mask(step["active_pred"], n), 1.0, 0.0)
            state, info = update(state, as_scan(array(step["y"]).reshape(1, -1)), key)
            yield Quantity("active set after", state.probability > 0.0, _mask(step["active_post"], n), 1.0, 0.0)
            yield Quantity("models run", info.active_models, float(np.size(step["active_post"])), 1.0, 0.0)
            yield Quantity("active set next", state.active, _mask(step["active_next"], n), 1.0, 0.0)
            expected = np.array([0.0 if p is None else p for p in np.ravel(step["pmuf"])])
            yield Quantity("probabilities", state.probability, expected)
            yield Quantity("mean", estimate(state).mean, np.ravel(step["x"]))

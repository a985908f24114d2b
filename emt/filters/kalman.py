"""Kalman filters: for linear models, in filter and in predictor form, and extended by linearisation."""

from typing import Literal, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from emt.filters.gaussian import Belief, Innovation, Kernel, Prediction, conditioned, predicted, symmetric, updated
from emt.filters.riccati import steady_covariance
from emt.filters.state_space import gaussian_filter, info_of, linear_faults, motion_faults, reading, report
from emt.models.state_space.model import StateSpaceModel
from emt.models.state_space.motions import Motion
from emt.registry import FILTERS
from emt.settings import PointSettings
from emt.types import Filter, Measurements, Scalar


class KalmanSettings(PointSettings):
    """Kalman filter of a linear model, recursive or in its steady state."""

    kind: Literal["kalman"] = "kalman"
    motion: str | None = None
    """Motion of the model it believes in; needed where there are several."""
    form: Literal["filter", "predictor"] = "filter"
    """Whether it reports the state given all scans, or the prediction from those before, by the one-step predictor."""
    steady_state: bool = False
    """Whether the gain is that of infinitely many steps from the start on."""

    def faults_with(self, model) -> list[tuple[str, str]]:
        """What does not fit the model, by key."""
        faults = motion_faults(model, self.motion) or linear_faults(model, self.motion)
        if self.steady_state and self.form == "predictor":
            faults.append(("steady_state", "goes with form: filter"))
        return faults


class EkfSettings(PointSettings):
    """Extended Kalman filter, by derivatives of motion and measurement."""

    kind: Literal["ekf"] = "ekf"
    motion: str | None = None
    """Motion of the model it believes in; needed where there are several."""

    def faults_with(self, model) -> list[tuple[str, str]]:
        """What does not fit the model, by key."""
        return motion_faults(model, self.motion)


def kalman_kernel(
    model: StateSpaceModel,
    motion: Motion,
    noise_cov: Float[Array, "n n"] | None = None,
    measurement_cov: Float[Array, "m m"] | None = None,
) -> Kernel:
    """Kalman filter, extended where motion or measurement is not linear.

    Jacobians are taken by forward differentiation: of the motion at the last mean, of the measurement at the predicted
    one.

    Args:
        noise_cov, measurement_cov: noises to believe in, if not those of the model.

    Source: Kalman 1960; Azimian 2005, sections 1.2 and 2.1.
    """

    def predict(belief: Belief, time: Scalar, dt: Scalar) -> Prediction:
        return Prediction(predicted(belief, motion, motion.noise_cov(dt) if noise_cov is None else noise_cov, time, dt))

    def update(now: Prediction, value: Float[Array, "m"], time: Scalar) -> tuple[Belief, Innovation]:
        cov = model.measurement.noise_cov() if measurement_cov is None else measurement_cov
        return updated(now.belief, model.measurement, cov, value, time)

    return Kernel(Prediction, predict, update)


def steady_kernel(model: StateSpaceModel, motion: Motion) -> Kernel:
    """Kalman filter of a linear model whose covariances are those of its steady state from the first step on."""
    plain = kalman_kernel(model, motion)

    def predict(belief: Belief, time: Scalar, dt: Scalar) -> Prediction:
        mean = plain.predict(belief, time, dt).belief.mean
        zero = jnp.zeros_like(mean)
        (_, transition), (_, matrix) = motion.linearised(zero, time, dt), model.measurement.linearised(zero, time)
        cov = steady_covariance(transition, matrix, motion.noise_cov(dt), model.measurement.noise_cov())
        return Prediction(Belief(mean, cov))

    return plain._replace(predict=predict)


class PredictorState(NamedTuple):
    """The prediction for a scan, and the scan itself until the next step takes it in."""

    belief: Belief
    time: Scalar
    value: Float[Array, "m"]
    seen: Bool[Array, ""]


def predictor_step(
    belief: Belief,
    value: Float[Array, "m"],
    model: StateSpaceModel,
    motion: Motion,
    time: Scalar,
    dt: Scalar,
) -> Belief:
    """One-step predictor: from the prediction for this scan to that for the next one, `dt` seconds later at `time`.

    x̂ ← G x̂ + b + K (y - C x̂) and P ← G P (G - K C)ᵀ + Q with K = G P Cᵀ (C P Cᵀ + R)⁻¹.

    Source: Azimian 2005, eqs. 1.9 to 1.11, where C' in 1.11 should read C.
    """
    moved, transition = motion.linearised(belief.mean, time, dt)
    expected, matrix = model.measurement.linearised(belief.mean, time - dt)
    cross = belief.cov @ matrix.T
    innovation_cov = matrix @ cross + model.measurement.noise_cov()
    innovation = model.measurement.difference(value, expected)
    carried = Belief(moved, symmetric(transition @ belief.cov @ transition.T))
    new, _ = conditioned(carried, transition @ cross, innovation_cov, innovation)
    return Belief(new.mean, new.cov + motion.noise_cov(dt))


def kalman_predictor(model: StateSpaceModel, motion: Motion) -> Filter:
    """Kalman filter in predictor form: it reports the prediction for each scan."""

    def init(prior, key) -> PredictorState:
        dtype = prior.mean.dtype
        nothing = jnp.zeros(model.point.measured, dtype)
        start = jnp.asarray(model.start_time, dtype)
        return PredictorState(Belief(prior.mean, prior.cov), start, nothing, jnp.asarray(False))

    def predict(state: PredictorState, dt: Scalar, key) -> PredictorState:
        time = state.time + dt
        with_scan = predictor_step(state.belief, state.value, model, motion, time, dt)
        without = predicted(state.belief, motion, motion.noise_cov(dt), time, dt)
        mean = jnp.where(state.seen, with_scan.mean, without.mean)
        cov = jnp.where(state.seen, with_scan.cov, without.cov)
        return PredictorState(Belief(mean, cov), time, jnp.zeros_like(state.value), jnp.asarray(False))

    def update(state: PredictorState, scan: Measurements, key):
        value, seen = reading(scan)
        _, innovation = updated(state.belief, model.measurement, model.measurement.noise_cov(), value, state.time)
        return state._replace(value=value, seen=seen), info_of(innovation, seen)

    return Filter(init, predict, update, lambda state: report(model, state.belief))


def build(settings: KalmanSettings | EkfSettings):
    """No numbers of its own, and the builder of the filter."""
    name = settings.motion

    def make(params, model: StateSpaceModel) -> Filter:
        motion = model.motion(name)
        if isinstance(settings, KalmanSettings) and settings.form == "predictor":
            return kalman_predictor(model, motion)
        steady = isinstance(settings, KalmanSettings) and settings.steady_state
        return gaussian_filter(model, (steady_kernel if steady else kalman_kernel)(model, motion))

    return {}, make


FILTERS.register("kalman", KalmanSettings, build)
FILTERS.register("ekf", EkfSettings, build)

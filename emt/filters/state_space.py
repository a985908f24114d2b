"""What filters of points share: their prior, their reports, and how a scan is read."""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from emt.filters.gaussian import GROSS_NIS, Belief, Innovation, Kernel, Prediction
from emt.models.state_space.model import StateSpaceModel
from emt.registry import UnknownName, suggest
from emt.status import Status
from emt.types import Estimate, Filter, Info, Measurements, Scalar


def reading(scan: Measurements) -> tuple[Float[Array, "m"], Bool[Array, ""]]:
    """The measurement of a scan, which holds at most one, and whether there is one."""
    if scan.points.shape[0] != 1:
        raise TypeError(f"a filter of a point takes one measurement per scan, not {scan.points.shape[0]}")
    return scan.points[0], scan.mask[0]


def report(model: StateSpaceModel, belief: Belief, modes: dict[str, Scalar] | None = None) -> Estimate:
    """An estimate of a point."""
    return Estimate(belief.mean, belief.cov, model.point, modes)


class GaussianState(NamedTuple):
    """Prediction or belief at a time (s)."""

    now: Prediction
    time: Scalar


def gaussian_filter(model: StateSpaceModel, kernel: Kernel) -> Filter:
    """The filter that predicts and conditions by a kernel."""

    def init(prior, key) -> GaussianState:
        now = kernel.start(Belief(prior.mean, prior.cov))
        return GaussianState(now, jnp.asarray(model.start_time, prior.mean.dtype))

    def predict(state: GaussianState, dt: Scalar, key) -> GaussianState:
        time = state.time + dt
        return GaussianState(kernel.predict(state.now.belief, time, dt), time)

    def update(state: GaussianState, scan: Measurements, key) -> tuple[GaussianState, Info]:
        value, seen = reading(scan)
        belief, innovation = kernel.update(state.now, value, state.time)
        return GaussianState(state.now._replace(belief=belief), state.time), info_of(innovation, seen)

    return Filter(init, predict, update, lambda state: report(model, state.now.belief))


def info_of(innovation: Innovation, seen: Bool[Array, ""], **extra: Any) -> Info:
    """Diagnostics of an update; zeros where the scan is empty."""
    gross = seen & ~(innovation.nis <= GROSS_NIS)  # also where it is not a number
    return Info(
        jnp.where(seen, innovation.log_likelihood, 0.0),
        jnp.where(seen, innovation.nis, 0.0),
        jnp.where(gross, int(Status.GROSS_INNOVATION), 0),
        **extra,
    )


def linear_faults(model: Any, motion: str | None) -> list[tuple[str, str]]:
    """Whether a motion of the model and its measurement are linear, as (key, fault) of a filter that needs it."""
    name = next(iter(model.named_motions)) if motion is None else motion
    if name not in model.named_motions:
        return []
    settings = model.named_motions[name]
    nonlinear = [f"motion '{settings.kind}'"] * (not settings.build().is_linear)
    nonlinear += [f"measurement '{model.measurement.kind}'"] * (not model.measurement.build().is_linear)
    if not nonlinear:
        return []
    return [("kind", f"a Kalman filter needs a linear model, and {' and '.join(nonlinear)} is not; use ekf or ukf")]


def motion_faults(model: Any, motion: str | None) -> list[tuple[str, str]]:
    """Whether the motion a filter asks for is there, and which it means if there are several."""
    names = tuple(model.named_motions)
    if motion is None and len(names) > 1:
        return [("motion", f"is required, as the model has several: {', '.join(names)}")]
    if motion is not None and motion not in names:
        return [("motion", str(UnknownName(motion, names, suggest(motion, names), "motion")))]
    return []

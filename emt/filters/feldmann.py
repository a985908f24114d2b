"""Random-matrix filter of Feldmann, Fränken and Koch."""

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal, NamedTuple

import jax.numpy as jnp
from jax.tree_util import register_dataclass
from pydantic import Field

from emt.filters import kinematics
from emt.filters.base import TrackingModel, innovation_info
from emt.filters.kinematics import Kinematics
from emt.linalg import Sym2, parallel
from emt.registry import FILTERS
from emt.scans import ScanStatistics, scan_statistics
from emt.settings import Duration, PositiveFloat, Settings, UnitInterval
from emt.types import Ellipse, Estimate, Filter, Measurements, Prior, Scalar, Traced


class TimeConstant(Settings):
    """Weight above 2 decays with a time constant; the extent is kept (Feldmann et al. 2011)."""

    kind: Literal["time_constant"] = "time_constant"
    time: Duration


class WeightDecay(Settings):
    """The weight is multiplied by a factor per step; the extent is kept."""

    kind: Literal["weight"] = "weight"
    factor: UnitInterval


class InverseWishartDecay(Settings):
    """Degrees of freedom (weight + 6) and scale matrix are both multiplied by a factor per step.

    The extent grows by factor (ν - 6) / (factor ν - 6); the degrees of freedom stay above 6.
    """

    kind: Literal["inverse_wishart"] = "inverse_wishart"
    factor: UnitInterval


class FeldmannSettings(Settings):
    """Random matrix with sensor noise (Feldmann, Fränken and Koch 2011)."""

    kind: Literal["feldmann"] = "feldmann"
    reads_points: ClassVar[bool] = False
    weight: PositiveFloat
    """Prior weight of the extent, in points (ν - 6 of an inverse Wishart)."""
    decay: Annotated[TimeConstant | WeightDecay | InverseWishartDecay, Field(discriminator="kind")]
    """How the weight is forgotten with time."""
    read_out: Literal["first_quadrant", "major_axis"] = "major_axis"
    """Which axis gives the orientation: the one in [0, 90] degrees, as in the Göttingen code, or the major one."""


@register_dataclass
@dataclass(frozen=True)
class Params:
    """Traced numbers of the filter."""

    weight: Traced
    decay: Traced
    """Time constant (s) or factor per step."""


class FeldmannState(NamedTuple):
    """Gaussian kinematics and an extent with a weight."""

    kinematics: Kinematics
    extent: Sym2
    """Estimated extent L diag(l1², l2²) Lᵀ (m²)."""
    weight: Scalar
    """Number of points the extent is worth."""


DOF_OFFSET = 6.0
"""Degrees of freedom of an inverse Wishart in the plane minus the weight of its mean: ν = weight + 6."""
MIN_WEIGHT = 1.0
"""Floor of the weight (one point) under the rules that would take it to zero; the extent is kept there."""


def update(state: FeldmannState, stats: ScanStatistics, model: TrackingModel) -> FeldmannState:
    """Measurement update (Feldmann et al. 2011, eqs. 28-40).

    The scan mean is a measurement of the centre with covariance Y/m, Y = zX + R with the predicted X; innovation and
    scatter, brought to the size of the extent by matrix square roots, are averaged with it.
    """
    m = jnp.maximum(stats.count, 1.0)
    spread = model.extent_scale * state.extent + model.sensor_noise
    mean_noise = (1.0 / m) * spread
    belief = state.kinematics
    innovation_cov = belief.position_cov + mean_noise
    innovation = stats.mean - belief.position
    position = belief.position + belief.position_cov @ (innovation_cov.inverse() @ innovation)
    position_cov = parallel(belief.position_cov, mean_noise)

    root = state.extent.sqrt()
    scaled = root @ (innovation_cov.inverse().sqrt() @ innovation)
    shrink = root @ spread.inverse().sqrt()
    weight = state.weight + stats.count
    total = state.weight * state.extent + scaled.outer() + shrink.congruence(stats.scatter)
    return FeldmannState(kinematics.with_position(belief, position, position_cov), (1.0 / weight) * total, weight)


def forget(state: FeldmannState, rule: str, decay: Scalar, dt: Scalar) -> FeldmannState:
    """The extent part of the time update under one of the three rules."""
    match rule:
        case "time_constant":
            return state._replace(weight=2.0 + jnp.exp(-dt / decay) * (state.weight - 2.0))
        case "weight":
            return state._replace(weight=jnp.maximum(decay * state.weight, MIN_WEIGHT))
        case _:
            weight = decay * (state.weight + DOF_OFFSET) - DOF_OFFSET
            growth = jnp.where(weight > MIN_WEIGHT, decay * state.weight / jnp.maximum(weight, MIN_WEIGHT), 1.0)
            return state._replace(weight=jnp.maximum(weight, MIN_WEIGHT), extent=growth * state.extent)


def first_quadrant_axis(extent: Sym2) -> Ellipse:
    """Axes with the orientation read in [0, 90] degrees, whichever axis that is.

    Equals φ = atan(-ρ + √(1+ρ²)), ρ = (X11 - X22)/(2 X12), of the code published by the Göttingen group, and is also
    defined for X12 = 0. The axis may be the major or the minor one: compare orientations with care.
    """
    larger, smaller, direction = extent.eigen()
    turned = direction < 0.0
    a, b = jnp.sqrt(larger), jnp.sqrt(smaller)
    axes = jnp.stack([jnp.where(turned, b, a), jnp.where(turned, a, b)])
    return Ellipse(axes, jnp.where(turned, direction + 0.5 * jnp.pi, direction))


def major_axis(extent: Sym2) -> Ellipse:
    """Axes with the major one first, its direction in (-90, 90] degrees."""
    larger, smaller, direction = extent.eigen()
    return Ellipse(jnp.sqrt(jnp.stack([larger, smaller])), direction)


def feldmann(rule: str, read_out: str, params: Params, model: TrackingModel) -> Filter:
    """Random-matrix filter with sensor noise.

    Source: M. Feldmann, D. Fränken and W. Koch, IEEE Trans. Signal Process. 59 (2011), doi:10.1109/TSP.2010.2101064.
    """
    shape_of = first_quadrant_axis if read_out == "first_quadrant" else major_axis

    def init(prior: Prior, key) -> FeldmannState:
        axes = prior.ellipse.semi_axes
        extent = Sym2.ellipse(axes[0], axes[1], prior.ellipse.orientation)
        return FeldmannState(Kinematics.of(prior.mean, prior.cov), extent, params.weight)

    def predict_step(state, dt, key):
        state = state._replace(kinematics=kinematics.predict(state.kinematics, model.noise(dt), dt))
        return forget(state, rule, params.decay, dt)

    def update_step(state: FeldmannState, scan: Measurements, key):
        spread = model.extent_scale * state.extent + model.sensor_noise
        info = innovation_info(state.kinematics.position, state.kinematics.position_cov, spread, scan)
        return update(state, scan_statistics(scan), model), info

    def estimate(state: FeldmannState) -> Estimate:
        return Estimate(state.kinematics.mean(), state.kinematics.cov(), shape_of(state.extent))

    return Filter(init, predict_step, update_step, estimate)


def build(settings: FeldmannSettings):
    """Traced parameters and static builder of the settings."""
    rule, read_out = settings.decay.kind, settings.read_out
    amount = settings.decay.time if isinstance(settings.decay, TimeConstant) else settings.decay.factor
    return Params(settings.weight, amount), lambda params, model: feldmann(rule, read_out, params, model)


FILTERS.register("feldmann", FeldmannSettings, build)

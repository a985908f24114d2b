"""Unscented Kalman filter on image moments, with constant-velocity or coordinated-turn motion.

Arrays may have further axes behind those shown; everything is computed along them (see `emt.lanes`).
"""

from dataclasses import dataclass
from functools import partial
from typing import Annotated, ClassVar, Literal

import jax
import jax.numpy as jnp
from jax.tree_util import register_dataclass
from jaxtyping import Array, Bool, Float, Int
from pydantic import Field, model_validator

from emt.filters.base import TrackingModel, innovation_info, keep_if
from emt.filters.moment_update import Projection, augmented_update, expected, moments_in, point_update, projected
from emt.filters.unscented import Gaussian, Spread, merge_gaussians, product, square_root
from emt.lanes import PerRun, lanes_last, total
from emt.linalg import Sym2, Vec2
from emt.logarithm import log
from emt.models.turn import coordinated_turn
from emt.registry import FILTERS
from emt.settings import (
    AccelerationDensity,
    Area,
    MomentCovariance,
    MomentNoise,
    PositiveFloat,
    Quantity,
    Settings,
    UnitInterval,
)
from emt.shapes.moments import ellipse_of, moments_of
from emt.status import Status
from emt.types import Estimate, Filter, Measurements, Prior, Traced

KINEMATIC = jnp.array([3, 5, 4, 6])
"""Rows of x, y, vx, vy in the state (n11, n20, n02, x, vx, y, vy[, turn rate])."""


class ConstantVelocity(Settings):
    """Constant moments and velocity (7 states)."""

    kind: Literal["constant_velocity"] = "constant_velocity"
    psd: AccelerationDensity
    """Power spectral density of the acceleration on each axis."""
    moment_noise: MomentNoise
    """Covariance added to (n11, n20, n02) per step."""


class CoordinatedTurn(Settings):
    """Moments and velocity turn with the turn rate, which is estimated (8 states). Noise per step."""

    kind: Literal["coordinated_turn"] = "coordinated_turn"
    moment_noise: MomentNoise
    """Covariance added to (n11, n20, n02) per step."""
    acceleration_variance: Annotated[float, Quantity("m^2/s^4", ge=0)]
    """Variance of the acceleration on each axis, constant over a step."""
    turn_acceleration_variance: Annotated[float, Quantity("rad^2/s^4", ge=0)]
    """Variance of the turn acceleration, constant over a step."""


class ProjectionSettings(Settings):
    """Keeps the eigenvalues of the moment matrix apart from zero."""

    ratio: UnitInterval = 0.01
    """Least ratio of the smaller to the larger eigenvalue (of the squared semi-axes)."""
    floor: Area
    """Least value of the larger eigenvalue, a quarter of the squared semi-axis."""


class MomentUkfSettings(Settings):
    """Image-moment random hypersurface model with an unscented Kalman filter (Yao, Saltus and Dani 2020)."""

    kind: Literal["moment_ukf"] = "moment_ukf"
    motion: Annotated[ConstantVelocity | CoordinatedTurn, Field(discriminator="kind")]
    moment_cov: MomentCovariance
    """Prior covariance of (n11, n20, n02)."""
    gamma: PositiveFloat = 1.0
    kappa: float = 0.0
    beta: float = 2.0
    """Constants of the scaled unscented transform; the step is gamma √(dimension + kappa) standard deviations."""
    projection: ProjectionSettings | None = None
    augmented: bool = False
    """The update as printed in the paper, slower: sigma points of the augmented state and a factorisation per point."""
    family: ClassVar[str] = "moments"

    @model_validator(mode="after")
    def _finite_weights(self):
        least = 9 if self.motion.kind == "constant_velocity" else 10
        if self.kappa <= -least:
            raise ValueError(
                f"kappa must be greater than -{least}, or a weight of the unscented transform is not finite"
            )
        return self


@register_dataclass
@dataclass(frozen=True)
class Params:
    """Traced numbers of the filter."""

    moment_cov: Float[Array, "3 3 *lanes"]
    moment_noise: Float[Array, "3 3 *lanes"]
    acceleration: Traced
    """Power spectral density or variance, by the motion."""
    turn_acceleration: Traced
    spread: Spread
    projection: Projection | None


def blocks(moments, position_velocity, turn_rate=None) -> Float[Array, "n n *lanes"]:
    """Block-diagonal covariance of the state: moments (3, 3), one axis (2, 2) for both axes, turn rate."""
    n = 7 if turn_rate is None else 8
    cov = jnp.zeros((n, n, *moments.shape[2:]), moments.dtype).at[:3, :3].set(moments)
    axis = position_velocity.reshape(2, 2, *(1,) * (cov.ndim - position_velocity.ndim), *position_velocity.shape[2:])
    cov = cov.at[3:5, 3:5].set(axis).at[5:7, 5:7].set(axis)
    return cov if turn_rate is None else cov.at[7, 7].set(turn_rate)


def predict_linear(belief: Gaussian, dt: PerRun, params: Params) -> Gaussian:
    """Constant velocity and moments (Yao et al. 2020, eqs. 13, 14, 26, 27)."""
    square = params.acceleration * dt * dt
    axis = jnp.stack(
        [jnp.stack([square * dt / 3.0, square / 2.0]), jnp.stack([square / 2.0, params.acceleration * dt])]
    )

    def move(state):
        return state.at[3].add(dt * state[4]).at[5].add(dt * state[6])

    cov = product(move(belief.root)) + blocks(params.moment_noise, axis)
    return Gaussian(move(belief.mean), square_root(cov))


def turn(state, dt: PerRun):
    """Coordinated turn of one state (8,) or of many (8, m): moments, position and velocity (eqs. 15-20)."""
    position, velocity = coordinated_turn(Vec2(state[3], state[5]), Vec2(state[4], state[6]), state[7], dt)
    mean, half = 0.5 * (state[1] + state[2]), 0.5 * (state[1] - state[2])
    c, s = jnp.cos(2.0 * state[7] * dt), jnp.sin(2.0 * state[7] * dt)
    n11, half = c * state[0] + s * half, c * half - s * state[0]
    rows = [n11, mean + half, mean - half, position.x, velocity.x, position.y, velocity.y, state[7]]
    return jnp.stack(rows)


def predict_turn(belief: Gaussian, dt: PerRun, params: Params) -> Gaussian:
    """Unscented prediction of a coordinated turn; the six additive noises collapse to their covariance."""
    c = params.spread.squared_step(8 + 6)
    step = jnp.sqrt(c) * belief.root
    center = turn(belief.mean, dt)
    plus = turn(belief.mean[:, None] + step, dt) - center[:, None]
    minus = turn(belief.mean[:, None] - step, dt) - center[:, None]
    bend = total(jnp.moveaxis(plus + minus, 1, 0)) / (2.0 * c)
    half, full = 0.5 * dt * dt, dt
    axis = params.acceleration * jnp.stack(
        [jnp.stack([half * half, half * full]), jnp.stack([half * full, full * full])]
    )
    cov = (
        (product(plus) + product(minus)) / (2.0 * c)
        + (params.spread.beta - params.spread.gamma**2) * bend[:, None] * bend[None, :]
        + blocks(params.moment_noise, axis, params.turn_acceleration * dt * dt)
    )
    return Gaussian(center + bend, square_root(cov))


def update(
    belief: Gaussian, points, mask, noise: Sym2, params: Params, one=point_update
) -> tuple[Gaussian, Bool[Array, "*lanes"]]:
    """Sequential update by the points of a scan in their order, and whether a mean had to be projected."""

    def body(j, carry):
        now, before = carry
        new = one(now, Vec2(points[j, 0], points[j, 1]), noise, params.spread, params.projection)
        new, acted = projected(new, params.projection)
        return keep_if(mask[j], (new, before | acted), carry)

    return jax.lax.fori_loop(0, last_of(mask), body, (belief, jnp.zeros(mask.shape[1:], bool)))


def last_of(mask: Bool[Array, "max_points *lanes"]) -> Int[Array, ""]:
    """Slots up to the last real point, of the fullest scan if there are several: padding at the end costs nothing."""
    filled = mask.reshape(mask.shape[0], -1).any(axis=1)
    return jnp.where(filled, jnp.arange(mask.shape[0]) + 1, 0).max()


def log_likelihood(belief: Gaussian, points, mask, noise: Sym2, params: Params) -> PerRun:
    """Sum over the points of log N(0; mean, variance) of their pseudo-measurements, all under the prediction
    (Yao et al. 2020, Algorithm 2, which takes the average)."""

    def body(j, before):
        now = expected(belief, Vec2(points[j, 0], points[j, 1]), noise, params.spread, params.projection)
        one = -0.5 * (now.mean * now.mean / now.variance + log(2.0 * jnp.pi * now.variance))
        return before + jnp.where(mask[j], one, 0.0)

    return jax.lax.fori_loop(0, last_of(mask), body, jnp.zeros(mask.shape[1:], points.dtype))


def resized(belief: Gaussian, n: int) -> tuple[Float[Array, "n *lanes"], Float[Array, "n n *lanes"]]:
    """Mean and covariance with the turn rate dropped, or appended as a zero that is known exactly."""
    have, cov = belief.mean.shape[0], belief.cov()
    if have >= n:
        return belief.mean[:n], cov[:n, :n]
    more, none = (0, n - have), [(0, 0)] * (cov.ndim - 2)
    return jnp.pad(belief.mean, [more, *none]), jnp.pad(cov, [more, more, *none])


def moment_ukf(turning: bool, augmented: bool, params: Params, model: TrackingModel) -> Filter:
    """Image-moment filter with one motion model.

    Source: G. Yao, R. Saltus and A. Dani, IEEE Sensors J. 20 (2020), doi:10.1109/JSEN.2020.2976540.
    """
    n = 8 if turning else 7

    def init(prior: Prior, key) -> Gaussian:
        moments, kinematic = moments_of(prior.ellipse), prior.cov
        mean = jnp.zeros(n, kinematic.dtype).at[KINEMATIC].set(prior.mean)
        mean = mean.at[:3].set(jnp.stack([moments.xy, moments.xx, moments.yy]))
        cov = jnp.zeros((n, n), kinematic.dtype).at[:3, :3].set(params.moment_cov)
        cov = cov.at[KINEMATIC[:, None], KINEMATIC[None, :]].set(kinematic)
        if turning:
            mean, cov = mean.at[7].set(prior.turn_rate), cov.at[7, 7].set(prior.turn_rate_var)
        return Gaussian(mean, square_root(cov))

    @lanes_last
    def mapped_estimate(belief: Gaussian) -> Estimate:
        kinematic = belief.root[KINEMATIC]
        ellipse = ellipse_of(Sym2(belief.mean[1], belief.mean[0], belief.mean[2]))
        return Estimate(belief.mean[KINEMATIC], product(kinematic), ellipse)

    @lanes_last
    def mapped_merge(weights, beliefs) -> Gaussian:
        means, covs = zip(*(resized(belief, n) for belief in beliefs), strict=True)
        mean, cov = merge_gaussians(weights, jnp.stack(means), jnp.stack(covs))
        return Gaussian(mean, square_root(cov))

    mapped_predict = lanes_last(predict_turn if turning else predict_linear)
    mapped_likelihood = lanes_last(log_likelihood)
    mapped_update = partial(update, one=augmented_update) if augmented else lanes_last(update)

    def predict_step(belief, dt, key):
        return mapped_predict(belief, dt, params)

    def update_step(belief: Gaussian, scan: Measurements, key):
        position = Vec2(belief.mean[3], belief.mean[5])
        cov = product(jnp.stack([belief.root[3], belief.root[5]]))
        spread = moments_in(belief.mean, params.projection) + model.sensor_noise
        info = innovation_info(position, Sym2.of(cov), spread, scan)
        told = scan.points, scan.mask, model.sensor_noise, params
        likelihood = mapped_likelihood(belief, *told)
        new, acted = mapped_update(belief, *told)
        status = info.status | jnp.where(acted, int(Status.MOMENTS_PROJECTED), 0)
        return new, info._replace(log_likelihood=likelihood, status=status)

    return Filter(init, predict_step, update_step, mapped_estimate, mapped_merge)


def build(settings: MomentUkfSettings):
    """Traced parameters and static builder of the settings."""
    motion, bounds = settings.motion, settings.projection
    turning = isinstance(motion, CoordinatedTurn)
    params = Params(
        jnp.asarray(settings.moment_cov),
        jnp.asarray(motion.moment_noise),
        motion.acceleration_variance if isinstance(motion, CoordinatedTurn) else motion.psd,
        motion.turn_acceleration_variance if isinstance(motion, CoordinatedTurn) else 0.0,
        Spread(settings.gamma, settings.kappa, settings.beta),
        None if bounds is None else Projection(bounds.floor, bounds.ratio),
    )
    return params, lambda params, model: moment_ukf(turning, settings.augmented, params, model)


FILTERS.register("moment_ukf", MomentUkfSettings, build)

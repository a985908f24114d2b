"""Unscented Kalman filter on image moments, with constant-velocity or coordinated-turn motion."""

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

import jax
import jax.numpy as jnp
from jax.tree_util import register_dataclass
from jaxtyping import Array, Bool, Float
from pydantic import Field, model_validator

from emt.filters.base import TrackingModel, innovation_info, keep_if
from emt.filters.moment_update import Projection, augmented_update, expected, moments_in, point_update, projected
from emt.filters.unscented import Gaussian, Spread, merge_gaussians, product, square_root
from emt.linalg import Sym2, Vec2
from emt.models.motion import WhiteAcceleration
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
from emt.types import Estimate, Filter, Measurements, Prior, Scalar, Traced

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

    moment_cov: Float[Array, "3 3"]
    moment_noise: Float[Array, "3 3"]
    acceleration: Traced
    """Power spectral density or variance, by the motion."""
    turn_acceleration: Traced
    spread: Spread
    projection: Projection | None


def blocks(moments, position_velocity, turn_rate=None) -> Float[Array, "n n"]:
    """Block-diagonal covariance of the state: moments (3, 3), one axis (2, 2) for both axes, turn rate."""
    n = 7 if turn_rate is None else 8
    cov = jnp.zeros((n, n), moments.dtype).at[:3, :3].set(moments)
    cov = cov.at[3:5, 3:5].set(position_velocity).at[5:7, 5:7].set(position_velocity)
    return cov if turn_rate is None else cov.at[7, 7].set(turn_rate)


def predict_linear(belief: Gaussian, dt: Scalar, params: Params) -> Gaussian:
    """Constant velocity and moments (Yao et al. 2020, eqs. 13, 14, 26, 27)."""
    noise = WhiteAcceleration(params.acceleration)(dt).array()
    axis = jnp.stack([jnp.stack([noise[0, 0], noise[0, 2]]), jnp.stack([noise[2, 0], noise[2, 2]])])

    def move(state):
        return state.at[3].add(dt * state[4]).at[5].add(dt * state[6])

    cov = product(move(belief.root)) + blocks(params.moment_noise, axis)
    return Gaussian(move(belief.mean), square_root(cov))


def turn(state, dt: Scalar):
    """Coordinated turn of one state (8,) or of many (8, m): moments, position and velocity (eqs. 15-20)."""
    position, velocity = coordinated_turn(Vec2(state[3], state[5]), Vec2(state[4], state[6]), state[7], dt)
    mean, half = 0.5 * (state[1] + state[2]), 0.5 * (state[1] - state[2])
    c, s = jnp.cos(2.0 * state[7] * dt), jnp.sin(2.0 * state[7] * dt)
    n11, half = c * state[0] + s * half, c * half - s * state[0]
    rows = [n11, mean + half, mean - half, position.x, velocity.x, position.y, velocity.y, state[7]]
    return jnp.stack(rows)


def predict_turn(belief: Gaussian, dt: Scalar, params: Params) -> Gaussian:
    """Unscented prediction of a coordinated turn; the six additive noises collapse to their covariance."""
    c = params.spread.squared_step(8 + 6)
    step = jnp.sqrt(c) * belief.root
    center = turn(belief.mean, dt)
    plus = turn(belief.mean[:, None] + step, dt) - center[:, None]
    minus = turn(belief.mean[:, None] - step, dt) - center[:, None]
    bend = (plus + minus).sum(axis=1) / (2.0 * c)
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
    belief: Gaussian, scan: Measurements, model: TrackingModel, params: Params, augmented: bool
) -> tuple[Gaussian, Bool[Array, ""]]:
    """Sequential update by the points of a scan in their order, and whether a mean had to be projected."""
    one = augmented_update if augmented else point_update

    def body(j, carry):
        now, before = carry
        point = Vec2(scan.points[j, 0], scan.points[j, 1])
        new, acted = projected(one(now, point, model.sensor_noise, params.spread, params.projection), params.projection)
        return keep_if(scan.mask[j], (new, before | acted), carry)

    slots = jnp.arange(scan.mask.shape[0])
    last = jnp.where(scan.mask, slots + 1, 0).max()  # padding at the end costs nothing
    return jax.lax.fori_loop(0, last, body, (belief, jnp.asarray(False)))


def log_likelihood(belief: Gaussian, scan: Measurements, model: TrackingModel, params: Params) -> Scalar:
    """Sum over the points of log N(0; mean, variance) of their pseudo-measurements, all under the prediction
    (Yao et al. 2020, Algorithm 2, which takes the average)."""

    def one(point):
        now = expected(belief, Vec2(point[0], point[1]), model.sensor_noise, params.spread, params.projection)
        return -0.5 * (now.mean * now.mean / now.variance + jnp.log(2.0 * jnp.pi * now.variance))

    return jnp.where(scan.mask, jax.vmap(one)(scan.points), 0.0).sum()


def resized(belief: Gaussian, n: int) -> tuple[Float[Array, "n"], Float[Array, "n n"]]:
    """Mean and covariance with the turn rate dropped, or appended as a zero that is known exactly."""
    have, cov = belief.mean.shape[0], belief.cov()
    if have >= n:
        return belief.mean[:n], cov[:n, :n]
    return jnp.pad(belief.mean, (0, n - have)), jnp.pad(cov, (0, n - have))


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

    def predict_step(belief, dt, key):
        return predict_turn(belief, dt, params) if turning else predict_linear(belief, dt, params)

    def update_step(belief: Gaussian, scan: Measurements, key):
        position = Vec2(belief.mean[3], belief.mean[5])
        cov = product(jnp.stack([belief.root[3], belief.root[5]]))
        spread = moments_in(belief.mean, params.projection) + model.sensor_noise
        info = innovation_info(position, Sym2.of(cov), spread, scan)
        likelihood = log_likelihood(belief, scan, model, params)
        new, acted = update(belief, scan, model, params, augmented)
        status = info.status | jnp.where(acted, int(Status.MOMENTS_PROJECTED), 0)
        return new, info._replace(log_likelihood=likelihood, status=status)

    def estimate(belief: Gaussian) -> Estimate:
        cov = product(belief.root[KINEMATIC])
        return Estimate(belief.mean[KINEMATIC], cov, ellipse_of(Sym2(belief.mean[1], belief.mean[0], belief.mean[2])))

    def merge(weights, beliefs) -> Gaussian:
        means, covs = zip(*(resized(belief, n) for belief in beliefs), strict=True)
        mean, cov = merge_gaussians(weights, jnp.stack(means), jnp.stack(covs))
        return Gaussian(mean, square_root(cov))

    return Filter(init, predict_step, update_step, estimate, merge)


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

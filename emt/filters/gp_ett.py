"""Gaussian-process contour tracker."""

from dataclasses import dataclass
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
from jax.tree_util import register_dataclass
from jaxtyping import Array, Float
from pydantic import PositiveInt

from emt.filters.base import TrackingModel, innovation_info, keep_if
from emt.linalg import Sym2, Vec2
from emt.registry import FILTERS
from emt.scans import filled_slots
from emt.settings import (
    AngleVariance,
    LengthVariance,
    NonNegativeFloat,
    PositiveAngle,
    PositiveAngleVariance,
    PositiveLength,
    Settings,
)
from emt.status import Status
from emt.types import Estimate, Filter, Measurements, Prior, Scalar, StarConvex, Traced

N_MOTION = 6
"""State entries before the radii: centre (2), orientation, velocity (2), turn rate."""
JITTER = 1e-6
"""Added to the diagonal of the radii's covariance before it is inverted, as in the authors' code (m²)."""


ROUNDING_FLOOR = 100.0
"""Units of rounding by which the noise of a point is raised, relative to the predicted spread."""


class GpEttSettings(Settings):
    """Gaussian-process contour tracker (Wahlström and Özkan 2015). Expects points on the outline."""

    kind: Literal["gp_ett"] = "gp_ett"
    basis_angles: PositiveInt = 50
    """Number of equally spaced angles at which the radius is estimated."""
    radius_std: PositiveLength = 2.0
    """Standard deviation of the radius about its mean, the part that varies along the contour."""
    offset_std: PositiveLength = 0.8
    """Standard deviation of the part of the radius that all angles share."""
    length_scale: PositiveAngle = 0.39269908169872414
    """Angle over which the radius is correlated."""
    orientation_variance: PositiveAngleVariance = 1e-5
    """Prior variance of the orientation."""
    turn_rate_variance: PositiveAngleVariance = 1e-5
    """Prior variance of the turn rate (rad²/s²)."""
    turn_acceleration_psd: AngleVariance = 1e-8
    """Power spectral density of the angular acceleration (rad²/s³)."""
    forgetting_rate: NonNegativeFloat = 1e-4
    """Rate at which the radii return to zero mean (1/s)."""
    outline_variance: LengthVariance = 0.0
    """Variance, on each axis, of a point about the outline besides the sensor noise: for points from the surface."""


@register_dataclass
@dataclass(frozen=True)
class Params:
    """Traced numbers of the filter."""

    radius_var: Traced
    offset_var: Traced
    length_scale: Traced
    orientation_variance: Traced
    turn_rate_variance: Traced
    turn_acceleration_psd: Traced
    forgetting_rate: Traced
    outline_variance: Traced


class GpState(NamedTuple):
    """Joint Gaussian over (centre, orientation, velocity, turn rate, radii)."""

    mean: Float[Array, "n_state"]
    cov: Float[Array, "n_state n_state"]


class Contour(NamedTuple):
    """The Gaussian process of the outline at the basis angles."""

    angles: Float[Array, "n_angles"]
    cov: Float[Array, "n_angles n_angles"]
    inverse: Float[Array, "n_angles n_angles"]


def kernel(u: Float[Array, "..."], v: Float[Array, "..."], params: Params) -> Float[Array, "..."]:
    """Covariance of the radii at two angles (m²), or at the angles of two arrays that broadcast."""
    return params.radius_var * jnp.exp(-2.0 * jnp.sin(0.5 * (u - v)) ** 2 / params.length_scale**2) + params.offset_var


def contour(angles: Float[Array, "n_angles"], params: Params) -> Contour:
    """Covariance of the radii at the basis angles and its inverse."""
    cov = kernel(angles[:, None], angles[None, :], params)
    eye = jnp.eye(angles.shape[0], dtype=angles.dtype)
    return Contour(angles, cov, jnp.linalg.inv(cov + JITTER * eye))


def predict(state: GpState, dt: Scalar, gp: Contour, model: TrackingModel, params: Params) -> GpState:
    """Time update: constant velocity and turn rate; radii decay towards zero (Wahlström and Özkan 2015, Sec. IV)."""
    n = gp.angles.shape[0]
    dtype = state.mean.dtype
    motion = jnp.eye(N_MOTION, dtype=dtype) + dt * jnp.eye(N_MOTION, k=3, dtype=dtype)
    noise4 = model.noise(dt).array()
    q = params.turn_acceleration_psd
    plane = jnp.array([0, 1, 3, 4])
    noise = jnp.zeros((N_MOTION, N_MOTION), dtype).at[plane[:, None], plane[None, :]].set(noise4)
    noise = noise.at[2, 2].set(q * dt**3 / 3.0).at[2, 5].set(q * dt**2 / 2.0)
    noise = noise.at[5, 2].set(q * dt**2 / 2.0).at[5, 5].set(q * dt)
    decay = jnp.exp(-params.forgetting_rate * dt)

    def transition(block):
        """F times a matrix of n_state rows."""
        return jnp.concatenate([motion @ block[:N_MOTION], decay * block[N_MOTION:]])

    full_noise = jnp.zeros((N_MOTION + n, N_MOTION + n), dtype)
    full_noise = full_noise.at[:N_MOTION, :N_MOTION].set(noise)
    full_noise = full_noise.at[N_MOTION:, N_MOTION:].set((1.0 - decay**2) * gp.cov)
    return GpState(transition(state.mean), symmetrise(transition(transition(state.cov).T) + full_noise))


def measurement(mean, point: Vec2, gp: Contour, model: TrackingModel, params: Params):
    """Predicted point, Jacobian (2, n_state) and noise (2, 2) of one contour point.

    The predicted centre and orientation fix the angle at which the point is seen. As in the authors' code, the
    derivative of the kernel acts on the whole kernel, its constant part included.

    Source: Wahlström and Özkan 2015, eqs. 22-29 and appendix.
    """
    d = jnp.stack([point.x - mean[0], point.y - mean[1]])
    squared = d @ d
    # chosen before the root, whose slope at zero is infinite
    safe = jnp.sqrt(jnp.where(squared > 0.0, squared, 1.0))
    o = jnp.where(squared > 0.0, d / safe, jnp.array([1.0, 0.0], d.dtype))
    angle = jnp.arctan2(o[1], o[0]) - mean[2]
    row = kernel(angle, gp.angles, params)
    weights = gp.inverse @ row
    slope = gp.inverse @ (-jnp.sin(angle - gp.angles) * row / params.length_scale**2)
    radii = mean[N_MOTION:]
    radius, radius_slope = weights @ radii, slope @ radii
    unit_by_centre = (jnp.outer(o, o) - jnp.eye(2, dtype=d.dtype)) / safe
    angle_by_centre = jnp.stack([o[1], -o[0]]) / safe
    by_centre = jnp.eye(2, dtype=d.dtype) + radius * unit_by_centre + radius_slope * jnp.outer(o, angle_by_centre)
    jacobian = jnp.concatenate(
        [by_centre, -radius_slope * o[:, None], jnp.zeros((2, 3), d.dtype), jnp.outer(o, weights)], axis=1
    )
    residual_var = kernel(angle, angle, params) - row @ weights
    noise = model.sensor_noise.array() + params.outline_variance * jnp.eye(2, dtype=d.dtype)
    return mean[:2] + radius * o, jacobian, noise + residual_var * jnp.outer(o, o)


def noise_floor(h: Float[Array, "n n_state"], cov: Float[Array, "n_state n_state"]) -> Scalar:
    """Rounding error of the predicted spread of the points (m²)."""
    return ROUNDING_FLOOR * jnp.finfo(cov.dtype).eps * ((h @ cov) * h).sum(axis=1).max()


def update(state: GpState, scan: Measurements, gp: Contour, model: TrackingModel, params: Params) -> GpState:
    """One extended Kalman update with all points of the scan.

    All are linearised about the prediction and their noises are independent, so it makes no difference that they are
    taken one after the other, each in Joseph form; and no factorisation is needed, with which XLA's CPU backend can
    wait for itself for ever (see `linalg.cholesky`).

    Deviation from the paper: the noise of a point is raised by the rounding error of the innovation covariance, without
    which this is not definite when the sensor noise is far smaller than the prediction's uncertainty.
    """
    # padding sits at the centre, where `measurement` and its derivatives are finite
    expected, jacobian, noise = jax.vmap(lambda point: measurement(state.mean, Vec2.of(point), gp, model, params))(
        scan.points
    )
    h = jnp.where(scan.mask[:, None, None], jacobian, 0.0)
    floor = noise_floor(h.reshape(-1, h.shape[2]), state.cov) * jnp.eye(2, dtype=h.dtype)

    def one(j, now: GpState) -> GpState:
        rows, r = jacobian[j], noise[j] + floor
        innovation = scan.points[j] - expected[j] - rows @ (now.mean - state.mean)
        cross = rows @ now.cov
        spread = Sym2.of(symmetrise(cross @ rows.T + r))
        gain = cross.T @ spread.inverse().array()
        half = now.cov - gain @ cross
        cov = half - (half @ rows.T) @ gain.T + gain @ r @ gain.T
        return keep_if(scan.mask[j], GpState(now.mean + gain @ innovation, symmetrise(cov)), now)

    return jax.lax.fori_loop(0, filled_slots(scan), one, state)


def symmetrise(m: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """(M + Mᵀ)/2."""
    return 0.5 * (m + m.T)


def gp_ett(basis_angles: int, params: Params, model: TrackingModel) -> Filter:
    """Gaussian-process contour tracker.

    Source: N. Wahlström and E. Özkan, IEEE Trans. Signal Process. 63 (2015), doi:10.1109/TSP.2015.2424194.
    """
    dtype = jnp.result_type(params.radius_var)
    gp = contour(jnp.arange(basis_angles, dtype=dtype) * (2.0 * jnp.pi / basis_angles), params)
    kinematic = jnp.array([0, 1, 3, 4])

    def init(prior: Prior, key) -> GpState:
        a, b = prior.ellipse.semi_axes[0], prior.ellipse.semi_axes[1]
        radii = a * b / jnp.sqrt((b * jnp.cos(gp.angles)) ** 2 + (a * jnp.sin(gp.angles)) ** 2)
        mean = jnp.zeros(N_MOTION + basis_angles, dtype).at[kinematic].set(prior.mean)
        mean = mean.at[2].set(prior.ellipse.orientation).at[N_MOTION:].set(radii)
        cov = jnp.zeros((N_MOTION + basis_angles, N_MOTION + basis_angles), dtype)
        cov = cov.at[kinematic[:, None], kinematic[None, :]].set(prior.cov)
        cov = cov.at[2, 2].set(params.orientation_variance).at[5, 5].set(params.turn_rate_variance)
        return GpState(mean, cov.at[N_MOTION:, N_MOTION:].set(gp.cov))

    def update_step(state: GpState, scan: Measurements, key):
        radii = state.mean[N_MOTION:]
        spread_var = model.extent_scale * jnp.mean(radii**2)
        spread = Sym2(spread_var, jnp.zeros_like(spread_var), spread_var) + model.sensor_noise
        info = innovation_info(Vec2.of(state.mean), Sym2.of(state.cov[:2, :2]), spread, scan)
        rounding = ROUNDING_FLOOR * jnp.finfo(dtype).eps * (state.cov[0, 0] + state.cov[1, 1])
        floored = scan.mask.any() & (model.sensor_noise.eigen()[1] < rounding)
        status = info.status | jnp.where(floored, int(Status.FLOOR_USED), 0)
        return update(state, scan, gp, model, params), info._replace(status=status)

    def estimate(state: GpState) -> Estimate:
        return Estimate(
            state.mean[kinematic],
            state.cov[kinematic[:, None], kinematic[None, :]],
            StarConvex(state.mean[N_MOTION:], state.mean[2]),
        )

    return Filter(init, lambda state, dt, key: predict(state, dt, gp, model, params), update_step, estimate)


def build(settings: GpEttSettings):
    """Traced parameters and static builder of the settings."""
    params = Params(
        settings.radius_std**2,
        settings.offset_std**2,
        settings.length_scale,
        settings.orientation_variance,
        settings.turn_rate_variance,
        settings.turn_acceleration_psd,
        settings.forgetting_rate,
        settings.outline_variance,
    )
    n = settings.basis_angles
    return params, lambda params, model: gp_ett(n, params, model)


FILTERS.register("gp_ett", GpEttSettings, build)

"""MEM-EKF*: multiplicative error model with sequential extended Kalman updates."""

from dataclasses import dataclass
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
from jax.tree_util import register_dataclass
from jaxtyping import Array, Bool, Float

from emt.filters import kinematics
from emt.filters.base import TrackingModel, innovation_info, keep_if
from emt.filters.kinematics import Kinematics
from emt.linalg import Chol3, Mat2, Sym2, Vec2, once
from emt.registry import FILTERS
from emt.scans import filled_slots
from emt.settings import Covariance3, Settings, ShapeNoise
from emt.status import Status
from emt.trigonometry import sincos
from emt.types import Ellipse, Estimate, Filter, Measurements, Prior, Scalar

PIVOT_FLOOR = 1e-12
"""Smallest pivot of I - Uᵀ Λ U; mathematically it is positive, so only rounding can reach this floor."""
THINNEST = 1e-9
"""A reported semi-axis is at least this fraction of the other: the filter itself lets an axis pass through zero. One
that shrinks below this fraction within a scan, or crosses, sets `Status.FLOOR_USED`."""


class MemEkfStarSettings(Settings):
    """MEM-EKF*: multiplicative error model with sequential updates (Yang and Baum 2019)."""

    kind: Literal["mem_ekf_star"] = "mem_ekf_star"
    shape_cov: Covariance3
    """Prior covariance of (orientation, semi-axis 1, semi-axis 2), in rad and m."""
    shape_noise: ShapeNoise
    """Covariance added to (orientation, semi-axis 1, semi-axis 2) per step, in rad and m."""


@register_dataclass
@dataclass(frozen=True)
class Params:
    """Traced numbers of the filter."""

    shape_cov: Float[Array, "3 3"]
    shape_noise: Float[Array, "3 3"]


class MemState(NamedTuple):
    """Independent Gaussians over the kinematics and over (orientation, semi-axes)."""

    kinematics: Kinematics
    orientation: Scalar
    """Mean orientation (rad), not wrapped."""
    semi_axes: Vec2
    """Mean semi-axes (m); nothing in the algorithm keeps them positive."""
    shape_chol: Chol3
    """Factor of the covariance of (orientation, semi-axis 1, semi-axis 2)."""


def extent_spread(semi_axes: Vec2, shape_chol: Chol3, scale: Scalar) -> Sym2:
    """Predicted covariance of a point about the centre, in the frame of the axes: C_I + C_II of the paper (m²)."""
    l1, l2 = semi_axes.x, semi_axes.y
    tt, t1, c11, t2, _, c22 = shape_chol.triangle()
    return scale * Sym2(l1 * l1 + c11 + l2 * l2 * tt, l1 * t1 - l2 * t2, l2 * l2 + c22 + l1 * l1 * tt)


class Now(NamedTuple):
    """What changes from point to point. Gain and conditional covariance of the velocity stay as they are, so the
    velocity can wait for the last point; the rotation is carried, or it would be computed anew wherever it enters."""

    position: Vec2
    position_cov: Sym2
    orientation: Scalar
    semi_axes: Vec2
    shape_chol: Chol3
    axes: Mat2
    """Rotation by the orientation."""


def update_with_point(state: Now, point: Vec2, real: Bool[Array, ""], model: TrackingModel) -> Now:
    """Update with one point, or none where it is not real: with a weight of zero nothing moves.

    The pseudo-measurement (e1 e2, e1², e2²) is taken in the frame of the predicted axes. The gain does not depend on
    this linear change of coordinates, but there its measurement matrix is diagonal, M = k diag(l1² - l2², 2 l1, 2 l2)
    with k the extent scale; and since its covariance C_Y is that of products of Gaussians, C_Y⁻¹ and C_Y⁻¹ (Y - Ȳ)
    are products of entries of W = C_y⁻¹ and f = W e. One can show M C_p Mᵀ ≤ C_Y, so the factor below always exists.

    Source: Yang and Baum 2019, eqs. 15-24, with the shape covariance carried as a Cholesky factor.
    """
    k, axes, centre_cov = model.extent_scale, state.axes, state.position_cov
    l1, l2 = state.semi_axes.x, state.semi_axes.y
    noise = axes.congruence(extent_spread(state.semi_axes, state.shape_chol, k)) + model.sensor_noise
    noise, inverse_det = once((noise, 1.0 / (centre_cov + noise).det()), k)
    innovation = point - state.position
    weight = jnp.where(real, inverse_det, 0.0) * (centre_cov + noise).adjugate()
    # (C⁻¹ + Y⁻¹)⁻¹ = (|Y| C + |C| Y) / |C + Y|
    position_cov = keep_if(real, inverse_det * (noise.det() * centre_cov + centre_cov.det() * noise), centre_cov)

    w = axes.T.congruence(weight)
    f = w @ (axes.T @ innovation)
    w, f = once((w, f), k)
    position = state.position + centre_cov @ (axes @ f)
    mt, m1, m2 = k * (l1 * l1 - l2 * l2), 2.0 * k * l1, 2.0 * k * l2
    # M C_Y⁻¹ (Y - Ȳ)
    pull_t = mt * (f.x * f.y - w.xy)
    pull_1, pull_2 = 0.5 * m1 * (f.x * f.x - w.xx), 0.5 * m2 * (f.y * f.y - w.yy)
    # Λ = M C_Y⁻¹ M
    tt = mt * mt * (w.xx * w.yy + w.xy * w.xy)
    t1, t2 = mt * m1 * w.xx * w.xy, mt * m2 * w.xy * w.yy
    i11, i12, i22 = 0.5 * m1 * m1 * w.xx**2, 0.5 * m1 * m2 * w.xy**2, 0.5 * m2 * m2 * w.yy**2

    pull_t, tt, t1, t2, i11, i12, i22 = once((pull_t, tt, t1, t2, i11, i12, i22), k)
    u = state.shape_chol
    # shift = U Uᵀ pull
    h1 = u.a11 * pull_t + u.a21 * pull_1 + u.a31 * pull_2
    h2, h3 = u.a22 * pull_1 + u.a32 * pull_2, u.a33 * pull_2
    # columns of Λ U
    p1 = (
        tt * u.a11 + t1 * u.a21 + t2 * u.a31,
        t1 * u.a11 + i11 * u.a21 + i12 * u.a31,
        t2 * u.a11 + i12 * u.a21 + i22 * u.a31,
    )
    p2 = (t1 * u.a22 + t2 * u.a32, i11 * u.a22 + i12 * u.a32, i12 * u.a22 + i22 * u.a32)
    p3 = (t2 * u.a33, i12 * u.a33, i22 * u.a33)
    kept = Chol3.factor(
        1.0 - (u.a11 * p1[0] + u.a21 * p1[1] + u.a31 * p1[2]),
        -(u.a22 * p1[1] + u.a32 * p1[2]),
        1.0 - (u.a22 * p2[1] + u.a32 * p2[2]),
        -u.a33 * p1[2],
        -u.a33 * p2[2],
        1.0 - u.a33 * p3[2],
        floor=PIVOT_FLOOR,
    )
    orientation = state.orientation + u.a11 * h1
    semi_axes = Vec2(l1 + u.a21 * h1 + u.a22 * h2, l2 + u.a31 * h1 + u.a32 * h2 + u.a33 * h3)
    return Now(position, position_cov, orientation, semi_axes, u @ once(kept, k), rotation(orientation))


def rotation(angle: Scalar) -> Mat2:
    """Anticlockwise rotation by `angle` (rad)."""
    sine, cosine = sincos(angle)
    return Mat2(cosine, -sine, sine, cosine)


def update(state: MemState, scan: Measurements, model: TrackingModel) -> MemState:
    """Update with every point of the scan in turn; the order matters, as in the paper."""
    belief = state.kinematics

    def step(j, now: Now) -> Now:
        return update_with_point(now, Vec2.of(scan.points[j]), scan.mask[j], model)

    start = Now(
        belief.position,
        belief.position_cov,
        state.orientation,
        state.semi_axes,
        state.shape_chol,
        rotation(state.orientation),
    )
    new = jax.lax.fori_loop(0, filled_slots(scan), step, start)
    moved = kinematics.with_position(belief, new.position, new.position_cov)
    return MemState(moved, new.orientation, new.semi_axes, new.shape_chol)


def predict(state: MemState, dt: Scalar, model: TrackingModel, params: Params) -> MemState:
    """Time update: constant velocity; the shape performs a random walk."""
    return state._replace(
        kinematics=kinematics.predict(state.kinematics, model.noise(dt), dt),
        shape_chol=Chol3.of(state.shape_chol.array() + params.shape_noise),
    )


def estimate(state: MemState) -> Estimate:
    """Means; semi-axes by their modulus."""
    a, b = jnp.abs(state.semi_axes.x), jnp.abs(state.semi_axes.y)
    axes = jnp.stack([jnp.maximum(a, THINNEST * b), jnp.maximum(b, THINNEST * a)])
    return Estimate(state.kinematics.mean(), state.kinematics.cov(), Ellipse(axes, state.orientation))


def mem_ekf_star(params: Params, model: TrackingModel) -> Filter:
    """MEM-EKF*: sequential update of an ellipse with explicit orientation and semi-axes.

    Source: S. Yang and M. Baum, IEEE Trans. Signal Process. 67 (2019), doi:10.1109/TSP.2019.2929462.
    """

    def init(prior: Prior, key) -> MemState:
        axes = Vec2.of(prior.ellipse.semi_axes)
        belief = Kinematics.of(prior.mean, prior.cov)
        return MemState(belief, prior.ellipse.orientation, axes, Chol3.of(params.shape_cov))

    def update_step(state: MemState, scan: Measurements, key):
        axes, spread = rotation(state.orientation), extent_spread(state.semi_axes, state.shape_chol, model.extent_scale)
        spread = axes.congruence(spread) + model.sensor_noise
        info = innovation_info(state.kinematics.position, state.kinematics.position_cov, spread, scan)
        new = update(state, scan, model)
        size = jnp.max(jnp.abs(jnp.stack([new.semi_axes.array(), state.semi_axes.array()])))
        crossed = (new.semi_axes.array() <= THINNEST * size).any()
        status = info.status | jnp.where(crossed, int(Status.FLOOR_USED), 0)
        return new, info._replace(status=status)

    return Filter(init, lambda state, dt, key: predict(state, dt, model, params), update_step, estimate)


def build(settings: MemEkfStarSettings):
    """Traced parameters and static builder of the settings."""
    return Params(jnp.asarray(settings.shape_cov), jnp.asarray(settings.shape_noise)), mem_ekf_star


FILTERS.register("mem_ekf_star", MemEkfStarSettings, build)

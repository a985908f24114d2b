"""Variational-Bayes random matrix with explicit orientation."""

from dataclasses import dataclass
from typing import ClassVar, Literal, NamedTuple

import jax
import jax.numpy as jnp
from jax.tree_util import register_dataclass
from pydantic import PositiveInt

from emt.filters import kinematics
from emt.filters.base import TrackingModel, innovation_info
from emt.filters.kinematics import Kinematics
from emt.linalg import Sym2, Vec2, fuse, once, rotated_diagonal
from emt.registry import FILTERS
from emt.scans import ScanStatistics, scan_statistics
from emt.settings import AngleVariance, PositiveAngleVariance, Settings, ShapeParameter, UnitInterval
from emt.status import Status
from emt.trigonometry import sincos
from emt.types import Ellipse, Estimate, Filter, Measurements, Prior, Scalar, Traced

MIN_SHAPE = 1.25
"""Floor of the inverse-gamma shapes after forgetting: the mean extent exists only above 1."""


class VbRandomMatrixSettings(Settings):
    """Variational-Bayes random matrix with orientation (Tuncer and Özkan 2021)."""

    kind: Literal["vb_random_matrix"] = "vb_random_matrix"
    reads_points: ClassVar[bool] = False
    iterations: PositiveInt = 10
    """Variational iterations per scan."""
    shape: tuple[ShapeParameter, ShapeParameter] = (10.0, 10.0)
    """Prior inverse-gamma shapes of the squared semi-axes, above 1. Scales follow from the prior semi-axes l:
    (shape - 1) l²."""
    orientation_variance: PositiveAngleVariance = 0.2
    """Prior variance of the orientation."""
    orientation_noise: AngleVariance = 0.01
    """Variance added to the orientation per step."""
    forgetting: UnitInterval = 0.99
    """Factor of the inverse-gamma shapes and scales per step."""


@register_dataclass
@dataclass(frozen=True)
class Params:
    """Traced numbers of the filter."""

    shape: tuple[Traced, Traced]
    orientation_variance: Traced
    orientation_noise: Traced
    forgetting: Traced


class VbState(NamedTuple):
    """N(x; ·) N(θ; ·) IG(X1; ·) IG(X2; ·), all independent."""

    kinematics: Kinematics
    orientation: Scalar
    """Mean of θ (rad), not wrapped."""
    orientation_var: Scalar
    shape: Vec2
    """Inverse-gamma shapes of the two squared semi-axes."""
    scale: Vec2
    """Inverse-gamma scales (m²)."""


class Turn(NamedTuple):
    """Expectations over the orientation: E cos 2θ = shrink cos2, E sin 2θ = shrink sin2."""

    cos2: Scalar
    sin2: Scalar
    shrink: Scalar

    @staticmethod
    def of(orientation: Scalar, variance: Scalar) -> "Turn":
        """Of an orientation with this mean and variance (rad, rad²)."""
        sin2, cos2 = sincos(2.0 * orientation)
        return Turn(cos2, sin2, jnp.exp(-2.0 * variance))


class Factors(NamedTuple):
    """One iterate of the variational factors; the auxiliary points enter by their mean and scatter only."""

    position: Vec2
    position_cov: Sym2
    orientation: Scalar
    orientation_var: Scalar
    shape: Vec2
    scale: Vec2
    aux_mean: Vec2
    aux_scatter: Sym2
    aux_cov: Sym2
    turn: Turn
    """Of the orientation: carried from one iteration to the next, or the compiler would compute sine and cosine anew
    for each of the many numbers that they enter."""


def iterate(prior: VbState, stats: ScanStatistics, model: TrackingModel, q: Factors) -> Factors:
    """All factors recomputed from the previous iterate (Jacobi order).

    The noise-free points z_j = y_j + Σ_z A (x - y_j) are affine in y_j, so their sum of outer products follows from
    count, mean and scatter of the scan: the iteration costs the same for any number of points, and is exact.

    Source: Tuncer and Özkan 2021, Sec. III (Lemma 1 for the expectations over θ; q_θ by linearising L(θ)ᵀ(z - Hx)).
    """
    m, s, noise = stats.count, model.extent_scale, model.sensor_noise
    d1, d2 = q.shape.x / (s * q.scale.x), q.shape.y / (s * q.scale.y)
    cos2, sin2, shrink = q.turn
    info = rotated_diagonal(d1, d2, shrink * cos2, shrink * sin2)  # A = E[L (sX)⁻¹ Lᵀ]
    residual = q.aux_mean - q.position
    psi = q.aux_scatter + m * (residual.outer() + q.position_cov + q.aux_cov)

    psi, info = once((psi, info), s)
    position_cov = fuse(prior.kinematics.position_cov, m * info)
    shift = q.aux_mean - prior.kinematics.position
    position = prior.kinematics.position + position_cov @ (info @ (m * shift))

    mean, half = 0.5 * psi.trace(), 0.5 * (psi.xx - psi.yy)
    along = half * cos2 + psi.xy * sin2
    across = psi.xy * cos2 - half * sin2
    scale = Vec2(prior.scale.x + 0.5 / s * (mean + shrink * along), prior.scale.y + 0.5 / s * (mean - shrink * along))
    shape = Vec2(prior.shape.x + 0.5 * m, prior.shape.y + 0.5 * m)

    # (A + R⁻¹)⁻¹, without inverting R
    aux_cov = fuse(noise, info)
    pull = aux_cov @ info.full()
    aux_mean = stats.mean + pull @ (q.position - stats.mean)
    aux_scatter = (-1.0 * pull).plus_identity().congruence(stats.scatter)

    curvature = d1 * (mean - along) + d2 * (mean + along)
    slope = curvature * (q.orientation - prior.orientation) - (d1 - d2) * across
    orientation_var = prior.orientation_var / (1.0 + prior.orientation_var * curvature)
    orientation = prior.orientation + orientation_var * slope
    turn = Turn.of(orientation, orientation_var)
    return Factors(
        position, position_cov, orientation, orientation_var, shape, scale, aux_mean, aux_scatter, aux_cov, turn
    )


def update(
    state: VbState, scan: Measurements, model: TrackingModel, iterations: int, turn: Turn | None = None
) -> VbState:
    """Measurement update by `iterations` fixed-point iterations (Tuncer and Özkan 2021, Sec. III).

    Args:
        turn: of the predicted orientation, if it is known already.
    """
    stats = scan_statistics(scan)
    zero = jnp.zeros_like(stats.count)
    start = Factors(
        position=state.kinematics.position,
        position_cov=state.kinematics.position_cov,
        orientation=state.orientation,
        orientation_var=state.orientation_var,
        shape=state.shape,
        scale=state.scale,
        aux_mean=stats.mean,
        aux_scatter=stats.scatter,
        # not rotated, as in the authors' code; only the first iteration feels it
        aux_cov=Sym2(
            model.extent_scale * state.scale.x / (state.shape.x - 1.0),
            zero,
            model.extent_scale * state.scale.y / (state.shape.y - 1.0),
        ),
        turn=Turn.of(state.orientation, state.orientation_var) if turn is None else turn,
    )
    q = jax.lax.fori_loop(0, iterations, lambda _, q: iterate(state, stats, model, q), start)
    belief = kinematics.with_position(state.kinematics, q.position, q.position_cov)
    return VbState(belief, q.orientation, q.orientation_var, q.shape, q.scale)


def predict(state: VbState, dt: Scalar, model: TrackingModel, params: Params) -> VbState:
    """Time update (Tuncer and Özkan 2021, Sec. IV), with a floor under the inverse-gamma shapes."""
    forgotten = Vec2(params.forgetting * state.shape.x, params.forgetting * state.shape.y)
    shape = Vec2(jnp.maximum(forgotten.x, MIN_SHAPE), jnp.maximum(forgotten.y, MIN_SHAPE))
    # at the floor the scale follows, so that the mean inverse extent (shape/scale) is kept as it is elsewhere
    scale = Vec2(state.scale.x * shape.x / state.shape.x, state.scale.y * shape.y / state.shape.y)
    return VbState(
        kinematics.predict(state.kinematics, model.noise(dt), dt),
        state.orientation,
        state.orientation_var + params.orientation_noise,
        shape,
        scale,
    )


def semi_axes(state: VbState) -> Vec2:
    """Roots of the mean squared semi-axes, √(β/(α-1)) (m)."""
    return Vec2(jnp.sqrt(state.scale.x / (state.shape.x - 1.0)), jnp.sqrt(state.scale.y / (state.shape.y - 1.0)))


def estimate(state: VbState) -> Estimate:
    """Posterior means."""
    return Estimate(
        state.kinematics.mean(), state.kinematics.cov(), Ellipse(semi_axes(state).array(), state.orientation)
    )


def vb_random_matrix(iterations: int, params: Params, model: TrackingModel) -> Filter:
    """Variational-Bayes random matrix with orientation.

    Source: B. Tuncer and E. Özkan, IEEE Trans. Signal Process. 69 (2021), doi:10.1109/TSP.2021.3065136.
    """

    def init(prior: Prior, key) -> VbState:
        axes = prior.ellipse.semi_axes
        shape = Vec2(params.shape[0], params.shape[1])
        scale = Vec2((shape.x - 1.0) * axes[0] ** 2, (shape.y - 1.0) * axes[1] ** 2)
        belief = Kinematics.of(prior.mean, prior.cov)
        return VbState(belief, prior.ellipse.orientation, params.orientation_variance, shape, scale)

    def update_step(state, scan, key):
        axes = semi_axes(state)
        turn = Turn.of(state.orientation, state.orientation_var)
        extent = rotated_diagonal(axes.x * axes.x, axes.y * axes.y, turn.cos2, turn.sin2)
        spread = model.extent_scale * extent + model.sensor_noise
        info = innovation_info(state.kinematics.position, state.kinematics.position_cov, spread, scan)
        floored = (state.shape.x <= MIN_SHAPE) | (state.shape.y <= MIN_SHAPE)
        status = info.status | jnp.where(floored, int(Status.FLOOR_USED), 0)
        return update(state, scan, model, iterations, turn), info._replace(status=status)

    return Filter(init, lambda state, dt, key: predict(state, dt, model, params), update_step, estimate)


def build(settings: VbRandomMatrixSettings):
    """Traced parameters and static builder of the settings."""
    params = Params(settings.shape, settings.orientation_variance, settings.orientation_noise, settings.forgetting)
    iterations = settings.iterations
    return params, lambda params, model: vb_random_matrix(iterations, params, model)


FILTERS.register("vb_random_matrix", VbRandomMatrixSettings, build)

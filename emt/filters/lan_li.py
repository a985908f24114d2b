"""Random matrix with a rotation and an agility of the extent, after Lan and Li."""

import math
from dataclasses import dataclass
from typing import ClassVar, Literal, NamedTuple

import jax.numpy as jnp
from jax.scipy.special import gammaln
from jax.tree_util import register_dataclass
from pydantic import Field

from emt.filters.base import TrackingModel, innovation_info
from emt.linalg import Mat2, Sym2, Vec2
from emt.logarithm import log
from emt.registry import FILTERS
from emt.scans import ScanStatistics, is_seen, scan_statistics
from emt.settings import AccelerationDensity, Angle, PositiveFloat, Settings
from emt.shapes.ellipse import extent_matrix
from emt.types import Ellipse, Estimate, Filter, Info, Measurements, Prior, Scalar, Traced

MIN_FREEDOM = 2.0
"""The variance of an inverse Wishart extent exists only above this many degrees of freedom (less 6)."""


class LanLiSettings(Settings):
    """Random matrix with rotation and agility (Lan and Li 2016)."""

    kind: Literal["lan_li"] = "lan_li"
    reads_points: ClassVar[bool] = False
    degrees_of_freedom: float = Field(gt=8.0)
    """Of the prior inverse Wishart extent; its variance exists only above 8."""
    psd: AccelerationDensity
    """Power spectral density of the acceleration in units of the extent: the process noise is D times X."""
    agility: PositiveFloat
    """δ: how freely the extent changes in a step; smaller is freer."""
    rotation: Angle = 0.0
    """Angle by which the extent turns in a step."""
    family: ClassVar[str] = "random matrix"


@register_dataclass
@dataclass(frozen=True)
class Params:
    """Traced numbers of the filter."""

    degrees_of_freedom: Traced
    psd: Traced
    agility: Traced
    rotation: Traced


class LanLiState(NamedTuple):
    """x | X ~ N(·, P ⊗ X), X ~ IW(λ + 6, λ X̄)."""

    position: Vec2
    velocity: Vec2
    kinematic: Sym2
    """P: covariance of position and velocity on one axis, in units of the extent (1, 1/s, 1/s²)."""
    extent: Sym2
    """X̄: mean of the squared semi-axes, rotated (m²)."""
    freedom: Scalar
    """λ: degrees of freedom less 6."""


def predict(state: LanLiState, dt: Scalar, params: Params) -> LanLiState:
    """Time update: Kronecker Kalman prediction, rotated mean extent, degrees of freedom by the agility.

    Source: Lan and Li 2016, re-derived; Yao et al. 2020, Sec. V, for the use.
    """
    p, lam, delta = state.kinematic, state.freedom, params.agility
    noise = params.psd * Sym2(dt**3 / 3.0, dt**2 / 2.0, dt)
    moved = Sym2(p.xx + 2.0 * dt * p.xy + dt * dt * p.yy, p.xy + dt * p.yy, p.yy) + noise
    freedom = 2.0 * delta * (lam + 1.0) * (lam - 1.0) * (lam - 2.0) / (lam * lam * (lam + delta)) + 2.0
    return LanLiState(
        state.position + dt * state.velocity,
        state.velocity,
        moved,
        Mat2.rotation(params.rotation).congruence(state.extent),
        freedom,
    )


def update(state: LanLiState, stats: ScanStatistics, model: TrackingModel) -> tuple[LanLiState, Scalar]:
    """Measurement update and the log-likelihood of the scan (at least one point)."""
    n = jnp.maximum(stats.count, 1.0)
    shape = (model.extent_scale * state.extent + model.sensor_noise).sqrt() @ state.extent.sqrt().inverse()  # B
    det = shape.xx * shape.yy - shape.xy * shape.yx
    inverse = (1.0 / det) * Mat2(shape.yy, -shape.xy, -shape.yx, shape.xx)
    p = state.kinematic
    mean_noise = det / n
    variance = p.xx + mean_noise
    innovation = stats.mean - state.position
    kept = mean_noise / variance
    # P - K S Kᵀ with the position entry as a product; the velocity given the position stays
    kinematic = Sym2(p.xx * kept, p.xy * kept, (p.yy - p.xy * p.xy / p.xx) + p.xy * p.xy / p.xx * kept)
    freedom = state.freedom + n
    total = state.freedom * state.extent + (1.0 / variance) * innovation.outer() + inverse.congruence(stats.scatter)
    new = LanLiState(
        state.position + (p.xx / variance) * innovation,
        state.velocity + (p.xy / variance) * innovation,
        kinematic,
        (1.0 / freedom) * total,
        freedom,
    )

    def log_gamma(a):
        return gammaln(a) + gammaln(a - 0.5)

    before, after = 0.5 * (state.freedom + 3.0), 0.5 * (freedom + 3.0)
    log_likelihood = (
        -n * math.log(math.pi)
        - log(n)
        - log(variance)
        - (n - 1.0) * log(det)
        + log_gamma(after)
        - log_gamma(before)
        + before * log((state.freedom * state.extent).det())
        - after * log(total.det())
    )
    return new, log_likelihood


def merge(weights, states: tuple[LanLiState, ...]) -> LanLiState:
    """One state for a mixture: mean state and extent, kinematic covariance and degrees of freedom by matched traces."""

    def total(parts):
        result = weights[0] * parts[0]
        for k in range(1, len(states)):
            result = result + weights[k] * parts[k]
        return result

    extent = total([s.extent for s in states])
    position, velocity = total([s.position for s in states]), total([s.velocity for s in states])
    weight = extent.inverse()

    def entry(name: str, gaps) -> Scalar:
        return 0.5 * total(
            [getattr(s.kinematic, name) * weight.inner(s.extent) + g for s, g in zip(states, gaps, strict=True)]
        )

    shifts = [(s.position - position, s.velocity - velocity) for s in states]
    kinematic = Sym2(
        entry("xx", [weight.quadratic(a) for a, _ in shifts]),
        entry("xy", [a.x * (weight @ b).x + a.y * (weight @ b).y for a, b in shifts]),
        entry("yy", [weight.quadratic(b) for _, b in shifts]),
    )

    def own_variance(s: LanLiState) -> Scalar:
        square, trace, lam = s.extent.inner(s.extent), s.extent.trace(), s.freedom
        return ((lam + 2.0) * square + lam * trace * trace) / ((lam + 1.0) * (lam - 2.0))

    # the spread of the means as a sum of squares, not as a difference of second moments
    gaps = [s.extent - extent for s in states]
    variance = total([own_variance(s) + g.inner(g) for s, g in zip(states, gaps, strict=True)])
    a, b = extent.inner(extent), extent.trace() ** 2
    c = variance + a + b
    freedom = (c + jnp.sqrt(c * c + 8.0 * variance * (variance + a))) / (2.0 * variance)
    return LanLiState(position, velocity, kinematic, extent, freedom)


def lan_li(params: Params, model: TrackingModel) -> Filter:
    """Random matrix with rotation and agility.

    Source: J. Lan and X. R. Li, IEEE Trans. Aerosp. Electron. Syst. 52 (2016), as used by Yao et al. 2020; the
    equations were derived again from the model.
    """

    def init(prior: Prior, key) -> LanLiState:
        extent = extent_matrix(prior.ellipse)
        size = jnp.sqrt(extent.det())
        cov = prior.cov
        kinematic = Sym2(
            0.5 * (cov[0, 0] + cov[1, 1]) / size,
            0.5 * (cov[0, 2] + cov[1, 3]) / size,
            0.5 * (cov[2, 2] + cov[3, 3]) / size,
        )
        return LanLiState(
            Vec2.of(prior.mean[:2]), Vec2.of(prior.mean[2:]), kinematic, extent, params.degrees_of_freedom - 6.0
        )

    def predict_step(state, dt, key):
        return predict(state, dt, params)

    def update_step(state: LanLiState, scan: Measurements, key):
        spread = model.extent_scale * state.extent + model.sensor_noise
        info: Info = innovation_info(state.position, state.kinematic.xx * state.extent, spread, scan)
        new, log_likelihood = update(state, scan_statistics(scan), model)
        seen = is_seen(scan)
        return new, info._replace(log_likelihood=jnp.where(seen, log_likelihood, 0.0))

    def estimate(state: LanLiState) -> Estimate:
        larger, smaller, direction = state.extent.eigen()
        mean = jnp.stack([state.position.x, state.position.y, state.velocity.x, state.velocity.y])
        cov = jnp.kron(state.kinematic.array(), state.extent.array())
        return Estimate(mean, cov, Ellipse(jnp.sqrt(jnp.stack([larger, smaller])), direction))

    return Filter(init, predict_step, update_step, estimate, merge)


def build(settings: LanLiSettings):
    """Traced parameters and static builder of the settings."""
    params = Params(settings.degrees_of_freedom, settings.psd, settings.agility, settings.rotation)
    return params, lan_li


FILTERS.register("lan_li", LanLiSettings, build)

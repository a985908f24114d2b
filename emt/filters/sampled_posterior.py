"""The posterior of the elliptical model by Monte Carlo: a slow reference for single updates."""

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal, NamedTuple

import jax
import jax.numpy as jnp
from jax.tree_util import register_dataclass
from jaxtyping import Array, Float
from pydantic import Field

from emt.filters import kinematics
from emt.filters import vb_random_matrix as vb
from emt.filters.base import TrackingModel, innovation_info
from emt.linalg import Sym2, Vec2, once, parallel
from emt.logarithm import log
from emt.registry import FILTERS
from emt.scans import ScanStatistics, scan_statistics
from emt.settings import PositiveAngleVariance, Settings, ShapeParameter
from emt.types import Ellipse, Estimate, Filter, Measurements, Prior, Scalar, Traced


class SampledPosteriorSettings(Settings):
    """Posterior by importance sampling from the prior, with the kinematics integrated exactly.

    The prior is that of `vb_random_matrix`. After an update the posterior is matched by a member of the same family,
    so it can be used over several scans, but it is meant as the reference of single updates.
    """

    kind: Literal["sampled_posterior"] = "sampled_posterior"
    reads_points: ClassVar[bool] = False
    samples: Annotated[int, Field(ge=1_000, le=10_000_000)] = 1_000_000
    shape: tuple[ShapeParameter, ShapeParameter] = (10.0, 10.0)
    """Prior inverse-gamma shapes of the squared semi-axes."""
    orientation_variance: PositiveAngleVariance = 0.2
    """Prior variance of the orientation."""


@register_dataclass
@dataclass(frozen=True)
class Params:
    """Traced numbers of the filter."""

    shape: tuple[Traced, Traced]
    orientation_variance: Traced


class SampledState(NamedTuple):
    """The matched posterior and the ellipse of posterior medians."""

    matched: vb.VbState
    median: Ellipse


class Samples(NamedTuple):
    """Weighted samples of orientation and squared semi-axes with the position given each of them."""

    orientation: Float[Array, "n"]
    x1: Float[Array, "n"]
    x2: Float[Array, "n"]
    log_weight: Float[Array, "n"]
    position: Vec2
    position_cov: Sym2


def weighted_gamma(normal: Float[Array, "n"], shape: Scalar) -> tuple[Float[Array, "n"], Float[Array, "n"]]:
    """Weighted draws from a gamma distribution of unit scale and shape above 1, one per normal draw; and log weights.

    The transform d (1 + c z)³ of Marsaglia and Tsang (ACM Trans. Math. Softw. 26, 2000) with its acceptance
    probability as a weight instead of a rejection loop: exact, and nearly as efficient as plain draws.
    """
    d = shape - 1.0 / 3.0
    v = (1.0 + normal / jnp.sqrt(9.0 * d)) ** 3
    positive = v > 0.0
    v = jnp.where(positive, v, 1.0)
    log_ratio = 0.5 * normal * normal + d - d * v + d * log(v)
    return d * v, jnp.where(positive, log_ratio, -jnp.inf)


def draw(state: vb.VbState, stats: ScanStatistics, model: TrackingModel, key, n: int) -> Samples:
    """Samples from the prior, weighted with the likelihood of the scan given orientation and extent.

    The likelihood factors into that of the scan mean, N(ȳ; p, C + Y/m), and that of the scatter about it,
    |Y|^(-(m-1)/2) exp(-½ tr(Y⁻¹ scatter)), with Y = s L X Lᵀ + R.
    """
    normals = jax.random.normal(key, (3, n), stats.count.dtype)
    orientation = state.orientation + jnp.sqrt(state.orientation_var) * normals[0]
    gamma_1, log_ratio_1 = weighted_gamma(normals[1], state.shape.x)
    gamma_2, log_ratio_2 = weighted_gamma(normals[2], state.shape.y)
    x1, x2 = state.scale.x / gamma_1, state.scale.y / gamma_2

    def weigh(theta, a, b):
        m = jnp.maximum(stats.count, 1.0)
        extent = Sym2.ellipse(jnp.sqrt(a), jnp.sqrt(b), theta)
        spread = once(model.extent_scale * extent + model.sensor_noise, model.extent_scale)
        mean_noise = (1.0 / m) * spread
        belief = state.kinematics
        innovation_cov = belief.position_cov + mean_noise
        innovation = stats.mean - belief.position
        weight = once(innovation_cov.inverse(), model.extent_scale)
        log_weight = -0.5 * (
            weight.quadratic(innovation)
            + log(innovation_cov.det())
            + (m - 1.0) * log(spread.det())
            + spread.inverse().inner(stats.scatter)
        )
        position = belief.position + belief.position_cov @ (weight @ innovation)
        return log_weight, position, parallel(belief.position_cov, mean_noise)

    log_weight, position, position_cov = jax.vmap(weigh)(orientation, x1, x2)
    return Samples(orientation, x1, x2, log_weight + log_ratio_1 + log_ratio_2, position, position_cov)


def weighted_median(values: Float[Array, "n"], weights: Float[Array, "n"]) -> Scalar:
    """The least of the values at which half of the weight is reached.

    By halving an interval around it down to one number: sorting a million values takes four times as long.
    """
    half = 0.5 * weights.sum()

    def middle(bounds):
        low, high = bounds
        return low + 0.5 * (high - low)

    def is_wide(bounds):
        return (bounds[0] < middle(bounds)) & (middle(bounds) < bounds[1])

    def narrower(bounds):
        low, high = bounds
        is_reached = jnp.where(values <= middle(bounds), weights, 0.0).sum() >= half
        return jnp.where(is_reached, low, middle(bounds)), jnp.where(is_reached, middle(bounds), high)

    start = jnp.nextafter(values.min(), -jnp.inf), values.max()
    return jax.lax.while_loop(is_wide, narrower, start)[1]


def match(state: vb.VbState, samples: Samples) -> SampledState:
    """Moment matching: Gaussian position and orientation; inverse gammas by E[X] and E[1/X]."""
    weights = jnp.exp(samples.log_weight - samples.log_weight.max())
    weights = weights / weights.sum()

    def mean(values):
        return (weights * values).sum()

    position = Vec2(mean(samples.position.x), mean(samples.position.y))
    dx, dy = samples.position.x - position.x, samples.position.y - position.y
    cov = samples.position_cov
    position_cov = Sym2(mean(cov.xx + dx * dx), mean(cov.xy + dx * dy), mean(cov.yy + dy * dy))
    orientation = mean(samples.orientation)
    orientation_var = mean((samples.orientation - orientation) ** 2)

    def inverse_gamma(values):
        inverse = mean(1.0 / values)
        product = mean(values) * inverse  # = α / (α - 1) > 1
        shape = product / (product - 1.0)
        return shape, shape / inverse

    (a1, b1), (a2, b2) = inverse_gamma(samples.x1), inverse_gamma(samples.x2)
    belief = kinematics.with_position(state.kinematics, position, position_cov)
    axes = jnp.sqrt(jnp.stack([weighted_median(samples.x1, weights), weighted_median(samples.x2, weights)]))
    median = Ellipse(axes, weighted_median(samples.orientation, weights))
    return SampledState(vb.VbState(belief, orientation, orientation_var, Vec2(a1, a2), Vec2(b1, b2)), median)


def effective_sample_size(samples: Samples) -> Scalar:
    """1 / Σ w² of the normalised weights."""
    weights = jnp.exp(samples.log_weight - samples.log_weight.max())
    return weights.sum() ** 2 / (weights**2).sum()


def sampled_posterior(n: int, params: Params, model: TrackingModel) -> Filter:
    """Reference posterior of the model of Tuncer and Özkan 2021, Sec. II, by self-normalised importance sampling."""
    # the time update, where one is asked for, is that of a static shape
    still = vb.Params(
        params.shape,
        params.orientation_variance,
        jnp.zeros_like(params.orientation_variance),
        jnp.ones_like(params.orientation_variance),
    )
    closed_form = vb.vb_random_matrix(1, still, model)

    def init(prior: Prior, key) -> SampledState:
        return SampledState(closed_form.init(prior, key), prior.ellipse)

    def predict(state: SampledState, dt: Scalar, key) -> SampledState:
        return SampledState(vb.predict(state.matched, dt, model, still), state.median)

    def update(state: SampledState, scan: Measurements, key):
        matched = state.matched
        axes = vb.semi_axes(matched)
        spread = model.extent_scale * Sym2.ellipse(axes.x, axes.y, matched.orientation) + model.sensor_noise
        belief = matched.kinematics
        info = innovation_info(belief.position, belief.position_cov, spread, scan)
        samples = once(draw(matched, scan_statistics(scan), model, key, n), model.extent_scale)
        return match(matched, samples), info

    def estimate(state: SampledState) -> Estimate:
        belief = state.matched.kinematics
        return Estimate(belief.mean(), belief.cov(), state.median)

    return Filter(init, predict, update, estimate)


def build(settings: SampledPosteriorSettings):
    """Traced parameters and static builder of the settings."""
    params = Params(settings.shape, settings.orientation_variance)
    n = settings.samples
    return params, lambda params, model: sampled_posterior(n, params, model)


FILTERS.register("sampled_posterior", SampledPosteriorSettings, build)

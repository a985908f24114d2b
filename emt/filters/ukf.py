"""Unscented Kalman filter of a point, with sigma points drawn anew, carried on, or augmented by the noise."""

from typing import Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from emt.filters.gaussian import Belief, Innovation, Kernel, Prediction, conditioned
from emt.filters.state_space import gaussian_filter, motion_faults
from emt.filters.unscented import Spread
from emt.linalg import cholesky, semidefinite_root
from emt.models.state_space.model import StateSpaceModel
from emt.models.state_space.motions import Motion
from emt.registry import FILTERS
from emt.settings import PointSettings, PositiveFloat, Settings
from emt.types import Filter, Scalar

PointRule = Literal["redrawn", "propagated", "augmented"]


class UnscentedSettings(Settings):
    """Constants of the scaled unscented transform, and which points a measurement is expected from."""

    alpha: PositiveFloat = 1.0
    """Much below 1, the weight of the centre is huge and negative: double precision only."""
    beta: float = 2.0
    kappa: float = 0.0
    points: PointRule = "redrawn"
    """"redrawn" from the prediction with its process noise; "propagated", those that gave it, without the noise; or
    "augmented" by the process noise, so that the points that gave the prediction hold the noise."""

    @property
    def spread(self) -> Spread:
        return Spread(self.alpha, self.kappa, self.beta)


class UkfSettings(UnscentedSettings, PointSettings):
    """Unscented Kalman filter of a point."""

    kind: Literal["ukf"] = "ukf"
    motion: str | None = None
    """Motion of the model it believes in; needed where there are several."""

    def faults_with(self, model) -> list[tuple[str, str]]:
        """What does not fit the model, by key."""
        return motion_faults(model, self.motion) or spread_faults(self, len(model.states))


def spread_faults(settings: UnscentedSettings, n: int) -> list[tuple[str, str]]:
    """Whether sigma points exist for states of n entries."""
    dimension = 2 * n if settings.points == "augmented" else n
    if dimension + settings.kappa > 0.0:
        return []
    return [("kappa", f"must be greater than -{dimension}, or there are no sigma points, got {settings.kappa:g}")]


def sigma_points(mean: Float[Array, "n"], root: Float[Array, "n k"], step: Scalar) -> Float[Array, "n_points n"]:
    """The mean, and the mean plus and minus `step` times each column of a root."""
    columns = step * root.T
    return jnp.concatenate([mean[None, :], mean[None, :] + columns, mean[None, :] - columns])


def weights_of(spread: Spread, dimension: int) -> tuple[Float[Array, "n_points"], Float[Array, "n_points"]]:
    """Weights of sigma points for means and for covariances.

    Source: Azimian 2005, eq. 2.11, where "W^(m) = W^(m)" should read W^(c) = W^(m).
    """
    squared = jnp.asarray(spread.squared_step(dimension))
    mean = jnp.full(2 * dimension + 1, 0.5 / squared).at[0].set(1.0 - dimension / squared)
    return mean, mean.at[0].add(1.0 - spread.gamma**2 + spread.beta)


def ukf_kernel(
    model: StateSpaceModel,
    motion: Motion,
    spread: Spread,
    rule: PointRule,
    noise_cov: Float[Array, "n n"] | None = None,
    measurement_cov: Float[Array, "m m"] | None = None,
) -> Kernel:
    """Unscented Kalman filter; the measurement noise is additive.

    Means and differences of measurements are taken about that of the central point, with angles wrapped.

    Args:
        noise_cov, measurement_cov: noises to believe in, if not those of the model.

    Source: Julier and Uhlmann 1997; Azimian 2005, eqs. 2.11 to 2.23.
    """
    n = len(model.point.names)
    dimension = 2 * n if rule == "augmented" else n
    for_mean, for_cov = weights_of(spread, dimension)
    step = jnp.sqrt(spread.squared_step(dimension))

    def points_of(belief: Belief) -> Float[Array, "n_points n"]:
        root = cholesky(belief.cov)
        return sigma_points(belief.mean, jnp.pad(root, ((0, 0), (0, dimension - n))), step)

    def start(belief: Belief) -> Prediction:
        return Prediction(belief, points_of(belief))

    def predict(belief: Belief, time: Scalar, dt: Scalar) -> Prediction:
        noise = motion.noise_cov(dt) if noise_cov is None else noise_cov
        points = jax.vmap(lambda x: motion.move(x, time, dt))(points_of(belief))
        if rule == "augmented":
            columns = jnp.pad(semidefinite_root(noise), ((0, 0), (n, 0)))
            points = points + sigma_points(jnp.zeros(n, noise.dtype), columns, step)
        mean = for_mean @ points
        gaps = points - mean[None, :]
        cov = (for_cov[:, None, None] * (gaps[:, :, None] * gaps[:, None, :])).sum(axis=0)
        new = Belief(mean, cov if rule == "augmented" else cov + noise)
        return Prediction(new, points_of(new) if rule == "redrawn" else points)

    def update(now: Prediction, value: Float[Array, "m"], time: Scalar) -> tuple[Belief, Innovation]:
        assert now.points is not None
        measurement = model.measurement
        seen = jax.vmap(lambda x: measurement.observe(x, time))(now.points)
        about = jax.vmap(lambda z: measurement.difference(z, seen[0]))(seen)
        shift = for_mean @ about
        gaps, off = about - shift[None, :], now.points - now.belief.mean[None, :]
        cov = (for_cov[:, None, None] * (gaps[:, :, None] * gaps[:, None, :])).sum(axis=0)
        cross = (for_cov[:, None, None] * off[:, :, None] * gaps[:, None, :]).sum(axis=0)
        cov = cov + (measurement.noise_cov() if measurement_cov is None else measurement_cov)
        return conditioned(now.belief, cross, cov, measurement.difference(value, seen[0] + shift))

    return Kernel(start, predict, update)


def build(settings: UkfSettings):
    """Traced constants of the transform and builder of the filter."""
    name, rule = settings.motion, settings.points

    def make(spread: Spread, model: StateSpaceModel) -> Filter:
        return gaussian_filter(model, ukf_kernel(model, model.motion(name), spread, rule))

    return settings.spread, make


FILTERS.register("ukf", UkfSettings, build)

"""Detections: how many points a scan holds, where on the object they lie, and the sensor noise."""

import math
from dataclasses import dataclass
from typing import Annotated, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import register_dataclass
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray
from pydantic import Field, NonNegativeInt, PositiveInt
from scipy.stats import poisson

from emt.keys import step_key
from emt.linalg import Mat2
from emt.matrices import Matrix
from emt.settings import NoiseCovariance, Settings
from emt.types import Measurements, Scalar, Traced, Truth

OVERFLOW_PROBABILITY = 1e-9
"""Bound on the probability that any scan of a whole experiment exceeds the capacity."""
LARGEST_EXPERIMENT = 1_000_000
"""Runs for which the bound holds at least; more runs enlarge the capacity, which changes no detection."""


class PoissonCount(Settings):
    """A Poisson number of points per scan."""

    kind: Literal["poisson"] = "poisson"
    mean: Annotated[float, Field(gt=0.0, le=10_000.0)]
    minimum: NonNegativeInt = 0
    """Smaller counts are raised to this number."""


class FixedCount(Settings):
    """The same number of points in every scan."""

    kind: Literal["fixed"] = "fixed"
    count: NonNegativeInt


class DetectionSettings(Settings):
    """Points per scan, their source on the object, and the sensor noise."""

    count: Annotated[PoissonCount | FixedCount, Field(discriminator="kind")]
    source: Literal["uniform", "gaussian", "box"]
    """"uniform" over the filled ellipse, "gaussian" with the extent (squared semi-axes) as covariance, or uniform in
    the "box" whose smallest enclosing ellipse is the object's."""
    noise_cov: NoiseCovariance
    """Covariance of the Gaussian sensor noise of each point."""
    max_points: PositiveInt | None = None
    """Capacity of a scan; by default as large as the counts need."""


@register_dataclass
@dataclass(frozen=True)
class DetectionParams:
    """Traced numbers of the detections."""

    mean_count: Traced
    noise_chol: Mat2


def capacity_for(settings: DetectionSettings, n_steps: int, runs: int) -> int:
    """Slots per scan, such that every scan of the experiment fits except with probability below 1e-9."""
    if settings.max_points is not None:
        return settings.max_points
    if isinstance(settings.count, FixedCount):
        return max(settings.count.count, 1)
    per_scan = OVERFLOW_PROBABILITY / (n_steps * max(runs, LARGEST_EXPERIMENT))
    candidates = np.arange(1, int(settings.count.mean + 40.0 * math.sqrt(settings.count.mean) + 100.0))
    # the survival function itself: its inverse is not accurate this far out
    enough = candidates[poisson.sf(candidates, settings.count.mean) < per_scan]
    return max(int(enough[0]), settings.count.minimum)


def noise_root(noise_cov: Matrix) -> Mat2:
    """Lower triangular root of a covariance, which may be singular."""
    (a, b), (_, d) = noise_cov
    l11 = math.sqrt(a)
    l21 = b / l11 if l11 > 0.0 else 0.0
    return Mat2(l11, 0.0, l21, math.sqrt(max(d - l21 * l21, 0.0)))


def params_of(settings: DetectionSettings) -> DetectionParams:
    """Traced numbers of the settings."""
    mean = settings.count.mean if isinstance(settings.count, PoissonCount) else float(settings.count.count)
    return DetectionParams(mean, noise_root(settings.noise_cov))


def poisson_count(key: PRNGKeyArray, mean: Scalar, capacity: int) -> tuple[Int[Array, ""], Bool[Array, ""]]:
    """A Poisson number by inversion of its distribution function, up to `capacity`; and whether it was larger.

    Inversion uses one uniform whatever the mean, so the number does not depend on batching or capacity.
    """
    k = jnp.arange(capacity + 1, dtype=mean.dtype)
    cdf = jnp.cumsum(jnp.exp(k * jnp.log(mean) - mean - jax.scipy.special.gammaln(k + 1.0)))
    count = (jax.random.uniform(key, dtype=mean.dtype) > cdf).sum()
    return jnp.minimum(count, capacity), count > capacity


def unit_disc(key: PRNGKeyArray, n: int, dtype) -> Float[Array, "n 2"]:
    """Points uniform in the unit disc."""
    u = jax.random.uniform(key, (n, 2), dtype)
    radius, angle = jnp.sqrt(u[:, 0]), 2.0 * jnp.pi * u[:, 1]
    return jnp.stack([radius * jnp.cos(angle), radius * jnp.sin(angle)], axis=1)


def sample_scan(
    key: PRNGKeyArray, truth: Truth, settings: DetectionSettings, params: DetectionParams, capacity: int
) -> Measurements:
    """One scan of the object."""
    count_key, source_key, noise_key = (jax.random.fold_in(key, i) for i in range(3))
    if isinstance(settings.count, PoissonCount):
        count, overflow = poisson_count(count_key, params.mean_count, capacity)
        count = jnp.minimum(jnp.maximum(count, settings.count.minimum), capacity)
    else:
        count = jnp.asarray(min(settings.count.count, capacity))
        overflow = jnp.asarray(settings.count.count > capacity)
    dtype = truth.position.dtype
    if settings.source == "uniform":
        source = unit_disc(source_key, capacity, dtype)
    elif settings.source == "box":
        side = math.sqrt(0.5)
        source = jax.random.uniform(source_key, (capacity, 2), dtype, -side, side)
    else:
        source = jax.random.normal(source_key, (capacity, 2), dtype)
    noise = jax.random.normal(noise_key, (capacity, 2), dtype)
    axes, turn, chol = truth.ellipse.semi_axes, Mat2.rotation(truth.ellipse.orientation), params.noise_chol
    along, across = axes[0] * source[:, 0], axes[1] * source[:, 1]
    x = truth.position[0] + turn.xx * along + turn.xy * across + chol.xx * noise[:, 0]
    y = truth.position[1] + turn.yx * along + turn.yy * across + chol.yx * noise[:, 0] + chol.yy * noise[:, 1]
    return Measurements(jnp.stack([x, y], axis=1), jnp.arange(capacity) < count, overflow)


def sample_scans(
    key: PRNGKeyArray, truth: Truth, settings: DetectionSettings, params: DetectionParams, capacity: int
) -> Measurements:
    """One scan per step of a true track; each step has its own key, so a longer track extends a shorter one."""
    steps = jnp.arange(truth.position.shape[0])
    return jax.vmap(lambda step, now: sample_scan(step_key(key, step), now, settings, params, capacity))(steps, truth)

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
from scipy.special import pdtrc

from emt.draws import normal_pairs, uniform_pairs, unit_disc
from emt.keys import step_key
from emt.linalg import Mat2, Vec2, once
from emt.matrices import Matrix
from emt.scans import over_batch, prepared
from emt.settings import NoiseCovariance, Settings
from emt.trigonometry import sincos
from emt.types import Measurements, Scalar, Traced, Truth

OVERFLOW_PROBABILITY = 1e-9
"""Bound on the probability that any scan of a whole experiment exceeds the capacity."""
LARGEST_EXPERIMENT = 1_000_000
"""Runs for which the bound holds at least; more runs enlarge the capacity, which changes no detection."""

VECTOR = 8
"""Capacities are multiples of it: the doubles that a processor handles at once."""


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
    return -(-max(rarely_exceeded(settings.count.mean, per_scan), settings.count.minimum) // VECTOR) * VECTOR


def rarely_exceeded(mean: float, probability: float) -> int:
    """The least number from 1 on that a Poisson number exceeds with less than this probability, which may be tiny."""
    candidates = np.arange(1, int(mean + 40.0 * math.sqrt(mean) + 100.0))
    return int(candidates[pdtrc(candidates, mean) < probability][0])


def usual_slots(settings: DetectionSettings, capacity: int) -> int:
    """Slots that are enough for all but one scan in ten thousand: those beyond are drawn only where they are needed."""
    if isinstance(settings.count, FixedCount):
        return capacity
    enough = max(rarely_exceeded(settings.count.mean, 1e-4), settings.count.minimum)
    return min(-(-enough // VECTOR) * VECTOR, capacity)


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


def poisson_cdf(mean: Scalar, capacity: int) -> Float[Array, "n"]:
    """Distribution function of a Poisson number at 0 to `capacity`."""
    k = jnp.arange(capacity + 1, dtype=mean.dtype)
    return jnp.cumsum(jnp.exp(k * jnp.log(mean) - mean - jax.scipy.special.gammaln(k + 1.0)))


def poisson_count(key: PRNGKeyArray, cdf: Float[Array, "n"]) -> tuple[Int[Array, ""], Bool[Array, ""]]:
    """A Poisson number by inversion of its distribution function, up to the capacity; and whether it was larger.

    Inversion uses one uniform whatever the mean, so the number does not depend on batching or capacity.
    """
    capacity = cdf.shape[0] - 1
    count = (jax.random.uniform(key, dtype=cdf.dtype) > cdf).sum()
    return jnp.minimum(count, capacity), count > capacity


def sample_source(key: PRNGKeyArray, kind: str, n: int, dtype) -> Vec2:
    """Points on an object with unit semi-axes."""
    if kind == "uniform":
        return unit_disc(key, n, dtype)
    if kind == "gaussian":
        return normal_pairs(key, n, dtype)
    u, v = uniform_pairs(key, n, dtype)
    side = math.sqrt(0.5)
    return Vec2(side * (2.0 * u - 1.0), side * (2.0 * v - 1.0))


def body_frame(truth: Truth) -> Mat2:
    """L diag(l1, l2): from an object with unit semi-axes to the true one (m)."""
    l1, l2 = truth.ellipse.semi_axes
    sine, cosine = sincos(truth.ellipse.orientation)
    return Mat2(l1 * cosine, -l2 * sine, l1 * sine, l2 * cosine)


def sample_scan(
    key: PRNGKeyArray, truth: Truth, settings: DetectionSettings, params: DetectionParams, cdf: Float[Array, "n"]
) -> Measurements:
    """One scan of the object; its capacity is one less than the length of `cdf`."""
    count_key, source_key, noise_key = (jax.random.fold_in(key, i) for i in range(3))
    capacity = cdf.shape[0] - 1
    if isinstance(settings.count, PoissonCount):
        count, overflow = poisson_count(count_key, cdf)
        count = jnp.minimum(jnp.maximum(count, settings.count.minimum), capacity)
    else:
        count = jnp.asarray(min(settings.count.count, capacity))
        overflow = jnp.asarray(settings.count.count > capacity)
    dtype, chol = truth.position.dtype, params.noise_chol
    body = once(body_frame(truth), params.mean_count)

    def drawn(n: int) -> tuple[Float[Array, "n"], Float[Array, "n"]]:
        """The first n points."""
        source = sample_source(source_key, settings.source, n, dtype)
        noise = normal_pairs(noise_key, n, dtype)
        # drawn once: the compiler would draw anew for each coordinate and each statistic
        source, noise = once((source, noise), params.mean_count)
        x = truth.position[0] + body.xx * source.x + body.xy * source.y + chol.xx * noise.x
        y = truth.position[1] + body.yx * source.x + body.yy * source.y + chol.yx * noise.x + chol.yy * noise.y
        return x, y

    usual = usual_slots(settings, capacity)
    if usual == capacity:
        x, y = once(drawn(capacity), params.mean_count)
    else:  # the rest of the slots is empty in nearly every batch

        def few():
            return tuple(jnp.pad(coordinate, (0, capacity - usual)) for coordinate in drawn(usual))

        x, y = jax.lax.cond(over_batch(count) > usual, lambda: drawn(capacity), few)
    return Measurements(jnp.stack([x, y], axis=1), jnp.arange(capacity) < count, overflow)


def sample_scans(
    key: PRNGKeyArray, truth: Truth, settings: DetectionSettings, params: DetectionParams, capacity: int
) -> Measurements:
    """One scan per step of a true track; each step has its own key, so a longer track extends a shorter one."""
    cdf = poisson_cdf(jnp.asarray(params.mean_count, truth.position.dtype), capacity)

    def step(step_and_truth) -> Measurements:
        step, now = step_and_truth
        return prepared(sample_scan(step_key(key, step), now, settings, params, cdf))

    # one step after the other: the draws of all runs at one step fit the cache
    return jax.lax.map(step, (jnp.arange(truth.position.shape[0]), truth))

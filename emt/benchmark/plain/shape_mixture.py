"""Interacting shape models of an arm with a claw, from the equations.

A. Zea, F. Faion and U. D. Hanebeck, "Tracking Connected Objects Using Interacting Shape Models" (2014): a point comes
from any of the components with equal probability. The update with each segment is that of a sampling filter, for which
the point in the segment's frame is a function of the state and of the place along the segment.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.stats import multivariate_normal
from jaxtyping import Array, Bool, Float

from emt.benchmark.peers.base import Scans
from emt.benchmark.peers.models import settings_of
from emt.benchmark.plain.base import Prepared, check_start, over_runs, rotation, where_each
from emt.config.experiment import Experiment
from emt.filters.shape_mixture_settings import ShapeMixtureSettings
from emt.sampling.rules import standard_points

ARM = ("length_a", "alpha_a", "length_b", "alpha_b", "alpha_c")
"""Parameters of the object; every angle is followed by its rate in the state."""


class Model(NamedTuple):
    """What the filter is told."""

    F: Float[Array, "8 8"]
    Q: Float[Array, "8 8"]
    """Of a step."""
    sigma2: float
    """Variance of the sensor noise (m²)."""
    radius: float
    """Of the disc (m)."""
    finger: float
    """Length (m)."""
    samples: Float[Array, "sample 9"]
    """Of a standard normal density of state and place on a component."""


class Updated(NamedTuple):
    """The state given that a point comes from one component."""

    x: Float[Array, "8"]
    cov: Float[Array, "8 8"]
    log_likelihood: Float[Array, ""]


def residuals(
    x: Float[Array, "8"], share: Float[Array, ""], y: Float[Array, "2"], finger: float
) -> Float[Array, "4 2"]:
    """The place at this share of each segment, less the point y, in the frame of the segment (m)."""
    length_a, alpha_a, _, length_b, alpha_b, _, alpha_c, _ = x
    upper = alpha_a
    lower = upper + alpha_b - jnp.pi
    elbow = length_a * jnp.array([jnp.cos(upper), jnp.sin(upper)])
    hand = elbow + length_b * jnp.array([jnp.cos(lower), jnp.sin(lower)])
    start = jnp.array([jnp.zeros(2), elbow, hand, hand])
    direction = jnp.array([upper, lower, lower + 0.5 * alpha_c, lower - 0.5 * alpha_c])
    length = jnp.array([length_a, length_b, finger, finger])

    def segment(start, direction, length):
        return jnp.array([length * share, 0.0]) - rotation(direction).T @ (y - start)

    return jax.vmap(segment)(start, direction, length)


def update(x: Float[Array, "8"], cov: Float[Array, "8 8"], y: Float[Array, "2"], model: Model):
    """Mean and covariance given a point of any component."""
    sigma2, radius = model.sigma2, model.radius
    steps = model.samples[:, :8] @ jnp.linalg.cholesky(cov).T
    # a place uniform on the segment has the mean and variance of this one
    shares = 0.5 + model.samples[:, 8] / 12.0**0.5
    h = jax.vmap(residuals, in_axes=(0, 0, None, None))(x[None, :] + steps, shares, y, model.finger)

    def segment(h: Float[Array, "sample 2"]) -> Updated:
        center = h.mean(axis=0)
        gaps = h - center[None, :]
        spread = gaps.T @ gaps / len(h) + sigma2 * jnp.eye(2)
        gain = (steps.T @ gaps / len(h)) @ jnp.linalg.inv(spread)
        log_likelihood = jnp.asarray(multivariate_normal.logpdf(jnp.zeros(2), center, spread))
        return Updated(x - gain @ center, cov - gain @ spread @ gain.T, log_likelihood)

    def disc() -> Updated:
        gap = y @ y - radius**2 / 2.0 - 2.0 * sigma2
        variance = radius**4 / 12.0 + 4.0 * sigma2**2 + 2.0 * sigma2 * radius**2
        # per area: the squared distance has the density of a point times pi
        return Updated(x, cov, -0.5 * (gap**2 / variance + jnp.log(2.0 * jnp.pi * variance)) - jnp.log(jnp.pi))

    segments = jax.vmap(segment, in_axes=1)(h)
    means, covs, gains = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), disc(), segments)
    weights = jax.nn.softmax(gains)
    mean = weights @ means
    gaps = means - mean[None, :]
    return mean, (weights[:, None, None] * (covs + jax.vmap(jnp.outer)(gaps, gaps))).sum(axis=0)


def prepare(experiment: Experiment, scans: Scans) -> Prepared:
    """The filter on scans of some runs.

    Raises:
        ValueError: the object or the filter is another one.
    """
    check_start(experiment)
    settings, dt = settings_of(experiment, "shape_mixture"), experiment.scenario.dt
    given: Any = experiment.model
    if tuple(given.shape.parameters) != ARM:
        raise ValueError("the plain form knows the arm with a claw only")
    if settings != ShapeMixtureSettings(samples=settings.samples) or settings.samples.rule != "lcd":
        raise ValueError("the plain form knows LCD samples, and components that are equally probable for every point")
    entries, prior, components = [], given.prior, given.shape.components
    for name, kind in given.shape.parameters.items():
        entries += [prior.lengths[name]] if kind == "length" else [prior.angles[name], prior.rates.get(name, 0.0)]
    means = np.tile(entries, (len(scans.points), 1)) if scans.prior_means is None else scans.prior_means
    cov = jnp.diag(jnp.array(prior.variance.of(given.shape)))
    model = Model(
        jnp.eye(8).at[jnp.array([1, 4, 6]), jnp.array([2, 5, 7])].set(dt),
        jnp.diag(jnp.array(given.process_variance.of(given.shape))),
        given.noise_cov[0][0],
        components["hub"].radius,
        components["finger_1"].length,
        jnp.array(standard_points("lcd", 9, settings.samples.count, settings.samples.seed).points),
    )

    def one(now, slot):
        (x, cov), (y, seen) = now, slot
        return where_each(seen, update(x, cov, y, model), now), None

    def step(now, scan):
        x, cov = now
        new, _ = jax.lax.scan(one, (model.F @ x, model.F @ cov @ model.F.T + model.Q), scan)
        return new, new[0]

    def track(mean: Float[Array, "8"], points: Float[Array, "step slot 2"], mask: Bool[Array, "step slot"]):
        return jax.lax.scan(step, (mean, cov), (points, mask))[1]

    return over_runs(track, means, scans.points, scans.mask)

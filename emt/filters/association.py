"""One point of a connected object: an update per component, and what their association makes of them.

Source: A. Zea, F. Faion and U. D. Hanebeck, "Tracking Connected Objects using Interacting Shape Models", FUSION 2014.
"""

from math import pi
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from emt.filters.sampling_update import Moments, conditioned, mixed
from emt.linalg import Vec2, cholesky
from emt.shapes.connected import Connected
from emt.shapes.linkage import Segment, disc_residual_moments, place, segment_residual
from emt.types import Scalar


class Components(NamedTuple):
    """What each component makes of a point."""

    log_density: Float[Array, "c"]
    """Log density of the point, per area (m⁻²)."""
    mean: Float[Array, "c n"]
    cov: Float[Array, "c n n"]
    distance: Float[Array, "c"]
    """Squared Mahalanobis distance of the pseudo-measurement from zero."""


def component_updates(
    mean: Float[Array, "n"],
    cov: Float[Array, "n n"],
    point: Vec2,
    noise_variance: Scalar,
    samples: Float[Array, "count d"],
    shape: Connected,
) -> Components:
    """Updates of one belief by one point under isotropic sensor noise, as if each component were its source.

    Segments share one square root of the covariance, one set of samples of (state, place along the segment) and one
    placement of the chain. Isotropic noise is additive in the frame of a segment. A disc reads no parameter: its update
    is the identity, exactly.
    """
    n, share, count = mean.shape[0], 1.0 / samples.shape[0], len(shape.components)
    steps = (cholesky(cov)[None, :, :] * samples[:, None, :n]).sum(axis=-1)
    along = 0.5 + samples[:, n] / jnp.sqrt(jnp.asarray(12.0, mean.dtype))  # uniform on (0, 1) in mean and variance
    origin = Vec2(*(jnp.asarray(x, mean.dtype) for x in shape.origin))

    def residuals(state, s):
        placed = place(shape.links, state, origin)
        return jnp.stack([segment_residual(segment, s, point).array() for segment in placed])

    values = jax.vmap(residuals)(mean[None, :] + steps, along)
    center = share * values.sum(axis=0)
    gaps = values - center[None]
    spread = share * (gaps[..., :, None] * gaps[..., None, :]).sum(axis=0)
    additive = noise_variance * jnp.eye(2, dtype=mean.dtype)
    moments = Moments(center, spread + additive[None], share * jnp.einsum("in,isj->snj", steps, gaps))
    new = jax.vmap(conditioned, in_axes=(None, None, 0))(mean, cov, moments)

    link_of = dict(shape.segments)
    disc_of = {component: (radius, center) for component, radius, center in shape.discs}
    rows = []
    for k in range(count):
        if k in link_of:
            j = link_of[k]
            det = moments.cov[j, 0, 0] * moments.cov[j, 1, 1] - moments.cov[j, 0, 1] ** 2
            distance = -2.0 * new.log_density[j] - 2.0 * jnp.log(jnp.asarray(2.0 * pi, mean.dtype)) - jnp.log(det)
            rows.append((new.log_density[j], new.mean[j], new.cov[j], distance))
            continue
        radius, at = disc_of[k]
        h, variance = disc_residual_moments(
            jnp.asarray(radius, mean.dtype), Vec2(*(jnp.asarray(x, mean.dtype) for x in at)), noise_variance, point
        )
        # the density of |y - b|², whose area element is π as large
        log_density = -0.5 * (h * h / variance + jnp.log(2.0 * pi * variance)) - jnp.log(jnp.asarray(pi, mean.dtype))
        rows.append((log_density, mean, cov, h * h / variance))
    return Components(*(jnp.stack(column) for column in zip(*rows, strict=True)))


def weighted(parts: Components, log_prior: Float[Array, "c"]):
    """Weights, mean and covariance of the moment-matched mixture over the components (random switch)."""
    return mixed(parts.log_density + log_prior, parts.mean, parts.cov)


def direct(parts: Components, log_prior: Float[Array, "c"]):
    """The update of the most probable component alone, with a weight of one."""
    return only(parts, jnp.argmax(parts.log_density + log_prior))


def only(parts: Components, component: Array):
    """The update of one component alone: the nearest one's, or the one that is known."""
    weights = (jnp.arange(parts.log_density.shape[0]) == component).astype(parts.mean.dtype)
    return weights, parts.mean[component], parts.cov[component]


def distances(segments: list[Segment], shape: Connected, point: Vec2) -> Float[Array, "c"]:
    """Euclidean distance of a point to every component (m); zero inside a disc."""
    link_of = dict(shape.segments)
    disc_of = {component: (radius, center) for component, radius, center in shape.discs}
    found = []
    for k in range(len(shape.components)):
        if k in link_of:
            segment = segments[link_of[k]]
            local = segment_residual(segment, jnp.zeros_like(segment.length), point)
            beyond = -local.x - jnp.clip(-local.x, 0.0, jnp.maximum(segment.length, 0.0))
            found.append(jnp.hypot(beyond, local.y))
        else:
            radius, at = disc_of[k]
            found.append(jnp.maximum(jnp.hypot(point.x - at[0], point.y - at[1]) - radius, 0.0))
    return jnp.stack(found)

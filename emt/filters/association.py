"""One point of a connected object: what each component makes of it, and updates by their association.

Source: A. Zea, F. Faion and U. D. Hanebeck, "Tracking Connected Objects using Interacting Shape Models", FUSION 2014.
"""

from math import pi
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from emt.linalg import Mat2, Sym2, Vec2, cholesky, once
from emt.logarithm import log
from emt.shapes.articulated import as_vec, semi_axes_of
from emt.shapes.connected import Body, Connected
from emt.shapes.linkage import disc_residual_moments, in_frames, length_of, segment_residual, turns_of
from emt.types import Scalar


class Samples(NamedTuple):
    """Weighted points of mean 0 and covariance I that stand for state, place on a component and, if wanted, noise."""

    points: Float[Array, "count d"]
    weights: Float[Array, "count"]


class Rules(NamedTuple):
    """How components see a point; fixed when a program is compiled."""

    augmented: bool = False
    """Whether the sensor noise is sampled (two more dimensions); else it is isotropic and adds exactly."""
    cross_term: bool = True
    """Whether the spread of a disc's residual includes twice the product of source and noise."""
    disc_density_factor: float = 1.0 / pi
    """Density per area of a disc, in units of the density of its residual."""


class Evidence(NamedTuple):
    """What each component makes of a point."""

    log_density: Float[Array, "c"]
    """Log density of the point, per area (m⁻²)."""
    distance: Float[Array, "c"]
    """Squared Mahalanobis distance of the pseudo-measurement from zero."""
    shift: Float[Array, "c n"]
    """Updated less predicted mean, were the component the source."""
    cross: tuple[Float[Array, "c n"], Float[Array, "c n"]]
    """Covariance of the state with both entries of the pseudo-measurement; zero where there is none."""
    inverse: Sym2
    """Inverse covariances of the pseudo-measurements, with entries of shape (c,)."""
    pull: tuple[Float[Array, "c"], Float[Array, "c"]]
    """These inverses times the means of the pseudo-measurements."""


def dimension(plan: Connected, rules: Rules) -> int:
    """Dimension of the samples: state, place on a component and, if sampled, noise."""
    return len(plan.state) + (3 if rules.augmented else 1)


def evidence(
    mean: Float[Array, "n"],
    cov: Float[Array, "n n"],
    point: Vec2,
    noise_cov: Sym2,
    samples: Samples,
    plan: Connected,
    rules: Rules = Rules(),  # noqa: B008
    chosen: tuple[int, ...] | None = None,
) -> Evidence:
    """Sampling Kalman updates of one belief by one point, as if each component were its source.

    All components share one square root L of the covariance, one set of samples u and one pass along the chain. The
    samples are the same for every run, so both products with them, the steps L u and the covariances L Σ w u hᵀ of
    state and residuals, are one product of matrices for a whole batch. A disc reads no parameter: its update is the
    identity, exactly.

    Args:
        chosen: components that are wanted, by default all; rows come in their order.

    Source: J. Steinbring and U. D. Hanebeck 2013 (S2KF); Zea, Faion and Hanebeck 2014 for residuals that are 0.
    """
    n, dtype = mean.shape[0], mean.dtype
    wanted = tuple(range(len(plan.components))) if chosen is None else chosen
    segments = [(component, link) for component, link in plan.segments if component in wanted]
    bodies = [body for body in plan.bodies if body.component in wanted]
    zero, none = jnp.zeros((), dtype), jnp.zeros(n, dtype)
    rows = {}
    for component, radius, at in plan.discs:
        log_density, distance = _disc(radius, at, dtype, point, noise_cov, rules)
        rows[component] = (log_density, distance, none, none, none, zero, zero, zero, zero, zero)
    if segments or bodies:
        root, unit = cholesky(cov), samples.points[:, :n]
        states = mean[None, :] + unit @ root.T
        along = 0.5 + samples.points[:, n] / jnp.sqrt(jnp.asarray(12.0, dtype))  # uniform in mean and variance
        noise_root = Mat2.of(cholesky(noise_cov.array())) if rules.augmented else None

        turns = once(jax.vmap(lambda state: turns_of(plan.links, state))(states), noise_cov.xx)

        def residuals(turns, state, s, w) -> list[Scalar]:
            seen = point if noise_root is None else point - noise_root @ Vec2(w[0], w[1])
            local = in_frames(plan.links, turns, state, as_vec(plan.origin, state), seen)
            flat = [segment_residual(length_of(plan.links[link], state), s, local[link]) for _, link in segments]
            level = [_level_residual(semi_axes_of(body, state), body, s, local[body.link]) for body in bodies]
            return [entry for h in flat for entry in (h.x, h.y)] + level

        noise = samples.points[:, n + 1 :]
        values = jnp.stack(jax.vmap(residuals)(turns, states, along, noise))  # (residual, sample)
        center = (values * samples.weights[None, :]).sum(axis=1)
        gaps = values - center[:, None]
        weighted_gaps = gaps * samples.weights[None, :]
        cross = (weighted_gaps @ unit) @ root.T
        additive = jnp.zeros((), dtype) if rules.augmented else noise_cov.xx
        for j, (component, _) in enumerate(segments):
            x, y = 2 * j, 2 * j + 1
            spread = Sym2(
                (weighted_gaps[x] * gaps[x]).sum() + additive,
                (weighted_gaps[x] * gaps[y]).sum(),
                (weighted_gaps[y] * gaps[y]).sum() + additive,
            )
            inverse, h = spread.inverse(), Vec2(center[x], center[y])
            pull, distance = inverse @ h, inverse.quadratic(h)
            log_density = -0.5 * (distance + log(spread.det())) - jnp.log(jnp.asarray(2.0 * pi, dtype))
            shift = -(cross[x] * pull.x + cross[y] * pull.y)
            rows[component] = (log_density, distance, shift, cross[x], cross[y], *_entries(inverse), pull.x, pull.y)
        for j, body in enumerate(bodies, start=2 * len(segments)):
            variance = (weighted_gaps[j] * gaps[j]).sum()
            pull = center[j] / variance
            distance = center[j] * pull
            area = jnp.asarray(4.0 if body.is_rectangle else pi, dtype)  # inside a level, per unit of it
            log_density = -0.5 * (distance + log(2.0 * pi * variance)) - jnp.log(area)
            shift = -cross[j] * pull
            rows[body.component] = (
                log_density,
                distance,
                shift,
                cross[j],
                none,
                1.0 / variance,
                zero,
                zero,
                pull,
                zero,
            )
    columns = [jnp.stack(column) for column in zip(*(rows[k] for k in wanted), strict=True)]
    log_density, distance, shift, first, second, xx, xy, yy, pull_x, pull_y = columns
    return Evidence(log_density, distance, shift, (first, second), Sym2(xx, xy, yy), (pull_x, pull_y))


def _entries(s: Sym2) -> tuple[Scalar, Scalar, Scalar]:
    return s.xx, s.xy, s.yy


def _disc(radius: float, at: tuple[float, float], dtype, point: Vec2, noise_cov: Sym2, rules: Rules):
    """Log density per area, and squared distance, of a point under a disc."""
    noise_variance = 0.5 * noise_cov.trace()
    center = Vec2(jnp.asarray(at[0], dtype), jnp.asarray(at[1], dtype))
    h, variance = disc_residual_moments(jnp.asarray(radius, dtype), center, noise_variance, point, rules.cross_term)
    log_density = -0.5 * (h * h / variance + log(2.0 * pi * variance))
    return log_density + jnp.log(jnp.asarray(rules.disc_density_factor, dtype)), h * h / variance


def _level_residual(semi_axes: Vec2, body: Body, s, local: Vec2) -> Scalar:
    """h = a b (g² - s²) of a random hypersurface: g is 1 on the outline and grows linearly along every ray (m²).

    Surfaces have s² uniform on (0, 1), outlines s = 1. With the factor a b of the semi-axes a circle has the residual
    of a disc, and h a constant density per area. Source: Baum and Hanebeck 2009.
    """
    a, b = semi_axes.x, semi_axes.y
    x2, y2 = b / a * local.x * local.x, a / b * local.y * local.y
    level = jnp.maximum(x2, y2) if body.is_rectangle else x2 + y2
    return level - a * b * (s if body.is_filled else 1.0)


def updated(
    mean: Float[Array, "n"], cov: Float[Array, "n n"], found: Evidence, weights: Float[Array, "c"]
) -> tuple[Float[Array, "n"], Float[Array, "n n"]]:
    """Mean and covariance of the mixture of all updates with these weights; the rest, up to 1, leaves the belief.

    With X, C, h the cross covariance, covariance and mean of a component's pseudo-measurement and d = -X C⁻¹ h, its
    update is (x + d, P - X C⁻¹ Xᵀ). The mixture therefore has mean x + d̄ and covariance
    P + Σ w X (C⁻¹ h hᵀ C⁻¹ - C⁻¹) Xᵀ - d̄ d̄ᵀ: no component's covariance is ever formed.
    """
    moved = (weights[:, None] * found.shift).sum(axis=0)
    (first, second), (px, py), inverse = found.cross, found.pull, found.inverse
    xx = weights * (px * px - inverse.xx)
    xy = weights * (px * py - inverse.xy)
    yy = weights * (py * py - inverse.yy)
    left = xx[:, None] * first + xy[:, None] * second
    right = xy[:, None] * first + yy[:, None] * second
    new = cov - moved[:, None] * moved[None, :]
    for k in range(len(weights)):
        new = new + left[k][:, None] * first[k][None, :] + right[k][:, None] * second[k][None, :]
    return mean + moved, new


def weighted(found: Evidence, log_prior: Float[Array, "c"]) -> Float[Array, "c"]:
    """Posterior probabilities of the components: the random switch of the paper."""
    return jax.nn.softmax(found.log_density + log_prior)


def direct(found: Evidence, log_prior: Float[Array, "c"]) -> Float[Array, "c"]:
    """All weight on the most probable component."""
    return only(found, jnp.argmax(found.log_density + log_prior))


def only(found: Evidence, component: Array) -> Float[Array, "c"]:
    """All weight on one component: the nearest one, or the one that is known; none on a negative number."""
    return (jnp.arange(found.log_density.shape[0]) == component).astype(found.log_density.dtype)

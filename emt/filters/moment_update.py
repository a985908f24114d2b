"""Measurement update of image moments by one point: the collapsed unscented transform and its augmented original.

Arrays may have further axes behind those shown; everything is computed along them (see `emt.lanes`).

A point z on the object satisfies 0 = q(z, p) - s² - f: q is the squared scale of the ellipse through z, s² is uniform
on (0, 1) for points uniform on the ellipse, and f is what the sensor noise adds to q, as a Gaussian with the moments it
has at the current mean.

Source: Yao, Saltus and Dani 2020, eqs. 21, 40-44 and Algorithm 1.
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax.numpy as jnp
from jax.tree_util import register_dataclass
from jaxtyping import Array, Bool, Float

from emt.filters.unscented import Gaussian, Spread, product, scalar_update, square_root
from emt.lanes import PerRun, total
from emt.linalg import Sym2, Vec2, once
from emt.shapes.moments import project
from emt.types import Traced

X, Y = 3, 5
"""Rows of the position; rows 0 to 2 are n11, n20, n02, rows 4 and 6 the velocity."""
SCALE_MEAN, SCALE_VARIANCE = 0.5, 1.0 / 12.0
"""Moments of s² for points uniform on a filled ellipse."""


@register_dataclass
@dataclass(frozen=True)
class Projection:
    """Bounds that keep the moments positive definite (see `shapes.moments.project`)."""

    floor: Traced
    ratio: Traced


class Expected(NamedTuple):
    """The pseudo-measurement of one point as the belief expects it."""

    mean: PerRun
    variance: PerRun
    cross: Float[Array, "m *lanes"]
    """u: the cross-covariance with the state is root[:, :m] @ u."""


def moments_in(state, projection: Projection | None) -> Sym2:
    """Moments of one state (n,) or of many (n, m), projected where asked for."""
    moments = Sym2(state[1], state[0], state[2])
    return moments if projection is None else project(moments, projection.floor, projection.ratio)


def squared_scale(state, point: Vec2, projection: Projection | None):
    """q(z, p) = ¼ dᵀ N⁻¹ d: 1 on the ellipse, 0 at its centre; for one state (n,) or many (n, m)."""
    moments = moments_in(state, projection)
    dx, dy = _behind(point.x, state[X]) - state[X], _behind(point.y, state[Y]) - state[Y]
    return 0.25 * moments.inverse().quadratic(Vec2(dx, dy))


def _behind(number, like):
    """A number of each run, for states that come several to a run."""
    return number if jnp.ndim(number) == jnp.ndim(like) else number[None]


def noise_moments(mean: Float[Array, "n *lanes"], point: Vec2, noise: Sym2, projection: Projection | None):
    """Mean and variance of f at a mean state.

    With M = N⁻¹/4 and f = 2 dᵀ M v + vᵀ M v up to sign: E f = tr(M R), Var f = 2 tr(M R M R) + 4 dᵀ M R M d. It is the
    paper's expression for a diagonal R and holds for any.
    """
    weight = 0.25 * moments_in(mean, projection).inverse()
    pulled = weight.full() @ noise  # M R
    square = pulled @ pulled
    offset = Vec2(point.x - mean[X], point.y - mean[Y])
    return weight.inner(noise), 2.0 * (square.xx + square.yy) + 4.0 * noise.quadratic(weight @ offset)


def expected(belief: Gaussian, point: Vec2, noise: Sym2, spread: Spread, projection: Projection | None) -> Expected:
    """The pseudo-measurement under a belief.

    s² and f are additive, so the transform over (p, s², f), of dimension n + 2, is exactly one over p with its step.
    The root is a lower triangular one, or what updates make of it: its columns after that of y move velocity and turn
    rate only, and the measurement not at all.
    """
    c = spread.squared_step(belief.mean.shape[0] + 2)
    step = jnp.sqrt(c) * belief.root[:, : Y + 1]
    center = squared_scale(belief.mean, point, projection)
    plus = squared_scale(belief.mean[:, None] + step, point, projection) - center[None]
    minus = squared_scale(belief.mean[:, None] - step, point, projection) - center[None]
    plus, minus = once((plus, minus), spread.gamma)
    bend = total(plus + minus) / (2.0 * c)
    cross = (plus - minus) / (2.0 * jnp.sqrt(c))
    noise_mean, noise_variance = noise_moments(belief.mean, point, noise, projection)
    variance = total(plus * plus + minus * minus) / (2.0 * c) + bend * bend * (spread.beta - spread.gamma**2)
    # only beta < gamma² can take it below the part that is explained
    variance = jnp.maximum(variance, total(cross * cross)) + noise_variance + SCALE_VARIANCE
    return Expected(center + bend - noise_mean - SCALE_MEAN, variance, cross)


def point_update(belief: Gaussian, point: Vec2, noise: Sym2, spread: Spread, projection: Projection | None) -> Gaussian:
    """Update by one point in closed form; the new mean is not projected."""
    now = expected(belief, point, noise, spread, projection)
    return scalar_update(belief, now.cross, -now.mean, now.variance, spread.gamma)


def augmented_update(
    belief: Gaussian, point: Vec2, noise: Sym2, spread: Spread, projection: Projection | None
) -> Gaussian:
    """The same as printed: sigma points of (p, s², f), weighted moments, then a Cholesky factor."""
    n = belief.mean.shape[0]
    noise_mean, noise_variance = noise_moments(belief.mean, point, noise, projection)
    mean = jnp.concatenate([belief.mean, jnp.stack([jnp.asarray(SCALE_MEAN, noise_mean.dtype), noise_mean])])
    root = jnp.zeros((n + 2, n + 2), mean.dtype).at[:n, :n].set(belief.root)
    root = root.at[n, n].set(SCALE_VARIANCE**0.5).at[n + 1, n + 1].set(jnp.sqrt(noise_variance))
    c = spread.squared_step(n + 2)
    step = jnp.sqrt(c) * root
    sigma = jnp.concatenate([mean[:, None], mean[:, None] + step, mean[:, None] - step], axis=1)
    side = jnp.full(2 * (n + 2), 1.0, mean.dtype) / (2.0 * c)
    first = 1.0 - (n + 2) / c
    mean_weights = jnp.concatenate([first[None], side])
    cov_weights = mean_weights.at[0].add(1.0 - spread.gamma**2 + spread.beta)
    values = squared_scale(sigma, point, projection) - sigma[n] - sigma[n + 1]
    predicted = (mean_weights * values).sum()
    gaps = values - predicted
    variance = (cov_weights * gaps * gaps).sum()
    gain = ((cov_weights * gaps)[None, :] * (sigma[:n] - belief.mean[:, None])).sum(axis=1) / variance
    cov = product(belief.root) - variance * gain[:, None] * gain[None, :]
    return Gaussian(belief.mean - gain * predicted, square_root(cov, jitter=0.0))


def projected(belief: Gaussian, projection: Projection | None) -> tuple[Gaussian, Bool[Array, "*lanes"]]:
    """The belief with its mean moments projected, and whether that changed them."""
    moments = moments_in(belief.mean, projection)
    new = jnp.stack([moments.xy, moments.xx, moments.yy])
    return belief._replace(mean=belief.mean.at[:3].set(new)), (new != belief.mean[:3]).any(axis=0)

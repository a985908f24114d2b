"""Gaussian beliefs held by a square root, and unscented transforms that keep it."""

from dataclasses import dataclass
from typing import NamedTuple

import jax.numpy as jnp
from jax.tree_util import register_dataclass
from jaxtyping import Array, Float

from emt.linalg import cholesky
from emt.types import Scalar, Traced


@register_dataclass
@dataclass(frozen=True)
class Spread:
    """Constants of the scaled unscented transform (gamma is often written alpha)."""

    gamma: Traced
    kappa: Traced
    beta: Traced

    def squared_step(self, dimension: int) -> Scalar:
        """c: sigma points lie √c standard deviations from the mean, in the space of this dimension, noise included."""
        return self.gamma**2 * (dimension + self.kappa)


class Gaussian(NamedTuple):
    """A Gaussian by its mean and any square root of its covariance."""

    mean: Float[Array, "n"]
    root: Float[Array, "n n"]

    def cov(self) -> Float[Array, "n n"]:
        """Covariance root rootᵀ."""
        return product(self.root)


def product(root: Float[Array, "n m"]) -> Float[Array, "n n"]:
    """root rootᵀ as a sum of products, which batches better than many small matrix multiplications."""
    return (root[:, None, :] * root[None, :, :]).sum(axis=-1)


def square_root(cov: Float[Array, "n n"], jitter: float | None = None) -> Float[Array, "n n"]:
    """Lower Cholesky factor of a covariance that may be singular.

    The factor is of the correlations, by default with a jitter of 1e-10 (float64) or 1e-5 (float32), so units do not
    matter.
    """
    scale = jnp.sqrt(jnp.diagonal(cov))
    sound = scale > 0.0
    scale = jnp.where(sound, scale, 1.0)
    if jitter is None:
        jitter = 1e-10 if cov.dtype == jnp.float64 else 1e-5
    # a component that is known exactly keeps a row of zeros
    correlation = cov / (scale[:, None] * scale[None, :]) + jnp.diag(jnp.where(sound, jitter, 1.0))
    return jnp.where(sound, scale, 0.0)[:, None] * cholesky(correlation)


def scalar_update(belief: Gaussian, cross: Float[Array, "n"], residual: Scalar, variance: Scalar) -> Gaussian:
    """Update by a scalar whose cross-covariance with the state is root @ cross, without a factorisation.

    p ← p + L u r / S and L ← L - a (L u) uᵀ with a = (1 - √(1 - |u|²/S)) / |u|², which is
    1 / (S (1 + √(1 - |u|²/S))) and regular at u = 0; L Lᵀ is then P - (L u)(L u)ᵀ / S exactly.

    Source: J. E. Potter's square-root update for a scalar measurement, with any square root of P.
    """
    gain = (belief.root * cross[None, :]).sum(axis=1)
    rest = jnp.sqrt(jnp.maximum(1.0 - (cross * cross).sum() / variance, 0.0))
    shrink = 1.0 / (variance * (1.0 + rest))
    return Gaussian(belief.mean + gain * (residual / variance), belief.root - shrink * gain[:, None] * cross[None, :])


def merge_gaussians(
    weights: Float[Array, "n_modes"], means: Float[Array, "n_modes n"], covs: Float[Array, "n_modes n n"]
) -> tuple[Float[Array, "n"], Float[Array, "n n"]]:
    """Mean and covariance of a Gaussian mixture."""
    mean = (weights[:, None] * means).sum(axis=0)
    gaps = means - mean[None, :]
    outer = gaps[:, :, None] * gaps[:, None, :]
    return mean, (weights[:, None, None] * (covs + outer)).sum(axis=0)

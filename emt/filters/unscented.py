"""Gaussian beliefs held by a square root, and unscented transforms that keep it.

Arrays may have further axes behind those shown; everything is computed along them (see `emt.lanes`).
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax.numpy as jnp
from jax.tree_util import register_dataclass
from jaxtyping import Array, Float

from emt.lanes import PerRun, total
from emt.linalg import cholesky, once
from emt.types import Traced


@register_dataclass
@dataclass(frozen=True)
class Spread:
    """Constants of the scaled unscented transform (gamma is often written alpha)."""

    gamma: Traced
    kappa: Traced
    beta: Traced

    def squared_step(self, dimension: int) -> PerRun:
        """c: sigma points lie √c standard deviations from the mean, in the space of this dimension, noise included."""
        return self.gamma**2 * (dimension + self.kappa)


class Gaussian(NamedTuple):
    """A Gaussian by its mean and any square root of its covariance."""

    mean: Float[Array, "n *lanes"]
    root: Float[Array, "n n *lanes"]

    def cov(self) -> Float[Array, "n n *lanes"]:
        """Covariance root rootᵀ."""
        return product(self.root)


def product(root: Float[Array, "n m *lanes"]) -> Float[Array, "n n *lanes"]:
    """root rootᵀ as a sum of products, which batches better than many small matrix multiplications."""
    columns = jnp.moveaxis(root, 1, 0)
    return total(columns[:, :, None] * columns[:, None, :])


def square_root(cov: Float[Array, "n n *lanes"], jitter: float | None = None) -> Float[Array, "n n *lanes"]:
    """Lower Cholesky factor of a covariance that may be singular.

    The factor is of the correlations, by default with a jitter of 1e-10 (float64) or 1e-5 (float32), so units do not
    matter.
    """
    scale = jnp.sqrt(jnp.stack([cov[i, i] for i in range(cov.shape[0])]))
    sound = scale > 0.0
    scale = jnp.where(sound, scale, 1.0)
    if jitter is None:
        jitter = 1e-10 if cov.dtype == jnp.float64 else 1e-5
    # a component that is known exactly keeps a row of zeros
    identity = jnp.eye(cov.shape[0], dtype=cov.dtype).reshape(*cov.shape[:2], *(1,) * (cov.ndim - 2))
    correlation = cov / (scale[:, None] * scale[None, :]) + identity * jnp.where(sound, jitter, 1.0)[:, None]
    return jnp.where(sound, scale, 0.0)[:, None] * cholesky(correlation)


def scalar_update(
    belief: Gaussian, cross: Float[Array, "m *lanes"], residual: PerRun, variance: PerRun, known: Traced
) -> Gaussian:
    """Update by a scalar whose cross-covariance with the state is root[:, :m] @ cross, without a factorisation.

    p ← p + L u r / S and L ← L - a (L u) uᵀ with a = (1 - √(1 - |u|²/S)) / |u|², which is
    1 / (S (1 + √(1 - |u|²/S))) and regular at u = 0; L Lᵀ is then P - (L u)(L u)ᵀ / S exactly.

    Args:
        known: see `linalg.once`.

    Source: J. E. Potter's square-root update for a scalar measurement, with any square root of P.
    """
    cross, residual, variance = once((cross, residual, variance), known)
    m = cross.shape[0]
    columns = belief.root[:, :m]
    gain = total(jnp.moveaxis(columns, 1, 0) * cross[:, None])
    rest = jnp.sqrt(jnp.maximum(1.0 - total(cross * cross) / variance, 0.0))
    gain, shrink = once((gain, 1.0 / (variance * (1.0 + rest))), known)
    moved = columns - (shrink[None] * gain)[:, None] * cross[None, :]
    return Gaussian(belief.mean + gain * (residual / variance)[None], belief.root.at[:, :m].set(moved))


def merge_gaussians(
    weights: Float[Array, "n_modes *lanes"],
    means: Float[Array, "n_modes n *lanes"],
    covs: Float[Array, "n_modes n n *lanes"],
) -> tuple[Float[Array, "n *lanes"], Float[Array, "n n *lanes"]]:
    """Mean and covariance of a Gaussian mixture."""
    mean = total(weights[:, None] * means)
    gaps = means - mean[None]
    outer = gaps[:, :, None] * gaps[:, None, :]
    return mean, total(weights[:, None, None] * (covs + outer))

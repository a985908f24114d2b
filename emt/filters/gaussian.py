"""Gaussian beliefs about the state of a point: prediction, conditioning on a measurement, mixing."""

import math
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from emt.lanes import lanes_last, total
from emt.linalg import cholesky, forward_solve, once
from emt.logarithm import log
from emt.models.state_space.measurements import Measurement
from emt.models.state_space.motions import Motion
from emt.types import Scalar

GROSS_NIS = 100.0
"""A normalised innovation squared above this sets `Status.GROSS_INNOVATION`: ten standard deviations."""


class Belief(NamedTuple):
    """Mean and covariance of a state."""

    mean: Float[Array, "n"]
    cov: Float[Array, "n n"]


class Innovation(NamedTuple):
    """What a measurement says of a prediction."""

    log_likelihood: Scalar
    nis: Scalar
    """Normalised innovation squared."""


class Prediction(NamedTuple):
    """A predicted belief and, of a sigma-point filter, the points that stand for it."""

    belief: Belief
    points: Float[Array, "n_points n"] | None = None


class Kernel(NamedTuple):
    """How a Gaussian belief is predicted and conditioned, whatever the approximation."""

    start: Callable[[Belief], Prediction]
    """A prior as the prediction for a first scan."""
    predict: Callable[[Belief, Scalar, Scalar], Prediction]
    """(belief, time, seconds since the last step) -> prediction for that time."""
    update: Callable[[Prediction, Float[Array, "m"], Scalar], tuple[Belief, Innovation]]
    """(prediction, measurement, its time) -> belief and innovation."""


def predicted(belief: Belief, motion: Motion, noise_cov: Float[Array, "n n"], time: Scalar, dt: Scalar) -> Belief:
    """Kalman prediction to `time`, `dt` seconds later: exact for a linear motion, else linearised at the mean.

    Source: Azimian 2005, eq. 2.3.
    """
    mean, jacobian = motion.linearised(belief.mean, time, dt)
    return Belief(mean, propagated(belief.cov, jacobian, noise_cov, dt))


@lanes_last
def propagated(cov, jacobian, noise_cov, known):
    """F P Fᵀ + Q; the product is symmetric but for rounding, so it is made so. For `known` see `linalg.once`."""
    half = once(product(jacobian, cov), known)
    full = once(product(half, jacobian.swapaxes(0, 1)), known)
    return once(symmetric(full) + noise_cov, known)


def product(left, right):
    """Product of two small matrices, whatever axes are behind theirs."""
    return total(left.swapaxes(0, 1)[:, :, None] * right[:, None])


def symmetric(matrix):
    """(M + Mᵀ) / 2, whatever axes are behind its own."""
    return 0.5 * (matrix + matrix.swapaxes(0, 1))


def updated(
    belief: Belief, measurement: Measurement, noise_cov: Float[Array, "m m"], value: Float[Array, "m"], time: Scalar
) -> tuple[Belief, Innovation]:
    """Kalman update with a measurement: exact for a linear one, else linearised at the predicted mean.

    Source: Azimian 2005, eq. 2.3.
    """
    expected, jacobian = measurement.linearised(belief.mean, time)
    return linearly_updated(belief, jacobian, noise_cov, measurement.difference(value, expected), time)


@lanes_last
def linearly_updated(belief: Belief, jacobian, noise_cov, innovation, known) -> tuple[Belief, Innovation]:
    """`conditioned` with C = P Hᵀ and S = H C + R, each computed once; for `known` see `linalg.once`."""
    belief, innovation = once((belief, innovation), known)
    cross = once(product(belief.cov, jacobian.swapaxes(0, 1)), known)
    innovation_cov = once(product(jacobian, cross) + noise_cov, known)
    return once(conditioned(belief, cross, innovation_cov, innovation), known)


@lanes_last
def conditioned(
    belief: Belief,
    cross: Float[Array, "n m *lanes"],
    innovation_cov: Float[Array, "m m *lanes"],
    innovation: Float[Array, "m *lanes"],
) -> tuple[Belief, Innovation]:
    """The belief given an innovation ν of covariance S = L Lᵀ whose cross-covariance with the state is C.

    With W = L⁻¹ Cᵀ: mean + Wᵀ L⁻¹ ν and P - Wᵀ W, which is P - K S Kᵀ and symmetric to the last bit if P is. It
    keeps digits while P / R stays below about 1e13. A square-root update by QR, as JAX libraries have it, has no such
    bound and takes ten times as long in batches of four states.
    """
    m, root = innovation.shape[0], cholesky(innovation_cov)
    gain, white = forward_solve(root, cross.swapaxes(0, 1)), forward_solve(root, innovation)
    nis = total(white * white)
    log_volume = sum(log(root[i, i]) for i in range(m))
    log_likelihood = -0.5 * (nis + m * math.log(2.0 * math.pi)) - log_volume
    mean, taken = belief.mean + total(gain * white[:, None]), total(gain[:, :, None] * gain[:, None, :])
    return Belief(mean, belief.cov - taken), Innovation(log_likelihood, nis)


@partial(lanes_last, common=1)
def mixed(
    transition: Float[Array, "n_from n_to ..."],
    probability: Float[Array, "n_from *lanes"],
    beliefs: Belief,
    known: Float[Array, "..."],
) -> tuple[Float[Array, "n_to *lanes"], Belief]:
    """The chain's prediction of each mode: its probability, and mean and covariance of the mixture that its filter
    starts from. Beliefs have a leading axis of modes; covariances are symmetric to the last bit.

    Sums over modes of p, p d and p (P + d dᵀ) are products with the matrix of the chain, of all runs at once where they
    share it. Gaps d are taken from the average of all means: what is lost is relative to the spread of the means, not
    to the distance from the origin. A mode that cannot be in effect, or so improbable (4.6e-277; 8.3e-25 in single
    precision) that products with its probability lose digits, keeps its own state.

    Source: Blom and Bar-Shalom 1988; Azimian 2005, table 4.1, whose denominator should be the predicted probability.

    Args:
        known: see `linalg.once`.
    """
    probability, beliefs = once((probability, beliefs), known)
    n_modes = len(probability)
    center = total(beliefs.mean)[None] / n_modes
    gaps = once(beliefs.mean - center, known)

    def carried(values):
        """Sums over the modes before of transition times p times values (mode, *axes, *lanes)."""
        axes = (1,) * (values.ndim - probability.ndim)
        weighted = once(probability.reshape(n_modes, *axes, *probability.shape[1:]) * values, known)
        if transition.ndim > 2:  # each run has its own chain
            return total(transition.reshape(n_modes, n_modes, *axes, *transition.shape[2:]) * weighted[:, None])
        return (transition.T @ weighted.reshape(n_modes, -1)).reshape(values.shape)

    predicted = carried(jnp.ones_like(probability))
    limits = jnp.finfo(predicted.dtype)
    # with smaller ones, what counts of the sums would be subnormal
    possible = predicted > float(limits.tiny) / float(limits.eps) ** 2
    share = 1.0 / jnp.where(possible, predicted, 1.0)
    shift = share[:, None] * carried(gaps)
    second = carried(beliefs.cov + gaps[:, :, None] * gaps[:, None])
    second = (0.5 * share)[:, None, None] * (second + second.swapaxes(1, 2))
    mean = jnp.where(possible[:, None], center + shift, beliefs.mean)
    cov = jnp.where(possible[:, None, None], second - shift[:, :, None] * shift[:, None], beliefs.cov)
    return predicted, Belief(mean, cov)


def fused(weights: Float[Array, "n_modes"], beliefs: Belief) -> Belief:
    """Moments of the mixture of Gaussians (leading axis) with weights of sum 1, about the average of all means."""
    n = beliefs.mean.shape[1]
    center = beliefs.mean.mean(axis=0)
    gaps = beliefs.mean - center[None, :]
    second = beliefs.cov + gaps[:, :, None] * gaps[:, None, :]
    moments = weights @ jnp.concatenate([gaps, second.reshape(-1, n * n)], axis=1)
    shift, cov = moments[:n], moments[n:].reshape(n, n) - moments[:n, None] * moments[None, :n]
    return Belief(center + shift, symmetric(cov))

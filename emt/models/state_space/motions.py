"""How the state of a point moves: named models, matrices, or a function of the user's."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import register_dataclass
from jaxtyping import Array, Float, PRNGKeyArray

from emt.draws import normals
from emt.lanes import total
from emt.linalg import Vec2, cholesky, forward_solve, once, semidefinite_root
from emt.models.motion import MotionNoise
from emt.models.turn import coordinated_turn
from emt.types import Scalar, Traced

State = Float[Array, "n"]
Cov = Float[Array, "n n"]


class Motion:
    """x ← f(x) + v, with noise v of mean zero for the filters that take it as Gaussian."""

    is_linear: ClassVar[bool] = False

    def move(self, state: State, time: Scalar, dt: Scalar) -> State:
        """f: the state `dt` seconds later, at `time`, without noise."""
        raise TypeError(f"{type(self).__name__} does not say how it moves")

    def noise_cov(self, dt: Scalar) -> Cov:
        """Covariance of the noise over `dt` seconds."""
        raise TypeError(f"{type(self).__name__} does not say its noise")

    def draws(self, key: PRNGKeyArray, count: int, dt: Scalar) -> Float[Array, "n count"]:
        """Independent draws of the noise, one per column."""
        root = semidefinite_root(self.noise_cov(dt))
        draws = normals(key, (root.shape[0], count), root.dtype)
        draws = once(draws, dt) if count > 1 else draws  # a single draw is cheaper computed anew
        return total(root.T[:, :, None] * draws[:, None])

    def log_density(self, noise: State, dt: Scalar) -> Scalar:
        """Log density of the noise; its covariance must have full rank."""
        return gaussian_log_density(noise, self.noise_cov(dt))

    def linearised(self, state: State, time: Scalar, dt: Scalar) -> tuple[State, Cov]:
        """The moved state and the Jacobian of f there; the same matrix everywhere if f is linear."""
        moved = self.move(state, time, dt)
        at = jnp.zeros_like(state) if self.is_linear else state
        return moved, jax.jacfwd(lambda x: self.move(x, time, dt))(at)


def gaussian_log_density(gap: State, cov: Cov) -> Scalar:
    """Log density of a zero-mean Gaussian."""
    root = cholesky(cov)
    white = forward_solve(root, gap)
    return -0.5 * total(white * white) - jnp.log(jnp.diagonal(root)).sum() - 0.5 * len(gap) * math.log(2.0 * math.pi)


@register_dataclass
@dataclass(frozen=True)
class ConstantVelocity(Motion):
    """(x, y, vx, vy) with a known acceleration held over the step: G(a + w), or white acceleration."""

    acceleration: Float[Array, "2"]
    """Known acceleration (m/s²)."""
    noise: MotionNoise | None
    is_linear: ClassVar[bool] = True

    def move(self, state: State, time: Scalar, dt: Scalar) -> State:
        position, velocity, push = state[:2], state[2:], dt * self.acceleration
        return jnp.concatenate([position + dt * (velocity + 0.5 * push), velocity + push])

    def noise_cov(self, dt: Scalar) -> Cov:
        return noise_array(self.noise, dt)


def noise_array(noise: MotionNoise | None, dt: Scalar) -> Cov:
    """Covariance of (x, y, vx, vy) over a step; zeros where there is no noise."""
    return jnp.zeros((4, 4), jnp.asarray(dt).dtype) if noise is None else noise(dt).array()


@register_dataclass
@dataclass(frozen=True)
class ConstantTurn(Motion):
    """(x, y, vx, vy) on a circle at a known turn rate."""

    rate: Traced
    """Anticlockwise (rad/s)."""
    noise: MotionNoise | None
    is_linear: ClassVar[bool] = True

    def move(self, state: State, time: Scalar, dt: Scalar) -> State:
        position, velocity = coordinated_turn(Vec2.of(state[:2]), Vec2.of(state[2:]), self.rate, dt)
        return jnp.stack([position.x, position.y, velocity.x, velocity.y])

    def noise_cov(self, dt: Scalar) -> Cov:
        return noise_array(self.noise, dt)


@register_dataclass
@dataclass(frozen=True)
class SpeedChange(Motion):
    """(x, y, vx, vy) with a known acceleration along the velocity."""

    acceleration: Traced
    """Positive forwards (m/s²)."""
    noise: MotionNoise | None

    def move(self, state: State, time: Scalar, dt: Scalar) -> State:
        position, velocity = state[:2], state[2:]
        speed = jnp.sqrt((velocity * velocity).sum())
        push = (dt * self.acceleration / jnp.where(speed > 0.0, speed, 1.0)) * velocity
        return jnp.concatenate([position + dt * (velocity + 0.5 * push), velocity + push])

    def noise_cov(self, dt: Scalar) -> Cov:
        return noise_array(self.noise, dt)


@register_dataclass
@dataclass(frozen=True)
class LinearMotion(Motion):
    """x ← F x + b per step, whatever its length."""

    transition: Cov
    offset: State
    cov: Cov
    is_linear: ClassVar[bool] = True

    def move(self, state: State, time: Scalar, dt: Scalar) -> State:
        return self.transition @ state + self.offset

    def noise_cov(self, dt: Scalar) -> Cov:
        return self.cov


@register_dataclass
@dataclass(frozen=True)
class Growth(Motion):
    """x ← 1 + sin(ω t) + x/2 + v with gamma noise v, of which Gaussian filters know the variance but not the mean.

    Source: van der Merwe, Doucet, de Freitas and Wan 2000, section 6.1.
    """

    frequency: Traced
    """ω (rad per unit of time)."""
    rate: Traced
    shape: int = field(metadata={"static": True})
    """Of the gamma density, a whole number."""

    def move(self, state: State, time: Scalar, dt: Scalar) -> State:
        return 1.0 + jnp.sin(self.frequency * time) + 0.5 * state

    def noise_cov(self, dt: Scalar) -> Cov:
        return jnp.asarray(self.shape / (self.rate * self.rate)).reshape(1, 1)

    def draws(self, key: PRNGKeyArray, count: int, dt: Scalar) -> Float[Array, "n count"]:
        # a gamma of whole shape is a sum of exponentials
        parts = jax.random.exponential(key, (count, self.shape), jnp.asarray(self.rate).dtype)
        return parts.sum(axis=1)[None] / self.rate

    def log_density(self, noise: State, dt: Scalar) -> Scalar:
        v = jnp.where(noise[0] > 0.0, noise[0], 1.0)
        density = (self.shape - 1) * jnp.log(v) - self.rate * v + self.shape * jnp.log(self.rate)
        return jnp.where(noise[0] > 0.0, density - math.lgamma(self.shape), -jnp.inf)


@register_dataclass
@dataclass(frozen=True)
class FunctionMotion(Motion):
    """f is a function (state, time, dt) -> state of the user's; the noise has the same covariance at every step."""

    cov: Cov
    function: Callable[..., Any] = field(metadata={"static": True})

    def move(self, state: State, time: Scalar, dt: Scalar) -> State:
        return self.function(state, time, dt)

    def noise_cov(self, dt: Scalar) -> Cov:
        return self.cov


class Alike(NamedTuple):
    """Motions that differ in numbers only, as one motion with a leading axis."""

    places: tuple[int, ...]
    """Of its parts among all motions."""
    motion: Motion

    def own(self, everything: Any) -> Any:
        """Its parts of what has a leading axis over all motions."""
        if self.places == tuple(range(len(jax.tree.leaves(everything)[0]))):
            return everything
        return jax.tree.map(lambda leaf: leaf[jnp.asarray(self.places)], everything)


def grouped(motions: Sequence[Motion]) -> list[Alike]:
    """Motions in groups that can be computed together, each once instead of once per motion."""
    kinds: dict[Any, list[int]] = {}
    for k, motion in enumerate(motions):
        kinds.setdefault(jax.tree.structure(motion), []).append(k)
    return [
        Alike(tuple(places), jax.tree.map(lambda *leaves: jnp.stack(leaves), *(motions[k] for k in places)))
        for places in kinds.values()
    ]


def in_order(groups: Sequence[Alike], parts: Sequence[Any]) -> Any:
    """What was computed for each group, as one with a leading axis in the order of the motions."""
    places = [place for group in groups for place in group.places]
    order = jnp.asarray(np.argsort(places))

    def joined(*leaves):
        whole = jnp.concatenate(leaves)
        return whole if places == sorted(places) else whole[order]

    return jax.tree.map(joined, *parts)

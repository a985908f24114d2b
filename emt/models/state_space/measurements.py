"""What a sensor measures of the state of a point: named models, a matrix, or a function of the user's."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from jax.tree_util import register_dataclass
from jaxtyping import Array, Float, PRNGKeyArray

from emt.linalg import semidefinite_root
from emt.trigonometry import arctan2
from emt.types import Scalar, Traced

State = Float[Array, "n"]
Value = Float[Array, "m"]


class Measurement:
    """z = h(x) + w with Gaussian noise w."""

    is_linear: ClassVar[bool] = False

    @property
    def angles(self) -> tuple[bool, ...]:
        """Which numbers are angles (rad), whose differences are wrapped; empty if none is."""
        return ()

    def observe(self, state: State, time: Scalar) -> Value:
        """h: what would be measured at `time` without noise."""
        raise TypeError(f"{type(self).__name__} does not say what it measures")

    def noise_cov(self) -> Float[Array, "m m"]:
        """Covariance of the noise."""
        raise TypeError(f"{type(self).__name__} does not say its noise")

    def difference(self, a: Value, b: Value) -> Value:
        """a - b, angles wrapped to [-π, π)."""
        gap = a - b
        if not any(self.angles):
            return gap
        turns = jnp.floor(gap / (2.0 * jnp.pi) + 0.5)
        return gap - jnp.where(jnp.asarray(self.angles), 2.0 * jnp.pi * turns, 0.0)

    def draw(self, state: State, time: Scalar, key: PRNGKeyArray) -> Value:
        """A measurement with noise."""
        root = semidefinite_root(self.noise_cov())
        return self.observe(state, time) + root @ jax.random.normal(key, (root.shape[0],), root.dtype)

    def linearised(self, state: State, time: Scalar) -> tuple[Value, Float[Array, "m n"]]:
        """The expected measurement and the Jacobian of h; the same matrix everywhere if h is linear."""
        at = jnp.zeros_like(state) if self.is_linear else state
        return self.observe(state, time), jax.jacfwd(lambda x: self.observe(x, time))(at)

    def place(self, value: Value) -> Float[Array, "2"] | None:
        """Where in the plane a measurement says the point is, for pictures; None if it does not say."""
        return None


@register_dataclass
@dataclass(frozen=True)
class Position(Measurement):
    """The first two entries of the state."""

    cov: Float[Array, "2 2"]
    is_linear: ClassVar[bool] = True

    def observe(self, state: State, time: Scalar) -> Value:
        return state[:2]

    def noise_cov(self) -> Float[Array, "2 2"]:
        return self.cov

    def place(self, value: Value) -> Float[Array, "2"] | None:
        return value


@register_dataclass
@dataclass(frozen=True)
class RangeBearing(Measurement):
    """Distance (m) and direction (rad) from a sensor."""

    sensor: Float[Array, "2"]
    range_std: Traced
    bearing_std: Traced

    @property
    def angles(self) -> tuple[bool, ...]:
        return (False, True)

    def observe(self, state: State, time: Scalar) -> Value:
        dx, dy = state[0] - self.sensor[0], state[1] - self.sensor[1]
        return jnp.stack([jnp.sqrt(dx * dx + dy * dy), arctan2(dy, dx)])

    def noise_cov(self) -> Float[Array, "2 2"]:
        return jnp.diag(jnp.stack([self.range_std * self.range_std, self.bearing_std * self.bearing_std]))

    def place(self, value: Value) -> Float[Array, "2"] | None:
        return self.sensor + value[0] * jnp.stack([jnp.cos(value[1]), jnp.sin(value[1])])


@register_dataclass
@dataclass(frozen=True)
class LinearMeasurement(Measurement):
    """z = H x + w."""

    matrix: Float[Array, "m n"]
    cov: Float[Array, "m m"]
    is_linear: ClassVar[bool] = True

    def observe(self, state: State, time: Scalar) -> Value:
        return self.matrix @ state

    def noise_cov(self) -> Float[Array, "m m"]:
        return self.cov


@register_dataclass
@dataclass(frozen=True)
class GrowthMeasurement(Measurement):
    """x²/5 until a time, x/2 - 2 from then on.

    Source: van der Merwe, Doucet, de Freitas and Wan 2000, section 6.1.
    """

    variance: Traced
    change: Traced
    """Last time of the square."""

    def observe(self, state: State, time: Scalar) -> Value:
        return jnp.where(time <= self.change, 0.2 * state * state, 0.5 * state - 2.0)

    def noise_cov(self) -> Float[Array, "1 1"]:
        return jnp.asarray(self.variance).reshape(1, 1)


@register_dataclass
@dataclass(frozen=True)
class FunctionMeasurement(Measurement):
    """h is a function (state, time) -> numbers of the user's."""

    cov: Float[Array, "m m"]
    function: Callable[..., Any] = field(metadata={"static": True})
    which_are_angles: tuple[bool, ...] = field(metadata={"static": True})

    @property
    def angles(self) -> tuple[bool, ...]:
        return self.which_are_angles

    def observe(self, state: State, time: Scalar) -> Value:
        return self.function(state, time)

    def noise_cov(self) -> Float[Array, "m m"]:
        return self.cov

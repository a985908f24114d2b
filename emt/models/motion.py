"""Process noise of motion in the plane, with its settings."""

from dataclasses import dataclass
from typing import Annotated, Literal

import jax.numpy as jnp
import numpy as np
from jax.tree_util import register_dataclass
from jaxtyping import Array, Float
from numpy.typing import ArrayLike
from pydantic import Field

from emt.linalg import Mat2, Sym2
from emt.settings import AccelerationDensity, AccelerationVariance, KinematicNoise, Settings
from emt.types import Scalar, Traced


@register_dataclass
@dataclass(frozen=True)
class ProcessNoise:
    """Process noise of (position, velocity) over one step, factored as w_v = gain · w_p + rest.

    A sum of squares by construction, so a filter can propagate it without subtracting (see `filters.kinematics`).
    """

    position: Sym2
    """Covariance of the position noise (m²)."""
    gain: Mat2
    """Regression of the velocity noise on the position noise (1/s)."""
    velocity: Sym2
    """Covariance of the velocity noise given the position noise (m²/s²)."""

    def cross(self) -> Mat2:
        """Covariance of velocity noise (rows) and position noise (columns)."""
        return self.gain @ self.position

    def array(self) -> Float[Array, "4 4"]:
        """The full covariance of (x, y, vx, vy)."""
        cross = self.cross()
        velocity = self.gain.congruence(self.position) + self.velocity
        return jnp.block([[self.position.array(), cross.T.array()], [cross.array(), velocity.array()]])


@register_dataclass
@dataclass(frozen=True)
class WhiteAcceleration:
    """Noise of the nearly-constant-velocity model.

    Source: Bar-Shalom, Li and Kirubarajan 2001, eq. 6.2.2-12: psd [[T³/3, T²/2], [T²/2, T]] on each axis. Given the
    position noise, the velocity noise has regression 3/(2T) and variance psd T/4.
    """

    psd: Traced
    """Power spectral density of the acceleration on each axis (m²/s³); σ² of the paper."""

    def __call__(self, dt: Scalar) -> ProcessNoise:
        """Noise over a step of `dt` seconds."""
        zero = jnp.zeros_like(self.psd * dt)
        variance, slope, rest = self.psd * dt**3 / 3.0, 1.5 / dt + zero, self.psd * dt / 4.0
        return ProcessNoise(Sym2(variance, zero, variance), Mat2(slope, zero, zero, slope), Sym2(rest, zero, rest))


@register_dataclass
@dataclass(frozen=True)
class FixedNoise:
    """The same noise at every step, whatever its length."""

    noise: ProcessNoise

    @staticmethod
    def of(cov: ArrayLike) -> "FixedNoise":
        """From a positive semi-definite covariance of (x, y, vx, vy) in SI units."""
        full = np.asarray(cov, dtype=np.float64)
        pp, vp, vv = full[:2, :2], full[2:, :2], full[2:, 2:]
        gain = vp @ np.linalg.pinv(pp, hermitian=True)
        rest = vv - gain @ vp.T
        # a fully correlated noise leaves rounding here, of either sign
        rest[np.abs(rest) < 1e-14 * np.abs(vv).max()] = 0.0
        return FixedNoise(ProcessNoise(Sym2.of(pp), Mat2.of(gain), Sym2.of(rest)))

    def __call__(self, dt: Scalar) -> ProcessNoise:
        return self.noise


@register_dataclass
@dataclass(frozen=True)
class PiecewiseAcceleration:
    """Noise of an acceleration that is constant over each step: variance G Gᵀ with G = (T²/2, T) on each axis.

    Source: Bar-Shalom, Li and Kirubarajan 2001, eq. 6.3.2-4.
    """

    variance: Traced
    """Of the acceleration on each axis (m²/s⁴)."""

    def __call__(self, dt: Scalar) -> ProcessNoise:
        """Noise over a step of `dt` seconds; the velocity noise is 2/T times that of the position."""
        zero = jnp.zeros_like(self.variance * dt)
        variance, slope = self.variance * dt**4 / 4.0, 2.0 / dt + zero
        return ProcessNoise(Sym2(variance, zero, variance), Mat2(slope, zero, zero, slope), Sym2(zero, zero, zero))


MotionNoise = WhiteAcceleration | FixedNoise | PiecewiseAcceleration


class WhiteAccelerationSettings(Settings):
    """White acceleration."""

    kind: Literal["white_acceleration"] = "white_acceleration"
    psd: AccelerationDensity
    """Power spectral density of the acceleration on each axis."""

    def build(self) -> WhiteAcceleration:
        return WhiteAcceleration(self.psd)


class FixedNoiseSettings(Settings):
    """The same process noise at every step."""

    kind: Literal["fixed"] = "fixed"
    cov: KinematicNoise
    """Covariance added to (x, y, vx, vy) per step."""

    def build(self) -> FixedNoise:
        return FixedNoise.of(self.cov)


class PiecewiseAccelerationSettings(Settings):
    """An acceleration drawn anew for each step and constant over it."""

    kind: Literal["piecewise_acceleration"] = "piecewise_acceleration"
    variance: AccelerationVariance
    """Of the acceleration on each axis."""

    def build(self) -> PiecewiseAcceleration:
        return PiecewiseAcceleration(self.variance)


NoiseSettings = Annotated[
    WhiteAccelerationSettings | FixedNoiseSettings | PiecewiseAccelerationSettings, Field(discriminator="kind")
]

"""Gaussian belief over position and velocity in block-factored form, shared by the elliptical trackers.

The covariance of (p, v) is held as P_pp = C, P_vp = G C, P_vv = G C Gᵀ + S: the covariance of the position, the
regression G of velocity on position, and the covariance S of the velocity given the position. A measurement of the
position changes C alone; G and S stay as they are, and the velocity moves by G times the shift of the position. Both
steps only add positive terms, so the covariance is symmetric and positive definite at any step by construction.

Source: conditioning of a Gaussian (block LDLᵀ factorisation); the prediction is its Joseph form.
"""

from dataclasses import dataclass

import jax.numpy as jnp
from jax.tree_util import register_dataclass
from jaxtyping import Array, Float

from emt.linalg import Mat2, Sym2, Vec2
from emt.models.motion import ProcessNoise
from emt.types import Scalar


@register_dataclass
@dataclass(frozen=True)
class Kinematics:
    """Gaussian over position and velocity."""

    position: Vec2
    """Mean position (m)."""
    velocity: Vec2
    """Mean velocity (m/s)."""
    position_cov: Sym2
    """C: covariance of the position (m²)."""
    gain: Mat2
    """G: regression of velocity on position (1/s)."""
    velocity_cov: Sym2
    """S: covariance of the velocity given the position (m²/s²)."""

    @staticmethod
    def of(mean: Float[Array, "4"], cov: Float[Array, "4 4"]) -> "Kinematics":
        """From mean and covariance of (x, y, vx, vy)."""
        position_cov, cross = Sym2.of(cov[:2, :2]), Mat2.of(cov[2:, :2])
        gain = cross @ position_cov.inverse()
        velocity_cov = Sym2.of(cov[2:, 2:]) - gain.congruence(position_cov)
        return Kinematics(Vec2.of(mean[:2]), Vec2.of(mean[2:]), position_cov, gain, velocity_cov)

    def mean(self) -> Float[Array, "4"]:
        """Mean of (x, y, vx, vy)."""
        return jnp.stack([self.position.x, self.position.y, self.velocity.x, self.velocity.y])

    def cov(self) -> Float[Array, "4 4"]:
        """Covariance of (x, y, vx, vy)."""
        c, s = self.position_cov, self.gain.congruence(self.position_cov) + self.velocity_cov
        x = self.gain @ c
        return jnp.stack(
            [
                jnp.stack([c.xx, c.xy, x.xx, x.yx]),
                jnp.stack([c.xy, c.yy, x.xy, x.yy]),
                jnp.stack([x.xx, x.xy, s.xx, s.xy]),
                jnp.stack([x.yx, x.yy, s.xy, s.yy]),
            ]
        )


def predict(belief: Kinematics, noise: ProcessNoise, dt: Scalar) -> Kinematics:
    """Constant-velocity prediction over `dt` seconds: p ← p + T v + w_p, v ← v + w_v."""
    c, g, s = belief.position_cov, belief.gain, belief.velocity_cov
    # p' = M p + T u + w_p with u the part of v that p does not explain
    m = (dt * g).plus_identity()
    position_cov = m.congruence(c) + (dt * dt) * s + noise.position
    cross = g @ (c @ m.T) + dt * s.full() + noise.cross()
    gain = cross @ position_cov.inverse()
    # v' - G' p' = (G - G' M) p + (I - T G') u + (w_v - G' w_p)
    velocity_cov = (
        (g - gain @ m).congruence(c)
        + (-dt * gain).plus_identity().congruence(s)
        + (noise.gain - gain).congruence(noise.position)
        + noise.velocity
    )
    return Kinematics(belief.position + dt * belief.velocity, belief.velocity, position_cov, gain, velocity_cov)


def with_position(belief: Kinematics, position: Vec2, position_cov: Sym2) -> Kinematics:
    """The belief after its position has become Gaussian with this mean and covariance."""
    velocity = belief.velocity + belief.gain @ (position - belief.position)
    return Kinematics(position, velocity, position_cov, belief.gain, belief.velocity_cov)

"""What filters of connected objects are told: the object, how its parameters move, and the sensor noise."""

from dataclasses import dataclass, field

import jax.numpy as jnp
from jax.tree_util import register_dataclass
from jaxtyping import Array, Float

from emt.linalg import Sym2
from emt.shapes.connected import Connected
from emt.types import Scalar


@register_dataclass
@dataclass(frozen=True)
class ConnectedModel:
    """Nearly constant angular velocities, nearly constant lengths (traced numbers, but for the plan)."""

    process_variance: Float[Array, "n"]
    """Variance of the noise that each entry of the state gets per step."""
    noise_cov: Sym2
    """Covariance of the sensor noise of a point (m²)."""
    plan: Connected = field(metadata={"static": True})


def moved(mean: Float[Array, "n"], cov: Float[Array, "n n"], dt: Scalar, model: ConnectedModel):
    """Mean and covariance a step later: every angle by its rate, α ← α + dt ω, everything else as it is."""
    turning = model.plan.angles

    def along(array):
        """The first axis a step later; the rate of an angle is the entry after it."""
        return jnp.stack([row + dt * array[i + 1] if i in turning else row for i, row in enumerate(array)])

    full = along(along(cov).T).T
    return along(mean), full + jnp.diag(model.process_variance)

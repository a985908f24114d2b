"""What filters of a point are told: how it may move, what is measured of it, and how it switches."""

from dataclasses import dataclass, field
from typing import Any

import jax.numpy as jnp
from jax.tree_util import register_dataclass
from jaxtyping import Array, Float

from emt.models.state_space.measurements import Measurement
from emt.models.state_space.motions import Motion
from emt.types import Point, Traced


@register_dataclass
@dataclass(frozen=True)
class StateSpaceModel:
    """One motion, or several between which the point switches (traced numbers, but for the names)."""

    motions: tuple[Motion, ...]
    measurement: Measurement
    transition: Float[Array, "n_modes n_modes"]
    """Row: from, column: to."""
    start: Float[Array, "n_modes"]
    """Probabilities of the motions before the first prediction."""
    start_time: Traced
    """Time of the prior, for motions and measurements that depend on time (s)."""
    point: Point = field(metadata={"static": True})
    names: tuple[str, ...] = field(metadata={"static": True})
    """Of the motions."""

    def motion(self, name: str | None) -> Motion:
        """The motion of that name; the first one by default."""
        return self.motions[0 if name is None else self.names.index(name)]

    def subset(self, names: tuple[str, ...]) -> "StateSpaceModel":
        """The model with these motions only, given that the point never leaves them: rows are rescaled to sum 1."""
        places = jnp.asarray([self.names.index(name) for name in names])
        transition, start = self.transition[places][:, places], self.start[places]
        return StateSpaceModel(
            tuple(self.motion(name) for name in names),
            self.measurement,
            transition / transition.sum(axis=1, keepdims=True),
            start / start.sum(),
            self.start_time,
            self.point,
            names,
        )


def state_space_model(settings: Any) -> StateSpaceModel:
    """The model of checked settings (`config.state_space_model.StateSpaceModelSettings`)."""
    motions, names = settings.named_motions, tuple(settings.named_motions)
    point = Point(settings.states, settings.measurement.size)
    return StateSpaceModel(
        tuple(motion.build() for motion in motions.values()),
        settings.measurement.build(),
        jnp.asarray(settings.transition_matrix),
        jnp.asarray(settings.start_probabilities),
        settings.start_time,
        point,
        names,
    )

"""What the plain forms have in common: how they are prepared, and the model of an ellipse."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from emt.benchmark.peers.base import Scans
from emt.benchmark.peers.models import Transition
from emt.config.experiment import Experiment
from emt.models.state_space.motions import ConstantVelocity


class Prepared(NamedTuple):
    """A filter of all runs, to be lowered, compiled and timed apart from what was done to prepare it."""

    function: jax.stages.Wrapped
    """Jitted; gives the reports (run, step, k): x, y, vx, vy (m, m/s), both semi-axes (m) and the orientation (rad) of
    ellipses, else the mean of the state."""
    arguments: tuple[jax.Array, ...]


Form = Callable[[Experiment, Scans], Prepared]
"""Brings an experiment and the scans of some runs into arrays. The settings become constants of the function."""


def over_runs(track: Callable[..., Array], *arguments: np.ndarray | jax.Array) -> Prepared:
    """The filter `track` of one run, mapped over the first axis of its arguments."""
    return Prepared(jax.jit(jax.vmap(track)), tuple(jnp.asarray(argument) for argument in arguments))


def check_start(experiment: Experiment) -> None:
    """Raises ValueError unless the filters predict before the first scan."""
    if experiment.start_with != "predict":
        raise ValueError("the plain forms predict before the first scan")


class EllipseModel(NamedTuple):
    """What the filters of an ellipse are told."""

    F: Float[Array, "4 4"]
    Q: Float[Array, "4 4"]
    """Motion of x, y, vx, vy over a step (m, m/s)."""
    R: Float[Array, "2 2"]
    """Covariance of the sensor noise of a point (m²)."""
    extent_scale: float
    """Covariance of the points over the object, in units of the squared semi-axes."""
    cov: Float[Array, "4 4"]
    """Prior covariance of x, y, vx, vy."""
    orientation: float
    """Prior direction of the first semi-axis (rad)."""
    semi_axes: Float[Array, "2"]
    """Prior (m)."""

    @staticmethod
    def of(experiment: Experiment) -> "EllipseModel":
        """Of an experiment on an ellipse.

        Raises:
            ValueError: the filters update before they predict, or the prior gives the shape by its moments.
        """
        check_start(experiment)
        model, prior = experiment.model, experiment.model.prior
        if prior.semi_axes is None:
            raise ValueError("the prior must give the shape by its semi-axes")
        motion = Transition.of(ConstantVelocity(jnp.zeros(2), model.process_noise.build()), experiment.scenario.dt)
        return EllipseModel(
            jnp.asarray(motion.matrix),
            jnp.asarray(motion.noise_cov),
            jnp.array(model.noise_cov),
            model.extent_scale,
            jnp.array(prior.cov),
            prior.orientation,
            jnp.array(prior.semi_axes),
        )


def rotation(theta: Float[Array, ""]) -> Float[Array, "2 2"]:
    """L(theta), theta in rad."""
    c, s = jnp.cos(theta), jnp.sin(theta)
    return jnp.array([[c, -s], [s, c]])


def where_each(condition: Bool[Array, ""], new, old):
    """`new` or `old`, entry by entry of a tuple of arrays."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), new, old)

"""Descent along the gradient of a smooth metric through the whole compiled filter."""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from emt.config.load import Loaded
from emt.montecarlo.compiling import filter_options
from emt.tuning.parameters import Parameter, candidate
from emt.tuning.scoring import Batch, Data
from emt.tuning.trial import Built, Trial, build_trial

STEP = 1e-4
"""Half the distance, in coordinates, of the differences that carry them to a filter's own numbers."""
PATIENCE = 12
"""Steps without a better value before the descent ends."""
BETTER = 1e-4
"""Relative improvement that counts."""


class Point(NamedTuple):
    """One step of a descent."""

    theta: np.ndarray
    value: float
    """Of the smooth metric on the batch."""
    gradient: np.ndarray
    failed: int


class Descent:
    """Value and gradient of the first metric of a batch, by the coordinates of the parameters.

    The gradient goes through every step of every run in forward mode: its cost grows with the few parameters, its
    memory not with the number of steps. Only the way from coordinates to a filter's numbers, which runs through the
    checks of the configuration and is smooth and cheap, is differentiated by central differences, to about 1e-9; so any
    filter can be tuned, a user's own too.
    """

    def __init__(self, batch: Batch, loaded: Loaded, parameters: Sequence[Parameter]):
        self.batch, self.loaded, self.parameters = batch, loaded, parameters
        self.built = build_trial(loaded.experiment, batch.label)
        self._compiled = jax.jit(self._slopes, compiler_options=filter_options())

    def trial(self, theta: np.ndarray) -> Built:
        """The candidate at these coordinates."""
        values = [p.value(float(t)) for p, t in zip(self.parameters, theta, strict=True)]
        return build_trial(candidate(self.loaded, self.parameters, values).experiment, self.batch.label)

    def value(self, trial: Trial, data: Data) -> tuple[jax.Array, jax.Array]:
        """The metric over the sound runs, and how many failed."""
        shares, sound = self.batch.shares(self.built.make, trial, data)
        used = jnp.maximum(sound.sum(dtype=shares.dtype), 1.0)
        return shares[0].sum() / used, (~sound).sum()

    def _slopes(self, trial: Trial, tangents: Trial, data: Data):
        leaves, structure = jax.tree.flatten(trial)
        moves = jax.tree.leaves(tangents)
        is_float = [jnp.issubdtype(leaf.dtype, jnp.floating) for leaf in leaves]

        def of_floats(floats):
            rest = iter(floats)
            full = [next(rest) if real else leaf for leaf, real in zip(leaves, is_float, strict=True)]
            return self.value(jax.tree.unflatten(structure, full), data)

        floats = [leaf for leaf, real in zip(leaves, is_float, strict=True) if real]

        def along(move):
            return jax.jvp(of_floats, (floats,), (move,), has_aux=True)

        moves = [move for move, real in zip(moves, is_float, strict=True) if real]
        value, gradient, failed = jax.vmap(along, out_axes=(None, 0, None))(moves)
        return value, failed, gradient

    def at(self, theta: np.ndarray) -> Point:
        """Value and gradient at these coordinates."""
        tangents = []
        for k in range(len(theta)):
            ahead, behind = (self.trial(theta + sign * STEP * np.eye(len(theta))[k]).trial for sign in (1.0, -1.0))
            tangents.append(jax.tree.map(lambda a, b: (a - b) / (2.0 * STEP), ahead, behind))
        stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *tangents)
        value, failed, gradient = self._compiled(self.trial(theta).trial, stacked, self.batch.data)
        return Point(theta, float(value), np.asarray(gradient, float), int(failed))

    def run(self, steps: int, rate: float, on_progress: Callable[[int, Point], None]) -> list[Point]:
        """The path of Adam with a rate that falls along half a cosine; the better of two values is the one of the
        metric's direction. Ends early where nothing improves or a gradient is not finite."""
        sign = -1.0 if self.batch.metrics[0].better == "higher" else 1.0
        optimiser = optax.adam(optax.cosine_decay_schedule(rate, steps, alpha=0.05))
        theta = jnp.asarray([p.theta(p.start) for p in self.parameters])
        state = optimiser.init(theta)
        path: list[Point] = []
        best, since = math.inf, 0
        for k in range(steps):
            point = self.at(np.asarray(theta))
            path.append(point)
            on_progress(k + 1, point)
            if not (math.isfinite(point.value) and np.isfinite(point.gradient).all()):
                break
            if sign * point.value < best - BETTER * abs(best if math.isfinite(best) else 1.0):
                best, since = sign * point.value, 0
            else:
                since += 1
            if since >= PATIENCE:
                break
            move, state = optimiser.update(jnp.asarray(sign * point.gradient), state)
            theta = optax.apply_updates(theta, move)
        return path

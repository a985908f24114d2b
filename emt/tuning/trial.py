"""What tuning changes, as traced numbers, and which candidates one compiled program can serve."""

import json
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from emt.config.experiment import Experiment
from emt.montecarlo.program import cast
from emt.montecarlo.world import model_of, prior_of
from emt.registry import FILTERS
from emt.types import Prior, StatePrior


class Trial(NamedTuple):
    """What one filter is told and set to."""

    model: Any
    prior: Prior | StatePrior
    params: Any


class Built(NamedTuple):
    """A trial, and what is fixed when it is compiled."""

    trial: Trial
    make: Callable[..., Any]
    """(params, model) -> Filter."""
    structure: str
    """Trials of equal structure differ by traced numbers only."""


def build_trial(experiment: Experiment, label: str) -> Built:
    """The trial of a checked experiment."""
    settings = experiment.filters[label]
    params, make = FILTERS.get(settings.kind).builder(settings)
    trial = Trial(model_of(experiment.model), prior_of(experiment.model), params)
    trial = cast(trial, jnp.dtype(experiment.monte_carlo.dtype))
    dump = [settings.model_dump(mode="json"), experiment.model.model_dump(mode="json")]
    shapes = str(jax.tree.map(lambda leaf: (leaf.shape, str(leaf.dtype)), trial))
    return Built(trial, make, json.dumps(without_floats(dump)) + shapes)


def without_floats(value: Any) -> Any:
    """Plain data with every float left out: what may shape a program."""
    if isinstance(value, dict):
        return {key: without_floats(item) for key, item in value.items()}
    if isinstance(value, list):
        return [without_floats(item) for item in value]
    return None if isinstance(value, float) else value


def same_numbers(a: Trial, b: Trial) -> bool:
    """Whether two trials of one structure are equal: then a setting in which they differ is not traced."""
    return all(np.array_equal(x, y) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))


def grouped(trials: list[Built]) -> list[list[int]]:
    """Positions of the trials that one compiled program serves, in groups.

    A number that a filter fixes at compile time shows as two candidates with equal traced numbers; they are compiled
    on their own.
    """
    groups: dict[str, list[int]] = {}
    alone: list[list[int]] = []
    for k, built in enumerate(trials):
        members = groups.setdefault(built.structure, [])
        if any(same_numbers(built.trial, trials[other].trial) for other in members):
            alone.append([k])
        else:
            members.append(k)
    return [*groups.values(), *alone]

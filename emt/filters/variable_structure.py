"""Multiple-model filters that run only some motions at a time: likely-model set and model-group switching.

The belief of a motion depends on which motions ran in the step before, not on which run now. All motions are therefore
computed, and sets are masks on probabilities: enlarging a set after the measurement is a second normalisation.
Computing only the motions that may be needed, gathered into slots, is no faster in batches: 11 slots for 13 motions
cost as much as all 13, and sets of 12 occur.
"""

from dataclasses import dataclass
from typing import Annotated, Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.tree_util import register_dataclass
from jaxtyping import Array, Bool, Float, Int
from pydantic import Field, PositiveInt, model_validator

from emt.filters.bayes import posterior
from emt.filters.gaussian import Belief, mixed
from emt.filters.multiple_model import (
    bank_faults,
    bank_predicted,
    bank_report,
    bank_start,
    bank_updated,
    pooled,
    subset_faults,
)
from emt.filters.state_space import info_of, reading
from emt.models.state_space.model import StateSpaceModel
from emt.registry import FILTERS, UnknownName, suggest
from emt.settings import Fraction, PointSettings, PositiveFloat
from emt.types import Filter, Measurements, Scalar, Traced

Mask = Bool[Array, "n_modes"]


class LikelyModelSetSettings(PointSettings):
    """Likely-model set: drops unlikely motions and adds those adjacent to principal ones."""

    kind: Literal["likely_model_set"] = "likely_model_set"
    unlikely_below: Fraction
    """t1: probability below which a motion is unlikely."""
    principal_above: Fraction
    """t2: probability above which a motion is principal, and activates the motions it can switch to."""
    keep: PositiveInt
    """K of the rule."""
    rule: Literal["and", "or"] = "and"
    """A motion is dropped if it is unlikely and ("and") or ("or") not among the K most probable."""
    start: tuple[str, ...]
    """Motions that run in the first step."""

    @model_validator(mode="after")
    def _ordered(self):
        if not self.unlikely_below < self.principal_above:
            raise ValueError(
                f"unlikely_below must be less than principal_above, got {self.unlikely_below:g} and "
                f"{self.principal_above:g}"
            )
        return self

    def faults_with(self, model) -> list[tuple[str, str]]:
        """What does not fit the model, by key."""
        return bank_faults(model) or subset_faults(model, "start", self.start)


class ModelGroupSwitchingSettings(PointSettings):
    """Model-group switching: runs one group of motions, and two while it is in doubt."""

    kind: Literal["model_group_switching"] = "model_group_switching"
    groups: Annotated[dict[str, tuple[str, ...]], Field(min_length=2)]
    """Motions of each group, by name; groups may share motions."""
    start: str | None = None
    """The group that runs first; by default the first one."""
    activate_above: Fraction
    """A group is activated if the motions it shares with the running one have more probability than this."""
    probability_bounds: tuple[PositiveFloat, PositiveFloat]
    """Ratios of the probabilities of the new and the old group below which the new one is dropped, and above which the
    old one is."""
    likelihood_bounds: tuple[PositiveFloat, PositiveFloat]
    """The same for the ratio of their likelihoods since the activation."""

    @model_validator(mode="after")
    def _ordered(self):
        faults = []
        for key in ("probability_bounds", "likelihood_bounds"):
            low, high = getattr(self, key)
            if not low < high:
                faults.append(f"{key}: the first must be less than the second, got {low:g} and {high:g}")
        names = tuple(self.groups)
        if self.start is not None and self.start not in names:
            faults.append(f"start: {UnknownName(self.start, names, suggest(self.start, names), 'group')}")
        faults += [f"groups.{name}: is empty" for name, members in self.groups.items() if not members]
        if faults:
            raise ValueError("; ".join(faults))
        return self

    def faults_with(self, model) -> list[tuple[str, str]]:
        """What does not fit the model, by key."""
        faults = bank_faults(model)
        known = tuple(model.named_motions)
        for group, members in self.groups.items():
            for name in members:
                if name not in known:
                    unknown = UnknownName(name, known, suggest(name, known), "motion")
                    faults.append((f"groups.{group}", str(unknown)))
        covered = {name for members in self.groups.values() for name in members}
        if lacking := [name for name in known if name not in covered]:
            faults.append(("groups", f"no group holds {', '.join(lacking)}"))
        return faults


class Sets(NamedTuple):
    """A belief for each motion, and which motions run."""

    probability: Float[Array, "n_modes"]
    """Zero for those that did not run."""
    predicted: Float[Array, "n_modes"]
    """Predicted probability of all motions, those that do not run among them."""
    beliefs: Belief
    time: Scalar
    active: Mask
    """Motions that run in this step, before any is added."""


def sets_start(model: StateSpaceModel, prior, active: Mask) -> Sets:
    """All motions with the same prior, probabilities within the first set."""
    bank = bank_start(model, prior)
    probability = normalised(jnp.where(active, bank.probability, 0.0), active)
    return Sets(probability, probability, bank.beliefs, bank.time, active)


def normalised(probability: Float[Array, "n_modes"], active: Mask) -> Float[Array, "n_modes"]:
    """Probabilities of sum 1; even over the active ones where the sum is zero."""
    total, n = probability.sum(), active.sum(dtype=probability.dtype)
    even = jnp.where(active, 1.0 / jnp.maximum(n, 1.0), 0.0)
    return jnp.where(total > 0.0, probability / jnp.where(total > 0.0, total, 1.0), even)


def sets_predicted(model: StateSpaceModel, state: Sets, dt: Scalar) -> Sets:
    """Steps 1 and 2 of a cycle: all motions, mixed from those that ran in the step before."""
    predicted, starts = mixed(model.transition, state.probability, state.beliefs, dt)
    time = state.time + dt
    beliefs = bank_predicted(model, starts, time, dt)
    probability = normalised(jnp.where(state.active, predicted, 0.0), state.active)
    return Sets(probability, predicted, beliefs, time, state.active)


def number(mask: Mask, dtype) -> Scalar:
    """How many motions a set holds."""
    return mask.sum(dtype=dtype)


def places(values: Float[Array, "n"]) -> Int[Array, "n"]:
    """Place of each value in ascending order, the first of equals before the others."""
    return jnp.zeros(len(values), int).at[jnp.argsort(values)].set(jnp.arange(len(values)))


def likely_model_set(
    model: StateSpaceModel, low: Scalar, high: Scalar, keep: int, both: bool, first: tuple[int, ...]
) -> Filter:
    """Likely-model set algorithm; see `LikelyModelSetSettings`.

    Source: Li and Zhang 2000; Azimian 2005, section 4.5.3 and table 4.3 with the cycle of its table 10.3.

    Args:
        low, high: thresholds t1 and t2.
        keep: K.
        both: the "and" rule, else the "or" rule.
        first: places of the motions of the first set.
    """
    n_modes = len(model.motions)
    start = jnp.asarray(np.isin(np.arange(n_modes), first))
    adjacent = model.transition > 0.0

    def init(prior, key) -> Sets:
        return sets_start(model, prior, start)

    def update(state: Sets, scan: Measurements, key):
        value, seen = reading(scan)
        beliefs, innovation = bank_updated(model, state.beliefs, value, state.time)
        among, _ = posterior(state.predicted, innovation.log_likelihood, state.active)
        unlikely = state.active & (among < low)
        principal = state.active & (among > high)
        near = (principal[:, None] & adjacent).any(axis=0)
        union = state.active | near
        probability, total = posterior(state.predicted, innovation.log_likelihood, union)
        # ranked by logarithms: probabilities that underflow are not alike
        log_weight = jnp.log(state.predicted) + innovation.log_likelihood
        if both:
            discardable = unlikely & ~near
            dropped = discardable & (places(jnp.where(discardable, log_weight, jnp.inf)) < union.sum() - keep)
        else:
            rank = places(jnp.where(union, -log_weight, jnp.inf))
            dropped = union & (unlikely | (rank >= keep)) & (rank > 0)  # the most probable one stays
        ran = number(jnp.where(seen, union, state.active), probability.dtype)
        info = info_of(pooled(innovation, probability, total), seen, active_models=ran)
        return Sets(probability, state.predicted, beliefs, state.time, union & ~dropped), info

    return Filter(
        init,
        lambda state, dt, key: sets_predicted(model, state, dt),
        update,
        lambda state: bank_report(model, state.probability, state.beliefs),
    )


class GroupState(NamedTuple):
    """Sets, and the groups they are made of."""

    sets: Sets
    group: Int[Array, ""]
    """The group that runs; the old one of two."""
    candidate: Int[Array, ""]
    """The group that was activated, or the running one again."""
    log_ratio: Scalar
    """Of the likelihoods of the new and the old group since the activation."""


class Bounds(NamedTuple):
    """Thresholds of model-group switching."""

    activate: Traced
    probability: tuple[Traced, Traced]
    likelihood: tuple[Traced, Traced]


def model_group_switching(model: StateSpaceModel, members: np.ndarray, first: int, bounds: Bounds) -> Filter:
    """Model-group switching; see `ModelGroupSwitchingSettings`.

    The survey does not say when a group is activated. Here its score is the probability of the motions that it shares
    with the running group, and the group of the highest score is activated above a threshold.

    Source: Li et al. 1999; Azimian 2005, section 4.5.2 and table 4.2 with the cycle of its table 10.3.

    Args:
        members: (group, motion) true where a group holds a motion.
        first: the group that runs first.
    """
    table = jnp.asarray(members)

    def init(prior, key) -> GroupState:
        start = jnp.asarray(first)
        return GroupState(sets_start(model, prior, table[first]), start, start, jnp.zeros((), prior.mean.dtype))

    def update(state: GroupState, scan: Measurements, key):
        sets, group = state.sets, state.group
        value, seen = reading(scan)
        beliefs, innovation = bank_updated(model, sets.beliefs, value, sets.time)
        among, _ = posterior(sets.predicted, innovation.log_likelihood, sets.active)
        old = table[group]
        alone = state.candidate == group
        score = jnp.where(table & old[None, :], among[None, :], 0.0).sum(axis=1)
        score = jnp.where(jnp.arange(len(members)) == group, -1.0, score)
        activated = alone & (score.max() > bounds.activate)
        candidate = jnp.where(activated, jnp.argmax(score), state.candidate)
        paired, new = candidate != group, table[candidate]
        union = old | new
        probability, total = posterior(sets.predicted, innovation.log_likelihood, union)

        def log_mean_likelihood(mask: Mask) -> Scalar:
            share = jnp.where(mask, sets.predicted, 0.0)
            _, log_total = posterior(share, innovation.log_likelihood, mask)
            return log_total - jnp.log(jnp.maximum(share.sum(), jnp.finfo(share.dtype).tiny))

        step_ratio = log_mean_likelihood(new) - log_mean_likelihood(old)
        log_ratio = jnp.where(activated, 0.0, state.log_ratio) + jnp.where(paired, step_ratio, 0.0)
        share = jnp.where(new, probability, 0.0).sum(), jnp.where(old, probability, 0.0).sum()
        (low, high), (low_log, high_log) = bounds.probability, (jnp.log(b) for b in bounds.likelihood)
        drop_new = paired & ((share[0] < low * share[1]) | (log_ratio < low_log))
        drop_old = paired & ~drop_new & (share[0] > high * share[1]) & (log_ratio > high_log)
        group = jnp.where(drop_old, candidate, group)
        candidate = jnp.where(drop_new, group, candidate)
        active = table[group] | table[candidate]
        ran = number(jnp.where(seen, union, sets.active), probability.dtype)
        info = info_of(pooled(innovation, probability, total), seen, active_models=ran)
        sets = Sets(probability, sets.predicted, beliefs, sets.time, active)
        return GroupState(sets, group, candidate, jnp.where(candidate == group, 0.0, log_ratio)), info

    return Filter(
        init,
        lambda state, dt, key: state._replace(sets=sets_predicted(model, state.sets, dt)),
        update,
        lambda state: bank_report(model, state.sets.probability, state.sets.beliefs),
    )


@register_dataclass
@dataclass(frozen=True)
class LikelyParams:
    """Traced thresholds."""

    low: Traced
    high: Traced


def build_likely(settings: LikelyModelSetSettings):
    """Traced parameters and static builder of the settings."""
    keep, both, start = settings.keep, settings.rule == "and", settings.start

    def make(params: LikelyParams, model: StateSpaceModel) -> Filter:
        first = tuple(model.names.index(name) for name in start)
        return likely_model_set(model, params.low, params.high, keep, both, first)

    return LikelyParams(settings.unlikely_below, settings.principal_above), make


def build_groups(settings: ModelGroupSwitchingSettings):
    """Traced parameters and static builder of the settings."""
    groups, names = settings.groups, tuple(settings.groups)
    first = 0 if settings.start is None else names.index(settings.start)

    def make(params: Bounds, model: StateSpaceModel) -> Filter:
        members = np.array([[name in group for name in model.names] for group in groups.values()])
        return model_group_switching(model, members, first, params)

    return Bounds(settings.activate_above, settings.probability_bounds, settings.likelihood_bounds), make


FILTERS.register("likely_model_set", LikelyModelSetSettings, build_likely)
FILTERS.register("model_group_switching", ModelGroupSwitchingSettings, build_groups)

"""Interacting multiple models over any filters that can merge their states."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal, NamedTuple

import jax.numpy as jnp
from jax.scipy.special import logsumexp
from jax.tree_util import register_dataclass
from jaxtyping import Array, Float
from pydantic import Field, StringConstraints, model_validator

from emt.filters.base import TrackingModel
from emt.filters.lan_li import LanLiSettings
from emt.filters.moment_ukf import MomentUkfSettings
from emt.models.switching import ROUNDING, transition_faults
from emt.registry import FILTERS
from emt.settings import Fraction, Settings
from emt.status import Status
from emt.types import Estimate, Filter, Info, Measurements, Scalar, State

ModeName = Annotated[str, StringConstraints(pattern=r"^[A-Za-z][A-Za-z0-9_]{0,39}$")]


class ImmSettings(Settings):
    """Interacting multiple models: several filters of one family that exchange their states."""

    kind: Literal["imm"] = "imm"
    modes: Annotated[
        dict[ModeName, Annotated[MomentUkfSettings | LanLiSettings, Field(discriminator="kind")]], Field(min_length=2)
    ]
    transition: tuple[tuple[Fraction, ...], ...]
    """Row i: probabilities of going from mode i to each mode in a step, in the order of `modes`."""
    start: tuple[Fraction, ...] | None = None
    """Mode probabilities before the first scan; by default equal."""
    likelihood: Literal["joint", "average"] = "joint"
    """What weighs the modes: the likelihood of the scan, or its geometric mean per point (Yao et al. 2020)."""

    @model_validator(mode="after")
    def _consistent(self):
        n, faults = len(self.modes), transition_faults(self.transition, tuple(self.modes))
        if self.start is not None and (len(self.start) != n or abs(sum(self.start) - 1.0) > ROUNDING):
            faults.append(f"start: expected {n} probabilities that sum to 1, got {list(self.start)}")
        families = {name: mode.family for name, mode in self.modes.items()}
        if len(set(families.values())) > 1:
            known = ", ".join(f"'{name}' {family}" for name, family in families.items())
            faults.append(f"modes: their states have no common component to mix ({known})")
        if faults:
            raise ValueError("; ".join(faults))
        return self


@register_dataclass
@dataclass(frozen=True)
class Params:
    """Traced numbers of the filter."""

    transition: Float[Array, "n n"]
    start: Float[Array, "n"]
    modes: tuple[Any, ...]


class ImmState(NamedTuple):
    """States and probabilities of the modes."""

    log_probability: Float[Array, "n_modes"]
    modes: tuple[State, ...]


def imm(names: tuple[str, ...], modes: tuple[Filter, ...], params: Params, average: bool) -> Filter:
    """Interacting multiple models: mix, predict, update, weigh.

    Mode probabilities live in the log domain, so a mode that explains nothing keeps a finite, tiny probability.

    Source: Blom and Bar-Shalom 1988; Yao, Saltus and Dani 2020, Algorithm 2, for the average log-likelihood.
    """
    log_transition = jnp.log(params.transition)

    def init(prior, key) -> ImmState:
        return ImmState(jnp.log(params.start), tuple(mode.init(prior, key) for mode in modes))

    def predict(state: ImmState, dt: Scalar, key) -> ImmState:
        joint = state.log_probability[:, None] + log_transition  # from, to
        predicted = logsumexp(joint, axis=0)
        # a mode that cannot be reached keeps its own state
        weights = jnp.where(
            jnp.isfinite(predicted)[None, :],
            jnp.exp(joint - predicted[None, :]),
            jnp.eye(len(modes), dtype=joint.dtype),
        )
        mixed = [merge_of(mode)(weights[:, j], state.modes) for j, mode in enumerate(modes)]
        return ImmState(predicted, tuple(mode.predict(s, dt, key) for mode, s in zip(modes, mixed, strict=True)))

    def update(state: ImmState, scan: Measurements, key) -> tuple[ImmState, Info]:
        results = [mode.update(s, scan, key) for mode, s in zip(modes, state.modes, strict=True)]
        infos = [info for _, info in results]
        log_likelihood = jnp.stack([info.log_likelihood for info in infos])
        if average:
            log_likelihood = log_likelihood / jnp.maximum(scan.mask.sum(dtype=log_likelihood.dtype), 1.0)
        joint = state.log_probability + log_likelihood
        total = logsumexp(joint)
        posterior = joint - total
        return ImmState(posterior, tuple(new for new, _ in results)), pooled(total, jnp.exp(posterior), infos)

    def estimate(state: ImmState) -> Estimate:
        probability = jnp.exp(state.log_probability)
        merged = modes[0].estimate(merge_of(modes[0])(probability, state.modes))
        return merged._replace(modes={name: probability[k] for k, name in enumerate(names)})

    return Filter(init, predict, update, estimate)


def pooled(log_likelihood: Scalar, probability: Float[Array, "n"], infos: Sequence[Info]) -> Info:
    """Diagnostics of a mixture from those of its parts."""
    nis = (probability * jnp.stack([info.nis for info in infos])).sum()
    every = any_ = infos[0].status
    for info in infos[1:]:
        every, any_ = every & info.status, any_ | info.status
    gross = int(Status.GROSS_INNOVATION)  # a scan is gross only if no part expects it
    confusions = [info.confusion for info in infos if info.confusion is not None]
    confusion = jnp.einsum("k,kij->ij", probability, jnp.stack(confusions)) if confusions else None
    return Info(log_likelihood, nis, (any_ & ~gross) | (every & gross), confusion)


def merge_of(mode: Filter) -> Callable[..., State]:
    """How a mode takes in the others."""
    if mode.merge is None:
        raise TypeError("this filter cannot merge its state with others, so it cannot be a mode")
    return mode.merge


def build(settings: ImmSettings):
    """Traced parameters and static builder of the settings."""
    n = len(settings.modes)
    built = [FILTERS.get(mode.kind).builder(mode) for mode in settings.modes.values()]
    params = Params(
        jnp.asarray(settings.transition),
        jnp.asarray(settings.start or (1.0 / n,) * n),
        tuple(p for p, _ in built),
    )
    names, makes, average = tuple(settings.modes), [make for _, make in built], settings.likelihood == "average"

    def make(params: Params, model: TrackingModel) -> Filter:
        modes = tuple(one(p, model) for one, p in zip(makes, params.modes, strict=True))
        return imm(names, modes, params, average)

    return params, make


FILTERS.register("imm", ImmSettings, build)

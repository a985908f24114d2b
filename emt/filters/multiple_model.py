"""Multiple-model filters of a point over all motions of its model: static, GPB1, IMM and GPB2."""

from dataclasses import dataclass
from typing import Annotated, Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
from jax.tree_util import register_dataclass
from jaxtyping import Array, Bool, Float
from pydantic import Field

from emt.filters.bayes import posterior
from emt.filters.gaussian import Belief, Innovation, fused, linearly_updated, mixed, propagated
from emt.filters.state_space import info_of, reading, report
from emt.lanes import each
from emt.models.state_space.model import StateSpaceModel
from emt.models.state_space.motions import grouped, in_order
from emt.registry import FILTERS, UnknownName, suggest
from emt.settings import Fraction, PointSettings
from emt.types import Estimate, Filter, Measurements, Scalar, Traced

Method = Literal["static", "gpb1", "imm", "gpb2"]


class MultipleModelSettings(PointSettings):
    """Multiple models of a point's motion: static, GPB1, IMM or GPB2."""

    kind: Literal["multiple_model"] = "multiple_model"
    method: Method
    """How the filters start each step: "static", each from its own last state; "gpb1", all from the overall one; "imm",
    each from its own mixture; "gpb2", each from the last state of each, merged after the update."""
    motions: tuple[str, ...] = ()
    """Motions of the model that take part, if not all; the chain is then taken as never leaving them."""
    floor: Annotated[Fraction, Field(lt=1)] = 0.0
    """Least probability of a motion before each update, so that none is lost for ever (static)."""

    def faults_with(self, model) -> list[tuple[str, str]]:
        """What does not fit the model, by key."""
        faults = subset_faults(model, "motions", self.motions)
        if self.floor and self.method != "static":
            faults.append(("floor", f"goes with method: static; {self.method} takes probabilities from the chain"))
        return faults or bank_faults(model, needs_chain=self.method != "static")


def subset_faults(model: Any, key: str, names: tuple[str, ...]) -> list[tuple[str, str]]:
    """Names of motions that the model does not have, or that are given twice."""
    known = tuple(model.named_motions)
    faults = [(key, str(UnknownName(n, known, suggest(n, known), "motion"))) for n in names if n not in known]
    faults += [(key, f"'{name}' is given twice") for k, name in enumerate(names) if name in names[:k]]
    if names and not faults and not any(model.start_probabilities[known.index(name)] > 0.0 for name in names):
        faults.append((key, "the point can start in none of them (model.start)"))
    return faults


def bank_faults(model: Any, needs_chain: bool = True) -> list[tuple[str, str]]:
    """Whether a model has several motions and a chain over them."""
    if len(model.named_motions) < 2:
        return [("kind", "needs a model with several motions")]
    if needs_chain and model.switching is None:
        return [("kind", "needs model.switching, the chain over the motions")]
    return []


class Bank(NamedTuple):
    """A belief for each motion, with its probability."""

    probability: Float[Array, "n_modes"]
    beliefs: Belief
    time: Scalar


def bank_start(model: StateSpaceModel, prior: Any) -> Bank:
    """All motions with the same prior."""
    beliefs = repeated(Belief(prior.mean, prior.cov), len(model.motions))
    return Bank(model.start, beliefs, jnp.asarray(model.start_time, prior.mean.dtype))


def repeated(belief: Belief, n: int) -> Belief:
    """The same belief n times, along a new leading axis."""
    return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (n, *leaf.shape)), belief)


def bank_predicted(model: StateSpaceModel, beliefs: Belief, time: Scalar, dt: Scalar) -> Belief:
    """Each belief (leading axis) predicted by its own motion."""
    groups, parts = grouped(model.motions), []
    for group in groups:
        mine = group.own(beliefs)
        means, jacobians = jax.vmap(lambda motion, x: motion.linearised(x, time, dt))(group.motion, mine.mean)
        noise_covs = jax.vmap(lambda motion: motion.noise_cov(dt))(group.motion)
        parts.append(Belief(means, each(propagated)(mine.cov, jacobians, noise_covs, dt)))
    return in_order(groups, parts)


def bank_updated(
    model: StateSpaceModel, beliefs: Belief, value: Float[Array, "m"], time: Scalar
) -> tuple[Belief, Innovation]:
    """Each belief (leading axis) conditioned on the same measurement."""
    measurement, n_modes = model.measurement, len(beliefs.mean)
    expected, jacobians = jax.vmap(lambda x: measurement.linearised(x, time))(beliefs.mean)
    innovations = jax.vmap(lambda z: measurement.difference(value, z))(expected)
    noise_cov = measurement.noise_cov()
    noise_covs = jnp.broadcast_to(noise_cov, (n_modes, *noise_cov.shape))
    return each(linearly_updated)(beliefs, jacobians, noise_covs, innovations, time)


def bank_report(model: StateSpaceModel, probability: Float[Array, "n_modes"], beliefs: Belief) -> Estimate:
    """The mixture as one estimate."""
    modes = {name: probability[k] for k, name in enumerate(model.names)}
    return report(model, fused(probability, beliefs), modes)


def pooled(innovation: Innovation, probability: Float[Array, "*modes"], total: Scalar) -> Innovation:
    """What the measurement says of the mixture: the normalised innovations squared of its parts are averaged."""
    return Innovation(total, (probability * innovation.nis).sum())


def count(model: StateSpaceModel, dtype) -> Scalar:
    """Number of motions."""
    return jnp.asarray(len(model.motions), dtype)


def multiple_model(model: StateSpaceModel, method: Method, floor: Scalar) -> Filter:
    """Static multiple models, GPB1 and IMM: they differ in what each filter starts a step from.

    Source: Magill 1965 (static); Ackerson and Fu 1970 (GPB1); Blom and Bar-Shalom 1988 (IMM); Azimian 2005, table 4.1,
    whose mixing sum should run over x̂_j.
    """
    n_modes = len(model.motions)

    def predict(state: Bank, dt: Scalar, key) -> Bank:
        time, beliefs = state.time + dt, state.beliefs
        if method == "static":
            floored = jnp.maximum(state.probability, floor)
            probability = floored / floored.sum()
        elif method == "gpb1":
            probability = state.probability @ model.transition
            beliefs = repeated(fused(state.probability, beliefs), n_modes)
        else:
            probability, beliefs = mixed(model.transition, state.probability, beliefs, dt)
        return Bank(probability, bank_predicted(model, beliefs, time, dt), time)

    def update(state: Bank, scan: Measurements, key):
        value, seen = reading(scan)
        beliefs, innovation = bank_updated(model, state.beliefs, value, state.time)
        probability, total = posterior(state.probability, innovation.log_likelihood)
        info = info_of(
            pooled(innovation, probability, total), seen, active_models=count(model, state.probability.dtype)
        )
        return Bank(probability, beliefs, state.time), info

    return Filter(
        lambda prior, key: bank_start(model, prior),
        predict,
        update,
        lambda state: bank_report(model, state.probability, state.beliefs),
    )


class Pairs(NamedTuple):
    """A belief and a probability for every pair of motions, before the last prediction and since: [from, to]."""

    probability: Float[Array, "n_modes n_modes"]
    beliefs: Belief
    time: Scalar


def gpb2(model: StateSpaceModel) -> Filter:
    """GPB2: every motion goes on from the last state of every motion; those that end in the same one are merged.

    Source: Blom and Bar-Shalom 1988; Bar-Shalom, Li and Kirubarajan 2001, section 11.6.5. It is not in the survey, and
    stands here as what more computation can reach.
    """
    n_modes = len(model.motions)

    def merged(state: Pairs) -> Bank:
        probability = state.probability.sum(axis=0)
        even = jnp.full_like(state.probability, 1.0 / n_modes)
        possible = (probability > 0.0)[None, :]
        weights = jnp.where(possible, state.probability / jnp.where(possible, probability[None, :], 1.0), even)
        beliefs = jax.vmap(fused, in_axes=(1, 1))(weights, state.beliefs)
        return Bank(probability, beliefs, state.time)

    def init(prior, key) -> Pairs:
        bank = bank_start(model, prior)
        eye = jnp.eye(n_modes, dtype=bank.probability.dtype)
        return Pairs(eye * bank.probability[:, None], repeated(bank.beliefs, n_modes), bank.time)

    def predict(state: Pairs, dt: Scalar, key) -> Pairs:
        bank, time = merged(state), state.time + dt

        def from_one(belief: Belief) -> Belief:
            return bank_predicted(model, repeated(belief, n_modes), time, dt)

        return Pairs(bank.probability[:, None] * model.transition, jax.vmap(from_one)(bank.beliefs), time)

    def update(state: Pairs, scan: Measurements, key):
        value, seen = reading(scan)
        beliefs, innovation = jax.vmap(lambda b: bank_updated(model, b, value, state.time))(state.beliefs)
        probability, total = posterior(state.probability, innovation.log_likelihood)
        squared = count(model, state.time.dtype) ** 2
        return Pairs(probability, beliefs, state.time), info_of(
            pooled(innovation, probability, total), seen, active_models=squared
        )

    def estimate(state: Pairs) -> Estimate:
        bank = merged(state)
        return bank_report(model, bank.probability, bank.beliefs)

    return Filter(init, predict, update, estimate)


@register_dataclass
@dataclass(frozen=True)
class Params:
    """Traced numbers of the filter."""

    floor: Traced


def build(settings: MultipleModelSettings):
    """Traced parameters and static builder of the settings."""
    method, motions = settings.method, settings.motions

    def make(params: Params, model: StateSpaceModel) -> Filter:
        used = model.subset(motions) if motions else model
        return gpb2(used) if method == "gpb2" else multiple_model(used, method, params.floor)

    return Params(settings.floor), make


FILTERS.register("multiple_model", MultipleModelSettings, build)

Active = Bool[Array, "n_modes"]
"""Which motions a filter with variable structure runs."""

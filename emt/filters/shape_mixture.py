"""Trackers of connected objects: a mixture of interacting shape models, one per component.

Source: A. Zea, F. Faion and U. D. Hanebeck, "Tracking Connected Objects using Interacting Shape Models", FUSION 2014.
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import erfinv, logsumexp
from jax.tree_util import register_dataclass
from jaxtyping import Array, Float

from emt.filters import imm
from emt.filters.association import Evidence, Rules, Samples, dimension, direct, evidence, only, updated, weighted
from emt.filters.base import GROSS_INNOVATION, keep_if
from emt.filters.connected_model import ConnectedModel, moved
from emt.filters.gpb2 import gpb2
from emt.filters.sampling_update import mixed
from emt.filters.shape_mixture_settings import ShapeMixtureSettings
from emt.linalg import Vec2
from emt.registry import FILTERS
from emt.sampling.rules import standard_points
from emt.shapes.articulated import angle_period, distances
from emt.shapes.connected import Connected
from emt.status import Status
from emt.types import Articulated, Estimate, Filter, Info, Measurements, Scalar, StatePrior, Traced


@register_dataclass
@dataclass(frozen=True)
class Params:
    """Traced numbers of the filter."""

    probabilities: dict[str, Traced] | None
    stay: Traced | None
    transition: Float[Array, "c c"] | None
    gate: Traced | None
    clutter_probability: Traced | None
    clutter_area: Traced | None
    """m²"""


class Mixture(NamedTuple):
    """The numbers of a filter for one object."""

    log_prior: Float[Array, "c"]
    """Log probability that a point comes from each component, and from clutter if that is told."""
    samples: Samples
    gate_bounds: Float[Array, "c"] | None
    """Largest squared distance of a point that validates each component."""
    log_clutter_density: Scalar | None


def mixture_of(settings: ShapeMixtureSettings, rules: Rules, params: Params, model: ConnectedModel) -> Mixture:
    """Names resolved to the components of the object."""
    plan, dtype = model.plan, model.process_variance.dtype
    even, chosen = 1.0 / len(plan.components), params.probabilities
    prior = jnp.stack([jnp.asarray(chosen[name] if chosen else even, dtype) for name in plan.components])
    density = None
    if params.clutter_probability is not None and params.clutter_area is not None:
        density = -jnp.log(params.clutter_area)
        told = params.clutter_probability
        prior = jnp.concatenate([(1.0 - told) * prior, told[None]])
    bounds = None
    if params.gate is not None:
        flat = jnp.isin(jnp.arange(len(plan.components)), jnp.array([c for c, _ in plan.segments], int))
        root = erfinv(params.gate)  # quantiles of χ² with one and two degrees of freedom
        bounds = jnp.where(flat, -2.0 * jnp.log1p(-params.gate), 2.0 * root * root)
    options = settings.samples
    count = options.count if options.rule == "lcd" else None
    chosen = standard_points(options.rule, dimension(plan, rules), count, options.seed, options.kappa)
    samples = Samples(*(jnp.asarray(array, dtype) for array in chosen))
    return Mixture(jnp.log(prior), samples, bounds, density)


class Belief(NamedTuple):
    """Gaussian over the state of the object."""

    mean: Float[Array, "n"]
    cov: Float[Array, "n n"]


def started(prior: StatePrior, key) -> Belief:
    """The prior as a belief."""
    return Belief(prior.mean, prior.cov)


def predictor(model: ConnectedModel):
    """Prediction of a belief."""
    return lambda belief, dt, key: Belief(*moved(belief.mean, belief.cov, dt, model))


def reporter(model: ConnectedModel):
    """Report of a belief."""
    return lambda belief: Estimate(belief.mean, belief.cov, Articulated(belief.mean, model.plan))


def confusion_of(source: Array | None, weights: Float[Array, "c"]) -> Float[Array, "c c"] | None:
    """Association weights of one point in the row of its true component; zeros for clutter."""
    if source is None:
        return None
    return (jnp.arange(len(weights)) == source).astype(weights.dtype)[:, None] * weights[None, :]


def random_switch(settings: ShapeMixtureSettings, rules: Rules, told: Mixture, model: ConnectedModel) -> Filter:
    """Every point starts from one belief: its components are drawn anew, independently of the point before."""
    plan, n_parts = model.plan, len(model.plan.components)

    def associated(found: Evidence, belief: Belief, point: Vec2, source: Array | None) -> Float[Array, "c"]:
        log_prior = told.log_prior[:n_parts]
        match settings.association:
            case "weighted" if told.log_clutter_density is not None:
                clutter = told.log_clutter_density + told.log_prior[n_parts]
                joint = found.log_density + log_prior
                return jnp.exp(joint - jnp.logaddexp(logsumexp(joint), clutter))
            case "weighted":
                return weighted(found, log_prior)
            case "direct":
                best = direct(found, log_prior)
                if told.log_clutter_density is None:
                    return best
                clutter = told.log_clutter_density + told.log_prior[n_parts]
                return jnp.where((found.log_density + log_prior).max() < clutter, 0.0, best)
            case "nearest":
                return only(found, jnp.argmin(distances(plan, belief.mean, point)))
            case _:
                if source is None:
                    raise ValueError("this scenario does not tell which components its points come from")
                return only(found, source)

    def one_point(belief: Belief, point: Vec2, source: Array | None) -> tuple[Belief, Info]:
        found = evidence(belief.mean, belief.cov, point, model.noise_cov, told.samples, plan, rules)
        weights = associated(found, belief, point, source)
        if told.gate_bounds is not None:
            weights = jnp.where((found.distance < told.gate_bounds).any(), weights, 0.0)
        log_density = logsumexp(found.log_density + told.log_prior[:n_parts])
        if told.log_clutter_density is not None:
            log_density = jnp.logaddexp(log_density, told.log_clutter_density + told.log_prior[n_parts])
        gross = ~(found.distance <= GROSS_INNOVATION**2).any()
        status = jnp.where(gross, int(Status.GROSS_INNOVATION), 0)
        nis = (weights * found.distance).sum()
        new = Belief(*updated(belief.mean, belief.cov, found, weights))
        return new, Info(log_density, nis, status, confusion_of(source, weights))

    def update(belief: Belief, scan: Measurements, key) -> tuple[Belief, Info]:
        return over_points(one_point, belief, scan)

    return Filter(started, predictor(model), update, reporter(model))


def over_points(one_point, belief: Belief, scan: Measurements) -> tuple[Belief, Info]:
    """The points of a scan one after the other; a scan of one slot without a loop."""

    def step(belief: Belief, slot: Measurements):
        new, info = one_point(belief, Vec2.of(slot.points), slot.sources)
        info = jax.tree.map(lambda x: jnp.where(slot.mask, x, jnp.zeros_like(x)), info)
        return keep_if(slot.mask, new, belief), info

    slots = Measurements(scan.points, scan.mask, jnp.broadcast_to(scan.overflow, scan.mask.shape), scan.sources)
    if scan.mask.shape[0] == 1:
        return step(belief, jax.tree.map(lambda leaf: leaf[0], slots))
    belief, infos = jax.lax.scan(step, belief, slots)
    used = jnp.maximum(scan.mask.sum(dtype=infos.nis.dtype), 1.0)
    status = jax.lax.reduce(infos.status, np.array(0, infos.status.dtype), jax.lax.bitwise_or, (0,))
    confusion = None if infos.confusion is None else infos.confusion.sum(axis=0)
    return belief, Info(infos.log_likelihood.sum(), infos.nis.sum() / used, status, confusion)


def component_mode(component: int, rules: Rules, told: Mixture, model: ConnectedModel) -> Filter:
    """A filter that takes every point for one of this component; a mode of a Markov switch."""
    plan = model.plan
    weights = jnp.zeros(len(plan.components)).at[component].set(1.0)

    def one_point(belief: Belief, point: Vec2, source: Array | None) -> tuple[Belief, Info]:
        mean, cov, noise = belief.mean, belief.cov, model.noise_cov
        found = evidence(mean, cov, point, noise, told.samples, plan, rules, (component,))
        gross = ~(found.distance[0] <= GROSS_INNOVATION**2)
        status = jnp.where(gross, int(Status.GROSS_INNOVATION), 0)
        confusion = confusion_of(source, weights.astype(mean.dtype))
        new = Belief(*updated(mean, cov, found, jnp.ones(1, mean.dtype)))
        return new, Info(found.log_density[0], found.distance[0], status, confusion)

    def update(belief: Belief, scan: Measurements, key) -> tuple[Belief, Info]:
        return over_points(one_point, belief, scan)

    return Filter(started, predictor(model), update, reporter(model), merger(plan))


def merger(plan: Connected):
    """Moment matching of beliefs whose angles may lie whole periods apart: they are first brought to the likeliest."""
    periods = np.ones(len(plan.state))
    for angle in plan.angles:
        periods[angle] = angle_period(plan, angle)
    is_angle = np.isin(np.arange(len(periods)), plan.angles)

    def merge(weights: Float[Array, "n_modes"], beliefs: tuple[Belief, ...]) -> Belief:
        means, covs = jnp.stack([b.mean for b in beliefs]), jnp.stack([b.cov for b in beliefs])
        period = jnp.asarray(periods, means.dtype)[None, :]
        likeliest = means[jnp.argmax(weights)]
        turns = jnp.where(is_angle[None, :], jnp.round((likeliest[None, :] - means) / period), 0.0)
        _, mean, cov = mixed(jnp.log(weights), means + turns * period, covs)
        return Belief(mean, cov)

    return merge


def build(settings: ShapeMixtureSettings):
    """Traced parameters and static builder of the settings."""
    rules = Rules(settings.sensor_noise == "augmented", settings.disc.cross_term, settings.disc.density_factor)

    markov, clutter = settings.markov, settings.clutter
    params = Params(
        settings.probabilities,
        markov.stay if markov else None,
        None if markov is None or markov.transition is None else jnp.asarray(markov.transition),
        settings.gate,
        clutter.probability if clutter else None,
        clutter.area if clutter else None,
    )

    def make(params: Params, model: ConnectedModel) -> Filter:
        names = model.plan.components
        told = mixture_of(settings, rules, params, model)
        if markov is None:
            return random_switch(settings, rules, told, model)
        modes = tuple(component_mode(k, rules, told, model) for k in range(len(names)))
        chain = imm.Params(transition_of(params, len(names)), jnp.exp(told.log_prior), ())
        return gpb2(names, modes, chain) if markov.method == "gpb2" else imm.imm(names, modes, chain, False)

    return params, make


def transition_of(params: Params, n: int) -> Float[Array, "c c"]:
    """Transition matrix of a Markov switch over n components."""
    if params.transition is not None:
        return params.transition
    assert params.stay is not None
    eye = jnp.eye(n, dtype=params.stay.dtype)
    return params.stay * eye + (1.0 - params.stay) / max(n - 1, 1) * (1.0 - eye)


FILTERS.register("shape_mixture", ShapeMixtureSettings, build)

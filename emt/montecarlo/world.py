"""What all filters of an experiment are told: its model and prior, from checked settings."""

from functools import singledispatch

import jax
import jax.numpy as jnp
import numpy as np

from emt.config.connected_model import ConnectedModelSettings
from emt.config.experiment import Divergence, ModelSettings
from emt.config.state_space_model import StateSpaceModelSettings
from emt.filters.base import TrackingModel
from emt.filters.connected_model import ConnectedModel
from emt.linalg import Sym2, cholesky
from emt.models.state_space.model import StateSpaceModel, state_space_model
from emt.montecarlo.run import Limits
from emt.shapes.connected import connected
from emt.shapes.moments import ellipse_of
from emt.types import Ellipse, Prior, StatePrior


@singledispatch
def model_of(settings) -> TrackingModel | ConnectedModel | StateSpaceModel:
    """The world model of a checked experiment."""
    raise TypeError(f"no model for {type(settings).__name__}")


@model_of.register
def _(settings: ModelSettings) -> TrackingModel:
    return TrackingModel(
        settings.process_noise.build(),
        Sym2.of(np.array(settings.noise_cov)),
        settings.extent_scale,
    )


@model_of.register
def _(settings: ConnectedModelSettings) -> ConnectedModel:
    variances = jnp.asarray(settings.process_variance.of(settings.shape))
    return ConnectedModel(variances, Sym2.of(np.array(settings.noise_cov)), connected(settings.shape))


@model_of.register
def _(settings: StateSpaceModelSettings) -> StateSpaceModel:
    return state_space_model(settings)


@singledispatch
def prior_of(settings) -> Prior | StatePrior:
    """The prior of a checked experiment, from its model."""
    raise TypeError(f"no prior for {type(settings).__name__}")


@prior_of.register
def _(settings: ModelSettings) -> Prior:
    prior = settings.prior
    if prior.moments is None:
        ellipse = Ellipse(jnp.asarray(prior.semi_axes), jnp.asarray(prior.orientation))
    else:
        n11, n20, n02 = prior.moments
        ellipse = ellipse_of(Sym2(*(jnp.asarray(n) for n in (n20, n11, n02))))
    mean, cov = jnp.asarray(prior.mean), jnp.asarray(prior.cov)
    return Prior(mean, cov, ellipse, prior.turn_rate, prior.turn_rate_variance)


@prior_of.register
def _(settings: ConnectedModelSettings) -> StatePrior:
    prior, mean = settings.prior, []
    for name, kind in settings.shape.parameters.items():
        mean += [prior.lengths[name]] if kind == "length" else [prior.angles[name], prior.rates.get(name, 0.0)]
    return StatePrior(jnp.asarray(mean), jnp.diag(jnp.asarray(prior.variance.of(settings.shape))))


@prior_of.register
def _(settings: StateSpaceModelSettings) -> StatePrior:
    return StatePrior(jnp.asarray(settings.prior.mean), jnp.asarray(settings.prior.cov))


def drawn_prior(prior: Prior | StatePrior, key) -> Prior | StatePrior:
    """The prior with a mean drawn from it."""
    n, dtype = prior.mean.shape[0], prior.mean.dtype
    if isinstance(prior, StatePrior):
        return prior._replace(mean=prior.mean + cholesky(prior.cov) @ jax.random.normal(key, (n,), dtype))
    draw = jax.random.normal(key, (n + 1,), dtype)
    return prior._replace(
        mean=prior.mean + cholesky(prior.cov) @ draw[:n],
        turn_rate=prior.turn_rate + jnp.sqrt(prior.turn_rate_var) * draw[n],
    )


def limits_of(rule: Divergence | None) -> Limits:
    """The divergence rule of a checked experiment; by default no run diverges."""
    if rule is None:
        return Limits()
    return Limits(rule.position_error_above, rule.final_iou_below, dict(rule.final_mean_above) or None)

"""Particle filters of a point: from the prior, or from a Gaussian proposal per particle (EKF, unscented)."""

import math
from dataclasses import dataclass
from typing import Annotated, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import register_dataclass
from jaxtyping import Array, Float
from pydantic import Field, PositiveInt

from emt.draws import normals
from emt.filters.bayes import posterior
from emt.filters.gaussian import Belief, Innovation, Kernel, Prediction, conditioned, symmetric
from emt.filters.kalman import kalman_kernel
from emt.filters.resampling import effective_fraction, systematic
from emt.filters.state_space import info_of, motion_faults, reading, report
from emt.filters.ukf import PointRule, UnscentedSettings, spread_faults, ukf_kernel
from emt.filters.unscented import Spread
from emt.linalg import cholesky, once, semidefinite_root
from emt.logarithm import log
from emt.matrices import Matrix, SquareMatrix, check_square
from emt.models.state_space.model import StateSpaceModel
from emt.models.state_space.motions import gaussian_log_density
from emt.registry import FILTERS
from emt.settings import Fraction, PointSettings, PositiveFloat, Settings
from emt.types import Filter, Measurements, Scalar, Traced

FLOOR = 1e-12


class PriorProposalSettings(Settings):
    """Particles are drawn by the motion; the measurement only weighs them (bootstrap filter)."""

    kind: Literal["prior"] = "prior"


class GaussianProposalSettings(Settings):
    """What proposals that know the measurement have in common."""

    process_noise: Annotated[Matrix, SquareMatrix()] | None = None
    """Covariance of the process noise that the proposals believe in; that of the motion by default."""
    noise_cov: Annotated[Matrix, SquareMatrix()] | None = None
    """Covariance of the measurement noise that the proposals believe in; that of the model by default."""
    restart: bool = False
    """Whether a particle forgets its covariance: its proposal starts from a point each time."""


class EkfProposalSettings(GaussianProposalSettings):
    """Each particle is drawn from its own extended Kalman filter."""

    kind: Literal["ekf"] = "ekf"


class UkfProposalSettings(UnscentedSettings, GaussianProposalSettings):
    """Each particle is drawn from its own unscented Kalman filter (unscented particle filter)."""

    kind: Literal["ukf"] = "ukf"


class ParticleSettings(PointSettings):
    """Particle filter of a point: bootstrap, or with an EKF or an UKF (UPF) per particle as proposal."""

    kind: Literal["particle"] = "particle"
    motion: str | None = None
    """Motion of the model it believes in; needed where there are several."""
    particles: Annotated[PositiveInt, Field(le=1_000_000)]
    proposal: Annotated[
        PriorProposalSettings | EkfProposalSettings | UkfProposalSettings, Field(discriminator="kind")
    ] = PriorProposalSettings()
    resample_below: Fraction = 0.5
    """Particles are drawn anew if the effective sample size is below this fraction of them; 1 for every step."""
    likelihood_floor: PositiveFloat | None = None
    """Added to every likelihood, so that a measurement that no particle explains leaves the weights alike."""

    def faults_with(self, model) -> list[tuple[str, str]]:
        """What does not fit the model, by key."""
        if faults := motion_faults(model, self.motion):
            return faults
        given = self.proposal
        if isinstance(given, PriorProposalSettings):
            return []
        n, m = len(model.states), model.measurement.size
        sizes = [("process_noise", given.process_noise, n), ("noise_cov", given.noise_cov, m)]
        faults = [(f"proposal.{k}", fault) for k, cov, size in sizes if cov for fault in check_square(k, cov, size)]
        if isinstance(given, UkfProposalSettings) and given.restart and given.points != "redrawn":
            faults.append(("proposal.restart", "goes with points: redrawn"))
        if isinstance(given, UkfProposalSettings):
            faults += [(f"proposal.{key}", fault) for key, fault in spread_faults(given, n)]
        name = self.motion or next(iter(model.named_motions))
        cov = np.asarray(model.named_motions[name].build().noise_cov(jnp.asarray(1.0)))
        scale = np.sqrt(np.maximum(np.diag(cov), np.finfo(float).tiny))
        if (rank := np.linalg.matrix_rank(cov / np.outer(scale, scale), 1e-10)) < n:
            message = (
                f"needs process noise of full rank to weigh particles, and that of '{name}' has rank {rank} of {n}"
            )
            faults.append(("proposal", f"{message}; use white_acceleration, or proposal: {{kind: prior}}"))
        return faults


@register_dataclass
@dataclass(frozen=True)
class Params:
    """Traced numbers of the filter."""

    resample_below: Traced
    log_floor: Traced | None
    spread: Spread | None
    process_noise: Float[Array, "n n"] | None
    noise_cov: Float[Array, "m m"] | None


class ParticleState(NamedTuple):
    """Weighted particles and, with Gaussian proposals, what these need."""

    particles: Float[Array, "n count"]
    """One vector for each entry of the state: processors take several particles at a time."""
    weights: Float[Array, "count"]
    """Of sum 1."""
    time: Scalar
    floor: Float[Array, "n"]
    """Least variances that are reported: a millionth of a step's deviation, for a cloud of one effective particle."""
    own: "Own | None"
    """What Gaussian proposals need."""


class Own(NamedTuple):
    """The filter of each particle."""

    covs: Float[Array, "count n n"]
    """Covariance that the particle carries."""
    centers: Float[Array, "n count"]
    """Where the particle would have come without noise."""
    predictions: Prediction
    """Before the measurement."""
    dt: Scalar
    """Length of the last step (s); 0 before the first one."""


def particle(
    model: StateSpaceModel, name: str | None, count: int, params: Params, kernel: Kernel | None, restart: bool
) -> Filter:
    """Particle filter; with a kernel, each particle is drawn from its Gaussian given the measurement.

    Particles are resampled at the start of a step, so what is reported are the weighted ones. Weights are
    w p(y|x) p(x|x₋) / q(x), which for draws from the prior is w p(y|x).

    Source: Gordon, Salmond and Smith 1993; van der Merwe et al. 2000 for the unscented proposal; Azimian 2005,
    section 3, whose conditional covariance (3.3.3) lacks - m mᵀ.
    """
    motion, measurement = model.motion(name), model.measurement

    def init(prior, key) -> ParticleState:
        n, dtype = len(prior.mean), prior.mean.dtype
        draws = semidefinite_root(prior.cov) @ normals(key, (n, count), dtype)
        particles, time = prior.mean[:, None] + draws, jnp.asarray(model.start_time, dtype)
        weights, floor = jnp.full(count, 1.0 / count, dtype), FLOOR * jnp.diagonal(prior.cov)
        if kernel is None:
            return ParticleState(particles, weights, time, floor, None)
        covs = jnp.broadcast_to(prior.cov, (count, n, n))
        predictions = jax.vmap(kernel.start)(Belief(particles.T, covs))
        return ParticleState(particles, weights, time, floor, Own(covs, particles, predictions, jnp.zeros_like(time)))

    def predict(state: ParticleState, dt: Scalar, key) -> ParticleState:
        u_key, noise_key = jax.random.split(key)
        poor = effective_fraction(state.weights) < params.resample_below
        u = jax.random.uniform(u_key, dtype=state.weights.dtype)
        kept = once(jnp.where(poor, systematic(state.weights, u, dt), jnp.arange(count, dtype=jnp.int32)), dt)
        weights = jnp.where(poor, 1.0 / count, state.weights)
        time, particles = state.time + dt, state.particles[:, kept]
        centers = jax.vmap(lambda x: motion.move(x, time, dt), in_axes=1, out_axes=1)(particles)
        drawn = centers + motion.draws(noise_key, count, dt)
        floor = FLOOR * jnp.diagonal(motion.noise_cov(dt))
        if kernel is None or state.own is None:
            return ParticleState(drawn, weights, time, floor, None)
        if restart:
            noise_cov = motion.noise_cov(dt) if params.process_noise is None else params.process_noise
            predictions = jax.vmap(kernel.start)(
                Belief(centers.T, jnp.broadcast_to(noise_cov, (count, *noise_cov.shape)))
            )
        else:
            beliefs = Belief(particles.T, state.own.covs[kept])
            predictions = jax.vmap(kernel.predict, in_axes=(0, None, None))(beliefs, time, dt)
        return ParticleState(drawn, weights, time, floor, Own(predictions.belief.cov, centers, predictions, dt))

    def log_likelihood(particles: Float[Array, "n count"], value: Float[Array, "m"], time: Scalar):
        noise_cov = measurement.noise_cov()

        def one(x):
            gap = measurement.difference(value, measurement.observe(x, time))
            return gaussian_log_density(gap, noise_cov)

        found = jax.vmap(one, in_axes=1)(particles)
        return found if params.log_floor is None else jnp.logaddexp(found, params.log_floor)

    def expectation(state: ParticleState, value: Float[Array, "m"]) -> Innovation:
        """What the particles expected of the measurement, as a Gaussian."""
        weights = state.weights
        seen = jax.vmap(lambda x: measurement.observe(x, state.time), in_axes=1, out_axes=1)(state.particles)
        about = jax.vmap(lambda z: measurement.difference(z, seen[:, 0]), in_axes=1, out_axes=1)(seen)
        shift = about @ weights
        gaps = about - shift[:, None]
        cov = (weights[None, :] * gaps) @ gaps.T + measurement.noise_cov()
        nothing = Belief(jnp.zeros_like(shift), jnp.zeros_like(cov))
        return conditioned(nothing, jnp.zeros_like(cov), cov, measurement.difference(value, seen[:, 0] + shift))[1]

    def proposed(state: ParticleState, own: Own, kernel: Kernel, value: Float[Array, "m"], key):
        """Particles drawn given the measurement, their covariances, and the gains of their log weights."""
        beliefs, _ = jax.vmap(lambda now: kernel.update(now, value, state.time))(own.predictions)
        roots = jax.vmap(cholesky)(beliefs.cov)
        draw = normals(key, state.particles.shape, state.particles.dtype)
        particles = (beliefs.mean + (roots * draw.T[:, None, :]).sum(axis=2)).T
        scale = log(jnp.diagonal(roots, axis1=1, axis2=2)).sum(axis=1)
        log_proposal = -0.5 * (draw * draw + jnp.log(2.0 * jnp.pi)).sum(axis=0) - scale
        log_motion = jax.vmap(lambda v: motion.log_density(v, own.dt), in_axes=1)(particles - own.centers)
        gains = log_likelihood(particles, value, state.time) + log_motion - log_proposal
        # before the first step there is no motion to weigh against: the prior's draws are kept
        moved = own.dt > 0.0
        plain = log_likelihood(state.particles, value, state.time)
        covs = jnp.where(moved, beliefs.cov, own.covs)
        return jnp.where(moved, particles, state.particles), covs, jnp.where(moved, gains, plain)

    def update(state: ParticleState, scan: Measurements, key):
        value, seen = reading(scan)
        innovation, new = expectation(state, value), state
        if kernel is None or state.own is None:
            gains = log_likelihood(state.particles, value, state.time)
        else:
            particles, covs, gains = proposed(state, state.own, kernel, value, key)
            new = state._replace(particles=particles, own=state.own._replace(covs=covs))
        weights, total = posterior(state.weights, gains)
        told = innovation._replace(log_likelihood=total)
        effective = effective_fraction(jnp.where(seen, weights, state.weights))
        return new._replace(weights=weights), info_of(told, seen, effective_samples=effective)

    return Filter(init, predict, update, lambda state: report(model, moments(state)))


def moments(state: ParticleState) -> Belief:
    """Mean and covariance of the weighted particles."""
    weights = state.weights
    mean = state.particles @ weights
    gaps = state.particles - mean[:, None]
    return Belief(mean, symmetric((weights[None, :] * gaps) @ gaps.T) + jnp.diag(state.floor))


def build(settings: ParticleSettings):
    """Traced parameters and static builder of the settings."""
    given, floor = settings.proposal, settings.likelihood_floor
    name, count = settings.motion, settings.particles

    def array(cov: Matrix | None):
        return None if cov is None else jnp.asarray(cov)

    is_gaussian = not isinstance(given, PriorProposalSettings)
    restart = False if isinstance(given, PriorProposalSettings) else given.restart
    params = Params(
        settings.resample_below,
        None if floor is None else math.log(floor),
        given.spread if isinstance(given, UkfProposalSettings) else None,
        array(given.process_noise) if is_gaussian else None,
        array(given.noise_cov) if is_gaussian else None,
    )
    rule: PointRule = given.points if isinstance(given, UkfProposalSettings) else "redrawn"

    def make(params: Params, model: StateSpaceModel) -> Filter:
        motion, kernel = model.motion(name), None
        if params.spread is not None:
            kernel = ukf_kernel(model, motion, params.spread, rule, params.process_noise, params.noise_cov)
        elif is_gaussian:
            kernel = kalman_kernel(model, motion, params.process_noise, params.noise_cov)
        return particle(model, name, count, params, kernel, restart)

    return params, make


FILTERS.register("particle", ParticleSettings, build)

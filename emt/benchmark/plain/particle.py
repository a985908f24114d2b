"""The bootstrap particle filter of a point with measured range and bearing, from the equations.

N. J. Gordon, D. J. Salmond and A. F. M. Smith, IEE Proc. F 140 (1993) 107-113; G. Kitagawa, J. Comput. Graph. Statist.
5 (1996) 1-25 for systematic resampling, which takes place where few particles are effective.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from emt.benchmark.peers.base import Scans
from emt.benchmark.peers.models import Transition, point_model, prior_means, settings_of
from emt.benchmark.plain.base import Prepared, check_start, over_runs
from emt.config.experiment import Experiment
from emt.models.state_space.settings import RangeBearingSettings

SEED = 20260102
"""Of the particles' random numbers."""


def wrapped(angle: Float[Array, "count"]) -> Float[Array, "count"]:
    """The same angles (rad) in [-pi, pi)."""
    return jnp.mod(angle + jnp.pi, 2.0 * jnp.pi) - jnp.pi


def ancestors_of(weights: Float[Array, "count"], u: Float[Array, ""]) -> Int[Array, "count"]:
    """Of the positions (i + u) / N, the first particle whose cumulative weight exceeds each."""
    N = len(weights)
    found = jnp.searchsorted(jnp.cumsum(weights), (jnp.arange(N, dtype=u.dtype) + u) / N, side="right")
    return jnp.minimum(found, N - 1)  # the sum may be rounded to less than 1


def prepare(experiment: Experiment, scans: Scans) -> Prepared:
    """The filter on scans of some runs, each with a key of its own.

    Raises:
        ValueError: some scan has no measurement, or the filter or the model is another one.
    """
    check_start(experiment)
    settings, model = settings_of(experiment, "particle"), point_model(experiment)
    sensor, N = model.measurement, settings.particles
    if settings.proposal.kind != "prior" or settings.likelihood_floor is not None:
        raise ValueError("only a bootstrap filter without likelihood_floor has a plain form")
    if not isinstance(sensor, RangeBearingSettings) or not scans.mask.all():
        raise ValueError("the plain form needs a measurement of range and bearing in every scan")
    (motion,) = (Transition.of(motion.build(), experiment.scenario.dt) for motion in model.named_motions.values())
    F, b, root = jnp.array(motion.matrix), jnp.array(motion.offset), jnp.linalg.cholesky(jnp.array(motion.noise_cov))
    prior_root, place = jnp.linalg.cholesky(jnp.array(model.prior.cov)), jnp.array(sensor.sensor)

    def log_likelihood(x: Float[Array, "count 4"], z: Float[Array, "2"]) -> Float[Array, "count"]:
        """log p(z|x), less a constant."""
        dx, dy = (x[:, :2] - place[None, :]).T
        range_gap = (z[0] - jnp.hypot(dx, dy)) / sensor.range_std
        bearing_gap = wrapped(z[1] - jnp.arctan2(dy, dx)) / sensor.bearing_std
        return -0.5 * (range_gap**2 + bearing_gap**2)

    def step(now, given):
        (x, weights), (z, key) = now, given
        u_key, noise_key = jax.random.split(key)
        poor = 1.0 / (weights**2).sum() < settings.resample_below * N
        ancestors = ancestors_of(weights, jax.random.uniform(u_key))
        x, weights = jnp.where(poor, x[ancestors], x), jnp.where(poor, 1.0 / N, weights)
        x = x @ F.T + b[None, :] + jax.random.normal(noise_key, x.shape) @ root.T
        weights = jax.nn.softmax(jnp.log(weights) + log_likelihood(x, z))
        return (x, weights), weights @ x

    def track(mean: Float[Array, "4"], points: Float[Array, "step 1 2"], key) -> Float[Array, "step 4"]:
        start_key, key = jax.random.split(key)
        x = mean[None, :] + jax.random.normal(start_key, (N, 4)) @ prior_root.T
        keys = jax.random.split(key, len(points))
        return jax.lax.scan(step, (x, jnp.full(N, 1.0 / N)), (points[:, 0], keys))[1]

    keys = jax.random.split(jax.random.key(SEED), len(scans.points))
    return over_runs(track, prior_means(experiment, scans), scans.points, keys)

"""What filters share: the model they are told, their diagnostics, and the guard of their states."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.tree_util import register_dataclass
from jaxtyping import Array, Bool, Int

from emt.linalg import Sym2, Vec2, all_finite, is_positive_definite
from emt.logarithm import log
from emt.models.motion import MotionNoise
from emt.scans import all_of_batch, is_seen, scan_statistics, screen
from emt.status import Status
from emt.types import Articulated, Ellipse, Estimate, Filter, Info, Measurements, Point, State, Traced

GROSS_INNOVATION = 10.0
"""One point this many predicted standard deviations away sets `Status.GROSS_INNOVATION`, or several whose squared
distances exceed what is expected by as much together."""


@register_dataclass
@dataclass(frozen=True)
class TrackingModel:
    """The part of the world model that all filters of an experiment are told alike (traced numbers)."""

    noise: MotionNoise
    """Process noise of the constant-velocity motion."""
    sensor_noise: Sym2
    """Covariance of the sensor noise of one point (m²)."""
    extent_scale: Traced
    """Covariance of the points over the object in units of the squared semi-axes: 1/4 for a uniform ellipse, 1 for
    Gaussian points whose covariance is the extent."""


def innovation_info(position: Vec2, position_cov: Sym2, spread: Sym2, scan: Measurements) -> Info:
    """Diagnostics of a scan against the prediction.

    Args:
        position, position_cov: predicted centre and its covariance.
        spread: predicted covariance of one point about the centre, sensor noise included (m²).
        scan: the screened scan.

    The likelihood treats the points as Gaussian about the centre:
    log N(ȳ; p, C + Y/m) - (m-1)/2 log|2πY| - ½ tr(Y⁻¹ scatter) - log m.
    """
    stats = scan_statistics(scan)
    seen = stats.count > 0.0
    count = jnp.maximum(stats.count, 1.0)
    innovation_cov = position_cov + (1.0 / count) * spread
    nis = innovation_cov.inverse().quadratic(stats.mean - position)
    log_likelihood = (
        -0.5 * (nis + log(innovation_cov.det()))
        - 0.5 * (count - 1.0) * log(spread.det())
        - 0.5 * spread.inverse().inner(stats.scatter)
        - count * math.log(2.0 * math.pi)
        - log(count)
    )
    # the sum over the points of their squared distances from the prediction; 2 is expected of each
    weight = (position_cov + spread).inverse()
    distances = weight.inner(stats.scatter) + stats.count * weight.quadratic(stats.mean - position)
    gross = seen & ~(distances <= GROSS_INNOVATION**2 + 2.0 * count)  # also where the distance is not a number
    return Info(
        log_likelihood=jnp.where(seen, log_likelihood, 0.0),
        nis=jnp.where(seen, nis, 0.0),
        status=jnp.where(gross, int(Status.GROSS_INNOVATION), 0),
    )


def keep_if(condition: Bool[Array, "*lanes"], new, old):
    """`new` where the condition holds, else `old`, leaf by leaf."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), new, old)


def estimate_status(estimate: Estimate) -> Int[Array, ""]:
    """Status bits of what a filter is about to report: finite, covariances and extent positive definite.

    Of a general state only the variances are looked at: the next factorisation shows the rest.
    """
    if isinstance(estimate.shape, Articulated | Point):
        sound = (jnp.diagonal(estimate.cov) > 0.0).all()
        bits = jnp.where(sound, 0, int(Status.NOT_POSITIVE_DEFINITE))
        return jnp.where(all_finite(estimate), bits, int(Status.NON_FINITE))
    sound = is_positive_definite(Sym2.of(estimate.cov[:2, :2])) & is_positive_definite(Sym2.of(estimate.cov[2:, 2:]))
    if isinstance(estimate.shape, Ellipse):
        sound = sound & (estimate.shape.semi_axes > 0.0).all()
    bits = jnp.where(sound, 0, int(Status.NOT_POSITIVE_DEFINITE))
    return jnp.where(all_finite(estimate), bits, int(Status.NON_FINITE))


class Guarded(NamedTuple):
    """State of a guarded filter."""

    state: State
    last: State
    """The sound state after the last update."""


def guarded(flt: Filter) -> Filter:
    """The filter behind a door and a guard.

    The door screens every scan and leaves the prediction exactly as it is when nothing is left of the scan. The guard
    is the last resort: where a step would report a number that is not finite or a covariance that is not positive
    definite, it goes back to the state after the last update and sets a bit.
    """

    def init(prior, key):
        state = flt.init(prior, key)
        return Guarded(state, state)

    def soundness(state):
        return jnp.where(all_finite(state), estimate_status(flt.estimate(state)), int(Status.NON_FINITE))

    def predict(guard, dt, key):
        return Guarded(flt.predict(guard.state, dt, key), guard.last)

    def update(guard, scan, key):
        scan = screen(scan)
        new, info = flt.update(guard.state, scan, key)
        seen, bits = is_seen(scan), soundness(new)

        def settled():
            kept = keep_if(seen, new, guard.state)
            found = soundness(kept)
            return keep_if(found == 0, kept, guard.last), found

        # a batch in which every run saw something and is sound, as nearly all are, has nothing to choose
        state, status = jax.lax.cond(all_of_batch(seen & (bits == 0)), lambda: (new, jnp.zeros_like(bits)), settled)
        status = status | info.status
        status = status | jnp.where(jnp.asarray(scan.skipped), int(Status.MEASUREMENT_SKIPPED), 0)
        status = status | jnp.where(scan.overflow, int(Status.SCAN_OVERFLOW), 0)
        finite = jnp.isfinite(info.log_likelihood) & jnp.isfinite(info.nis)
        status = status | jnp.where(finite, 0, int(Status.FLOOR_USED))
        return Guarded(state, state), info._replace(
            log_likelihood=jnp.where(finite, info.log_likelihood, 0.0),
            nis=jnp.where(finite, info.nis, 0.0),
            status=status,
        )

    return Filter(init, predict, update, lambda guard: flt.estimate(guard.state))

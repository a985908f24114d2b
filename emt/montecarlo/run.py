"""One Monte Carlo run: filter its scans and score every step."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from emt.filters.base import keep_if
from emt.keys import start_key, step_key
from emt.metrics.base import Metric
from emt.metrics.iou import iou
from emt.shapes.ellipse import equivalent_ellipse
from emt.status import FAILURE, Status
from emt.types import Ellipse, Estimate, Filter, Info, Measurements, Prior, Scalar, StarConvex, State, Traced, Truth


class Track(NamedTuple):
    """What a filter reported, with a leading time axis."""

    mean: Float[Array, "n_steps 4"]
    """x, y, vx, vy (m, m/s)."""
    center: Float[Array, "n_steps 2"]
    """Centre of the reported shape (m); the mean position, except for shapes with an offset of their own."""
    semi_axes: Float[Array, "n_steps 2"]
    """Semi-axes of the shape or of its equivalent ellipse (m)."""
    orientation: Float[Array, "n_steps"]
    """Direction of the first of these axes (rad), not wrapped."""
    nis: Float[Array, "n_steps"]
    status: Int[Array, "n_steps"]
    cov: Float[Array, "n_steps 4 4"] | None
    """Covariance of the mean, on request."""
    radii: Float[Array, "n_steps n_angles"] | None
    """Radii of a star-convex shape, on request."""


class Scores(NamedTuple):
    """Scores of one filter in one run."""

    values: Float[Array, "n_metrics"]
    """Each metric over the steps of the run; 0 for a metric the filter does not have."""
    per_step: Float[Array, "n_steps n_metrics"]
    status: Int[Array, ""]
    """`Status` bits, or-ed over the steps."""
    failed_step: Int[Array, ""]
    """First step with a failure bit, or -1."""
    track: Track


class Tracker(NamedTuple):
    """A filter in its place: its start and whether the first scan is preceded by a prediction."""

    flt: Filter
    """Guarded (see `filters.base.guarded`)."""
    prior: Prior
    predict_first: bool


def advance(
    tracker: Tracker, state: State, k: Int[Array, ""], scan: Measurements, dt: Scalar, key: PRNGKeyArray
) -> tuple[State, Info]:
    """One step: prediction (not before the first scan, unless asked for) and update."""
    predict_key, update_key = jax.random.split(step_key(key, k))
    predicted = tracker.flt.predict(state, dt, predict_key)
    if not tracker.predict_first:
        predicted = keep_if(k > 0, predicted, state)
    return tracker.flt.update(predicted, scan, update_key)


def report(estimate: Estimate, info: Info, status: Int[Array, ""], full: bool) -> Track:
    """One step of a track."""
    offset, ellipse = equivalent_ellipse(estimate.shape)
    radii = estimate.shape.radii if full and isinstance(estimate.shape, StarConvex) else None
    return Track(
        estimate.mean,
        estimate.mean[:2] + offset,
        ellipse.semi_axes,
        ellipse.orientation,
        info.nis,
        status,
        estimate.cov if full else None,
        radii,
    )


def as_truth(track: Track) -> Truth:
    """A track in the role of the truth, for experiments that compare with a reference filter."""
    return Truth(track.center, track.mean[:, 2:], Ellipse(track.semi_axes, track.orientation))


class Limits(NamedTuple):
    """When a run counts as diverged."""

    position_error: Traced
    """A larger error at any scan (m)."""
    final_iou: Traced | None
    """A smaller intersection over union at the last scan."""


class Rules(NamedTuple):
    """How runs are scored."""

    metrics: tuple[Metric, ...]
    first_step: int
    """Steps before it do not count in the values of a run."""
    full: bool
    """Whether tracks hold covariances and radii."""


def score(
    tracker: Tracker,
    rules: Rules,
    truth: Truth,
    scans: Measurements,
    dt: Float[Array, "n_steps"],
    key: PRNGKeyArray,
    limits: Limits,
) -> Scores:
    """Filters and scores one run.

    Args:
        truth: what estimates are compared with, with a leading time axis.
        limits: what marks the run as diverged.
    """

    def step(carry, xs):
        state, seen, failed = carry
        k, scan, dt_k, now = xs
        state, info = advance(tracker, state, k, scan, dt_k, key)
        estimate = tracker.flt.estimate(state)
        row = [
            metric.per_step(estimate, now, info) if metric.applies_to(estimate) else jnp.zeros((), dt.dtype)
            for metric in rules.metrics
        ]
        row = jnp.stack(row) if row else jnp.zeros(0, dt.dtype)
        finite = jnp.isfinite(row).all()
        dx, dy = estimate.mean[0] - now.position[0], estimate.mean[1] - now.position[1]
        diverged = dx * dx + dy * dy > limits.position_error * limits.position_error
        status = (
            info.status | jnp.where(finite, 0, int(Status.NON_FINITE)) | jnp.where(diverged, int(Status.DIVERGED), 0)
        )
        failed = jnp.where((failed < 0) & ((status & int(FAILURE)) != 0), k, failed)
        out = jnp.where(finite, row, 0.0), report(estimate, info, status, rules.full)
        return (state, seen | status, failed), out

    steps = jnp.arange(dt.shape[0])
    start = tracker.flt.init(tracker.prior, start_key(key))
    carry = (start, jnp.asarray(0), jnp.asarray(-1, steps.dtype))
    (state, status, failed), (rows, track) = jax.lax.scan(step, carry, (steps, scans, dt, truth))
    if limits.final_iou is not None:
        lost = iou(tracker.flt.estimate(state), jax.tree.map(lambda leaf: leaf[-1], truth)) < limits.final_iou
        status = status | jnp.where(lost, int(Status.DIVERGED), 0)
        failed = jnp.where((failed < 0) & lost, steps[-1], failed)
    means = rows[rules.first_step :].mean(axis=0)
    is_rms = jnp.array([metric.over_time == "rms" for metric in rules.metrics], bool)
    return Scores(jnp.where(is_rms, jnp.sqrt(means), means), rows, status, failed, track)

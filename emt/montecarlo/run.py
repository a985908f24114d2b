"""One Monte Carlo run: filter its scans and score every step."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from emt.filters.base import keep_if
from emt.keys import start_key, step_key
from emt.linalg import once
from emt.metrics.base import Ending, Metric, has
from emt.metrics.iou import iou
from emt.metrics.kinematic import position_error_squared
from emt.montecarlo.fields import Fields, estimate_fields
from emt.scans import of_each_run
from emt.status import FAILURE, Status
from emt.types import Ellipse, Estimate, Filter, Info, Measurements, Prior, Scalar, State, StatePrior, Traced, Truth


class Track(NamedTuple):
    """What a filter reported, with a leading time axis."""

    mean: Float[Array, "n_steps n"]
    """State, as the filter's estimate gives it."""
    shape: Fields
    """See `fields.estimate_fields`."""
    nis: Float[Array, "n_steps"]
    status: Int[Array, "n_steps"]
    cov: Float[Array, "n_steps n n"] | None
    """Covariance of the mean, on request."""
    modes: Float[Array, "n_steps n_modes"] | None
    """Probability of each motion mode in the order of `mode_names`, for multiple-model filters."""


class Scores(NamedTuple):
    """Scores of one filter in one run."""

    values: Float[Array, "n_metrics"]
    """Each metric of the run; 0 for a metric the filter does not have."""
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
    prior: Prior | StatePrior
    predict_first: bool


def advance(
    tracker: Tracker, state: State, k: Int[Array, ""], scan: Measurements, dt: Scalar, key: PRNGKeyArray
) -> tuple[State, Info]:
    """One step: prediction (not before the first scan, unless asked for) and update.

    Its halves and its result are computed once each, whatever enters them (see `linalg.once`).
    """
    predict_key, update_key = jax.random.split(step_key(key, k))
    predicted = tracker.flt.predict(state, dt, predict_key)
    if not tracker.predict_first:
        predicted = keep_if(k > 0, predicted, state)
    state, info = tracker.flt.update(once(predicted, dt), scan, update_key)
    return state, once(info, dt)


def report(estimate: Estimate, info: Info, status: Int[Array, ""], full: bool) -> Track:
    """One step of a track."""
    shape = estimate_fields(estimate, full)
    modes = jnp.stack(list(estimate.modes.values())) if estimate.modes else None
    return Track(estimate.mean, shape, info.nis, status, estimate.cov if full else None, modes)


def mode_names(flt: Filter, prior: Prior | StatePrior) -> list[str]:
    """Names of a filter's modes in the order of its reports; none if it has none."""
    names: list[str] = []

    def look():
        names.extend(flt.estimate(flt.init(prior, jax.random.key(0))).modes or ())

    jax.eval_shape(look)  # what it returns would have the names sorted
    return names


def as_truth(track: Track) -> Truth:
    """A track in the role of the truth, for experiments that compare with a reference filter."""
    shape = track.shape
    return Truth.moving(shape["center"], track.mean[:, 2:], Ellipse(shape["semi_axes"], shape["orientation"]))


class Limits(NamedTuple):
    """When a run counts as lost; each rule may be missing."""

    position_error: Traced | None = None
    """A larger error at any scan (m)."""
    final_iou: Traced | None = None
    """A smaller intersection over union at the last scan."""
    final_means: dict[str, Traced] | None = None
    """A larger mean of a metric, by its name, over the last steps."""


class Rules(NamedTuple):
    """How runs are scored."""

    metrics: tuple[Metric, ...]
    first_step: int
    """Steps before it do not count in the values of a run."""
    full: bool
    """Whether tracks hold covariances and radii."""
    last_steps: int = 1
    """Steps at the end over which `Limits.final_means` are taken."""
    exclude_lost: bool = True
    """Whether lost runs fail, and so leave the averages; they are only counted otherwise."""


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
        limits: what marks the run as lost.
    """
    lost_bit = int(Status.DIVERGED if rules.exclude_lost else Status.LOST)

    def values_of(estimate: Estimate, now: Truth, info: Info) -> Float[Array, "n_metrics"]:
        row = [
            metric.per_step(estimate, now, info) if has(metric, estimate, info) else jnp.zeros((), dt.dtype)
            for metric in rules.metrics
        ]
        return jnp.stack(row) if row else jnp.zeros(0, dt.dtype)

    def counts_of(estimate: Estimate, now: Truth, info: Info) -> dict[int, Scalar]:
        counted = {k: metric.counts for k, metric in enumerate(rules.metrics) if metric.applies_to(estimate)}
        return {k: counts(estimate, now, info) for k, counts in counted.items() if counts is not None}

    def step(carry, xs):
        state, seen, failed = carry
        k, scan, dt_k, now = xs
        state, info = advance(tracker, state, k, scan, dt_k, key)
        estimate = tracker.flt.estimate(state)
        row = values_of(estimate, now, info)
        finite = jnp.isfinite(row).all()
        status = info.status | jnp.where(finite, 0, int(Status.NON_FINITE))
        if limits.position_error is not None:
            far = position_error_squared(estimate, now) > limits.position_error * limits.position_error
            status = status | jnp.where(far, lost_bit, 0)
        failed = jnp.where((failed < 0) & ((status & int(FAILURE)) != 0), k, failed)
        out = jnp.where(finite, row, 0.0), counts_of(estimate, now, info), report(estimate, info, status, rules.full)
        return (state, seen | status, failed), out

    steps = jnp.arange(dt.shape[0])
    start = tracker.flt.init(tracker.prior, start_key(key))
    carry = of_each_run((start, jnp.asarray(0), jnp.asarray(-1, steps.dtype)), key)
    (state, status, failed), (rows, counts, track) = jax.lax.scan(step, carry, (steps, scans, dt, truth))
    last, last_truth = tracker.flt.estimate(state), jax.tree.map(lambda leaf: leaf[-1], truth)
    lost = jnp.asarray(False)
    if limits.final_iou is not None:
        lost = iou(last, last_truth) < limits.final_iou
    final = dict(zip((m.name for m in rules.metrics), rows[-rules.last_steps :].mean(axis=0), strict=True))
    for name, bound in (limits.final_means or {}).items():
        if name in final:  # a reference filter has no metrics
            lost = lost | (final[name] > bound)
    status = status | jnp.where(lost, lost_bit, 0)
    if rules.exclude_lost:
        failed = jnp.where((failed < 0) & lost, steps[-1], failed)
    lost = (status & int(FAILURE | Status.LOST)) != 0
    ending = Ending(last, last_truth, lost.astype(dt.dtype))
    values = []
    for k, metric in enumerate(rules.metrics):
        used = rows[rules.first_step :, k]
        if metric.at_end is not None:
            values.append(metric.at_end(ending) if metric.applies_to(last) else jnp.zeros((), dt.dtype))
        elif k in counts:
            weight = counts[k][rules.first_step :]
            values.append((weight * used).sum() / jnp.maximum(weight.sum(), 1.0))
        else:
            value = used.max() if metric.over_time == "max" else used.mean()
            values.append(jnp.sqrt(value) if metric.over_time == "rms" else value)
    return Scores(jnp.stack(values) if values else jnp.zeros(0, dt.dtype), rows, status, failed, track)

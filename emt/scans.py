"""What happens to a scan before a filter sees it: the door that screens it, and the statistics of its points."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jax.tree_util import register_dataclass
from jaxtyping import Array, Bool, Float, Int

from emt.linalg import Sym2, Vec2
from emt.types import Measurements, Scalar


@register_dataclass
@dataclass(frozen=True)
class ScanStatistics:
    """Count, mean and scatter of the points of a scan: all that an order-free elliptical filter needs."""

    count: Scalar
    mean: Vec2
    scatter: Sym2
    """Sum of the outer products of the points about their mean (m²)."""


def scan_statistics(scan: Measurements) -> ScanStatistics:
    """Statistics of the real points of a scan, those it carries if it does; zeros for an empty one."""
    if scan.statistics is not None:
        return scan.statistics
    x, y = jnp.where(scan.mask, scan.points[:, 0], 0.0), jnp.where(scan.mask, scan.points[:, 1], 0.0)
    count = scan.mask.sum(dtype=scan.points.dtype)
    share = 1.0 / jnp.maximum(count, 1.0)
    mean = Vec2(share * x.sum(), share * y.sum())
    dx, dy = jnp.where(scan.mask, x - mean.x, 0.0), jnp.where(scan.mask, y - mean.y, 0.0)
    return ScanStatistics(count, mean, Sym2((dx * dx).sum(), (dx * dy).sum(), (dy * dy).sum()))


def screen(scan: Measurements) -> Measurements:
    """Takes out points that are not finite, or so large that their fourth power is not; padding becomes zero.

    The result tells whether a point was taken out; a scan that tells so already is returned as it is.
    """
    if scan.skipped is not None:
        return scan
    limit = float(jnp.finfo(scan.points.dtype).max) ** 0.25 / 16.0
    sound = (jnp.abs(scan.points) < limit).all(axis=1)  # False for NaN
    mask = scan.mask & sound
    points = jnp.where(mask[:, None], scan.points, 0.0)
    return scan._replace(points=points, mask=mask, skipped=(scan.mask & ~sound).any())


def prepared(scan: Measurements) -> Measurements:
    """The screened scan with the statistics of its points: done once for all filters."""
    clean = screen(scan)
    return clean._replace(statistics=scan_statistics(clean))


def is_seen(scan: Measurements) -> Bool[Array, ""]:
    """Whether a scan has a real point."""
    return scan.mask.any() if scan.statistics is None else scan.statistics.count > 0.0


@jax.custom_batching.custom_vmap
def over_batch(number: Int[Array, ""]) -> Int[Array, ""]:
    """A bound of a loop for all runs of a batch: the largest number of any; the number itself of a single run.

    A loop with one bound needs no selection between runs that go on and runs that are through.
    """
    return number


@over_batch.def_vmap
def _(axis_size, in_batched, number):
    return (number.max(axis=0) if in_batched[0] else number), False


@jax.custom_batching.custom_vmap
def of_each_run(values, own):
    """The same values, one for each run of a batch even where all runs share them.

    What a loop carries on is then each run's own from the start; else mapping the loop traces its body once more to
    find that out, which took up to two fifths of all tracing.

    Args:
        own: anything that differs between runs, such as a key.
    """
    return values


@of_each_run.def_vmap
def _(axis_size, in_batched, values, own):
    every = jax.tree.map(
        lambda leaf, is_own: leaf if is_own else jnp.broadcast_to(leaf, (axis_size, *leaf.shape)),
        values,
        in_batched[0],
    )
    return every, jax.tree.map(lambda _: True, values)


def all_of_batch(condition: Bool[Array, ""]) -> Bool[Array, ""]:
    """Whether a condition holds for all runs of a batch: what is chosen by it is computed for all of them or for none.

    Choosing between two equal results is all it may be used for: a run must not depend on its company.
    """
    return over_batch(jnp.where(condition, 0, 1)) == 0


def filled_slots(scan: Measurements) -> Int[Array, ""]:
    """Slots up to the last real point of the fullest scan of a batch: padding at the end costs nothing."""
    slots = jnp.arange(scan.mask.shape[0])
    return over_batch(jnp.where(scan.mask, slots + 1, 0).max())


def as_scan(points: Float[Array, "n 2"], capacity: int | None = None) -> Measurements:
    """A scan holding these points, padded to `capacity` (default: no padding, but at least one slot)."""
    n = points.shape[0]
    capacity = max(n, 1) if capacity is None else capacity
    if n > capacity:
        raise ValueError(f"{n} points do not fit a scan of capacity {capacity}")
    padded = jnp.zeros((capacity, 2), points.dtype).at[:n].set(points)
    return Measurements(padded, jnp.arange(capacity) < n, jnp.asarray(False))

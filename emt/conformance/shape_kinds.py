"""Kinds of golden vectors about shapes: distances between ellipses, and the update of image moments."""

from collections.abc import Iterator

import jax
import numpy as np

from emt.conformance.golden import Quantity, array
from emt.filters.moment_update import augmented_update, expected, point_update
from emt.filters.unscented import Gaussian, Spread
from emt.linalg import Sym2, Vec2
from emt.metrics.wasserstein import extent_distance_squared
from emt.shapes.overlap import ellipse_intersection_area, ellipse_iou


def _ellipses(content: dict):
    e1, e2 = array([p["e1"] for p in content["pairs"]]), array([p["e2"] for p in content["pairs"]])
    return e1, e2


def compare_ellipse_iou(content: dict) -> Iterator[Quantity]:
    """Intersection over union of pairs of ellipses; tolerances by kind of pair as the file states them."""
    e1, e2 = _ellipses(content)

    def both(a, b):
        arguments = (a[:2], a[2:4], a[4], b[:2], b[2:4], b[4])
        return ellipse_iou(*arguments), ellipse_intersection_area(*arguments)

    iou, area = jax.jit(jax.vmap(both))(e1, e2)
    stated = content["tolerance"]["float64"]
    limits = {kind: limit for kinds, limit in stated.items() for kind in kinds.split(",")}
    for k, pair in enumerate(content["pairs"]):
        limit = limits.get(pair["kind"], stated["all other kinds"])
        yield Quantity("intersection over union", iou[k], pair["iou"], scale=1.0, tolerance=limit)
        smaller = min(np.prod(pair["e1"][2:4]), np.prod(pair["e2"][2:4])) * np.pi
        yield Quantity("intersection area", area[k], pair["intersection"], scale=float(smaller), tolerance=limit)


def compare_gaussian_wasserstein(content: dict) -> Iterator[Quantity]:
    """Squared distances, relative to |Δc|² + tr X1 + tr X2."""
    e1, e2 = _ellipses(content)

    def squared(a, b):
        d = a[:2] - b[:2]
        return d @ d + extent_distance_squared(Sym2.ellipse(a[2], a[3], a[4]), Sym2.ellipse(b[2], b[3], b[4]))

    got = jax.jit(jax.vmap(squared))(e1, e2)
    for k, pair in enumerate(content["pairs"]):
        a, b = np.asarray(pair["e1"]), np.asarray(pair["e2"])
        scale = float(((a[:2] - b[:2]) ** 2).sum() + (a[2:4] ** 2).sum() + (b[2:4] ** 2).sum())
        yield Quantity("squared distance", got[k], pair["gw_squared"], scale=scale)


@jax.jit
def _moment_updates(belief: Gaussian, point: Vec2, noise: Sym2, spread: Spread):
    now = expected(belief, point, noise, spread, None)
    return now, point_update(belief, point, noise, spread, None), augmented_update(belief, point, noise, spread, None)


def compare_moment_update(content: dict) -> Iterator[Quantity]:
    """Updates of image moments by one point: the collapsed unscented transform, and the augmented one as printed."""
    for case in content["cases"]:
        belief = Gaussian(array(case["mean"]), array(case["root"]))
        spread = Spread(*(array(case[name]) for name in ("gamma", "kappa", "beta")))
        point, noise = Vec2.of(array(case["point"])), Sym2.of(array(case["R"]))
        now, ours, printed = _moment_updates(belief, point, noise, spread)
        yield Quantity("predicted pseudo-measurement", now.mean, case["phi"], scale=max(abs(case["phi"]), 1.0))
        yield Quantity("its variance", now.variance, case["S"])
        for name, new in (("collapsed", ours), ("augmented", printed)):
            yield Quantity(f"mean, {name}", new.mean, case["mean_upd"])
            yield Quantity(f"covariance, {name}", new.cov(), case["cov_upd"])

"""Errors of the parameters of connected objects, association, and the distance between whole shapes."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from emt.linalg import Vec2, once
from emt.metrics.base import FAMILIES, Metric, of_connected, register
from emt.scans import over_batch
from emt.shapes.articulated import angle_period, boundary_points, distances, links_of, mirrored_parameters
from emt.shapes.connected import Connected
from emt.types import POSITION, VELOCITY, Articulated, Estimate, Info, Point, Scalar, Truth


def plan_of(estimate: Estimate) -> Connected | None:
    """What the object is made of; None for other objects."""
    return estimate.shape.plan if isinstance(estimate.shape, Articulated) else None


def place_of(name: str, estimate: Estimate) -> int:
    """Place of a parameter in the state, -1 if there is none."""
    if isinstance(estimate.shape, Point):
        return estimate.shape.names.index(name) if name in estimate.shape.names else -1
    plan = plan_of(estimate)
    return plan.state.index(name) if plan is not None and name in plan.state else -1


def unit_of(name: str, estimate: Estimate) -> str:
    """Unit of an entry of the state."""
    plan, k = plan_of(estimate), place_of(name, estimate)
    if isinstance(estimate.shape, Point):
        return "L" if name in POSITION else "L/s" if name in VELOCITY else "1"
    if plan is None or k not in {*plan.angles, *(angle + 1 for angle in plan.angles)}:
        return "L"
    return "rad" if k in plan.angles else "rad/s"


def wrapped(angle: Scalar, period: float) -> Scalar:
    """The angle in [-period/2, period/2)."""
    return angle - period * jnp.floor(angle / period + 0.5)


def parameter_error(name: str) -> Metric:
    """Absolute error of a length, or of an angle modulo the turn that leaves the object as it is."""

    def per_step(estimate: Estimate, truth: Truth, info: Info) -> Scalar:
        plan, k = plan_of(estimate), place_of(name, estimate)
        gap = estimate.mean[k] - truth.state[k]
        return jnp.abs(wrapped(gap, 2.0 * jnp.pi) if plan is not None and k in plan.angles else gap)

    return Metric(
        f"{name}_error",
        "L or rad",
        "lower",
        f"absolute error of {name} (m, or rad modulo a full turn), mean over steps",
        per_step,
        applies_to=lambda estimate: place_of(name, estimate) >= 0,
        unit_of=lambda estimate: unit_of(name, estimate),
    )


def folded_error(name: str) -> Metric:
    """Absolute error of an angle whose sign cannot be told from the points."""

    def per_step(estimate: Estimate, truth: Truth, info: Info) -> Scalar:
        plan, k = plan_of(estimate), place_of(name, estimate)
        assert plan is not None
        return jnp.abs(jnp.abs(wrapped(estimate.mean[k], angle_period(plan, k))) - jnp.abs(truth.state[k]))

    return Metric(
        f"{name}_folded_error",
        "rad",
        "lower",
        f"absolute error of {name} but for its sign, which swaps equal components; mean over steps",
        per_step,
        applies_to=lambda estimate: place_of(name, estimate) in mirrored_places(estimate),
    )


def mirrored_places(estimate: Estimate) -> tuple[int, ...]:
    """Places of the angles whose sign swaps equal components."""
    plan = plan_of(estimate)
    return () if plan is None else mirrored_parameters(plan)


def is_mirrored(estimate: Estimate, truth: Truth) -> Scalar:
    """1 if such an angle has the other sign than the truth, else 0."""
    plan, found = plan_of(estimate), jnp.asarray(False)
    assert plan is not None
    for k in mirrored_places(estimate):
        period = angle_period(plan, k)
        found = found | (wrapped(estimate.mean[k], period) * wrapped(truth.state[k], period) < 0.0)
    return found.astype(estimate.mean.dtype)


def parameter_estimate(name: str) -> Metric:
    """The estimate itself, to be seen over time."""
    return Metric(
        f"{name}_estimate",
        "L or rad",
        "neither",
        f"estimated {name} (m or rad), mean over steps",
        lambda estimate, truth, info: estimate.mean[place_of(name, estimate)],
        applies_to=lambda estimate: place_of(name, estimate) >= 0,
        unit_of=lambda estimate: unit_of(name, estimate),
    )


def association_accuracy(name: str) -> Metric:
    """Weight that points of a component are given to it with."""

    def row(estimate: Estimate, info: Info) -> tuple[Float[Array, "c"], int]:
        plan = plan_of(estimate)
        assert plan is not None
        k, n = plan.components.index(name), len(plan.components)
        return (jnp.zeros(n, estimate.mean.dtype) if info.confusion is None else info.confusion[k]), k

    def per_step(estimate: Estimate, truth: Truth, info: Info) -> Scalar:
        weights, k = row(estimate, info)
        total = weights.sum()
        return jnp.where(total > 0.0, weights[k] / jnp.where(total > 0.0, total, 1.0), 0.0)

    return Metric(
        f"{name}_association",
        "1",
        "higher",
        f"association weight that points of component {name} give to it, mean over these points",
        per_step,
        applies_to=lambda estimate: (plan := plan_of(estimate)) is not None and name in plan.components,
        counts=lambda estimate, truth, info: row(estimate, info)[0].sum(),
    )


def shape_distance(estimate: Estimate, truth: Truth, info: Info) -> Scalar:
    """Mean distance of points along one object to the nearest component of the other, both ways (m).

    Points are evenly spaced by share along segments and outlines, weighted by length; discs take no part, for they do
    not move. Distances to a filled ellipse or rectangle are taken to its outline.
    """
    plan = plan_of(estimate)
    assert plan is not None

    objects = [(x, once_each_step(links_of(plan, x), info)) for x in (estimate.mean, truth.state)]

    def one_way(a, b) -> Scalar:
        points, weights = once_each_step(boundary_points(plan, *a), info)
        gaps = jax.vmap(lambda point: distances(plan, b[0], Vec2.of(point), True, b[1]).min())(points)
        return (weights * gaps).sum() / jnp.maximum(weights.sum(), jnp.finfo(points.dtype).tiny)

    return 0.5 * (one_way(*objects) + one_way(*reversed(objects)))


def once_each_step(values, info: Info):
    """The same values, computed once (see `linalg.once`); status bits are what the compiler cannot know here."""
    return once(values, over_batch(-info.status).astype(info.nis.dtype))


def no_value(estimate: Estimate, truth: Truth, info: Info) -> Scalar:
    """For metrics that look at the end of a run only."""
    return jnp.zeros_like(info.nis)


FAMILIES["NAME_folded_error"] = folded_error  # before the pattern that would take it as well
FAMILIES["NAME_error"] = parameter_error
FAMILIES["NAME_estimate"] = parameter_estimate
FAMILIES["NAME_association"] = association_accuracy
register(
    Metric(
        "mirrored",
        "1",
        "lower",
        "1 if at the end of the run an angle has the wrong sign where the sign swaps equal components",
        lambda estimate, truth, info: is_mirrored(estimate, truth),
        "end",
        applies_to=lambda estimate: bool(mirrored_places(estimate)),
        at_end=lambda end: is_mirrored(end.estimate, end.truth),
    )
)
register(
    Metric(
        "lost",
        "1",
        "lower",
        "1 if the run is lost by the rule of the experiment",
        no_value,
        "end",
        applies_to=lambda estimate: True,
        at_end=lambda end: end.lost,
    )
)
register(
    Metric(
        "shape_distance",
        "L",
        "lower",
        "mean distance of points along the moving components of one object to the other object, both ways; mean over "
        "steps",
        shape_distance,
        applies_to=of_connected,
    )
)

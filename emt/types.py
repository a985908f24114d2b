"""The values that travel between scenarios, filters and metrics.

Signatures show one step of one run. Leading axes are added from outside: time by `scan`, runs by `vmap`.
Lengths are metres unless an experiment declares another length unit; angles are radians, anticlockwise from +x.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

Scalar = Float[Array, ""]
Traced = Any
"""A number of the settings: a plain float where parameters are built, an array of shape () inside compiled code."""
State = Any
"""A filter's own state: any pytree of arrays."""


class Measurements(NamedTuple):
    """One scan at fixed capacity."""

    points: Float[Array, "max_points 2"]
    """Detected points (m); padding rows may hold anything."""
    mask: Bool[Array, "max_points"]
    """True where a real detection sits."""
    overflow: Bool[Array, ""]
    """True if the scan had more points than the capacity."""


class Ellipse(NamedTuple):
    """Filled ellipse about the object's position."""

    semi_axes: Float[Array, "2"]
    """Semi-axis lengths (m); the first lies along `orientation`, and neither need be the longer."""
    orientation: Scalar
    """Direction of the first axis (rad), not wrapped."""


class StarConvex(NamedTuple):
    """Outline given by radii at equally spaced angles of the body frame, the first at `orientation`."""

    radii: Float[Array, "n_angles"]
    orientation: Scalar


class Truth(NamedTuple):
    """True object at one step."""

    position: Float[Array, "2"]
    velocity: Float[Array, "2"]
    ellipse: Ellipse


class Prior(NamedTuple):
    """What every filter is told before the first scan."""

    mean: Float[Array, "4"]
    """Position (m) and velocity (m/s): x, y, vx, vy."""
    cov: Float[Array, "4 4"]
    ellipse: Ellipse
    turn_rate: Traced = 0.0
    """Mean turn rate (rad/s), for filters that estimate it."""
    turn_rate_var: Traced = 0.0
    """Its variance (rad²/s²)."""


class Estimate(NamedTuple):
    """What a filter reports; the only thing metrics see of it."""

    mean: Float[Array, "4"]
    """Position (m) and velocity (m/s): x, y, vx, vy."""
    cov: Float[Array, "4 4"]
    shape: Ellipse | StarConvex
    modes: dict[str, Scalar] | None = None
    """Probability of each motion mode by name, for multiple-model filters."""


class Info(NamedTuple):
    """Diagnostics of one update, for people and for tests."""

    log_likelihood: Scalar
    """Log density of the scan under the predicted centre and spread (Gaussian points); 0 for an empty scan."""
    nis: Scalar
    """Normalised innovation squared of the scan mean; 0 for an empty scan."""
    status: Int[Array, ""]
    """`Status` bits of this step."""


class Filter(NamedTuple):
    """A tracker: four pure functions of one step of one run."""

    init: Callable[[Prior, PRNGKeyArray], State]
    predict: Callable[[State, Scalar, PRNGKeyArray], State]
    """(state, seconds since the last step, key) -> predicted state."""
    update: Callable[[State, Measurements, PRNGKeyArray], tuple[State, Info]]
    estimate: Callable[[State], Estimate]
    merge: Callable[[Float[Array, "n_modes"], tuple[State, ...]], State] | None = None
    """(weights, states of filters of the same family) -> a state of this filter that stands for the mixture; filters
    that have it can be modes of a multiple-model filter."""


class Scenario(NamedTuple):
    """A generator of true tracks and scans, both with a leading time axis."""

    dt: Float[Array, "n_steps"]
    """Seconds since the previous step; the first entry is used only if the tracker starts with a prediction."""
    sample_truth: Callable[[PRNGKeyArray], Truth]
    sample_scans: Callable[[Truth, PRNGKeyArray], Measurements]

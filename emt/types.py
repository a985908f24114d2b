"""The values that travel between scenarios, filters and metrics.

Signatures show one step of one run. Leading axes are added from outside: time by `scan`, runs by `vmap`.
Lengths are metres unless an experiment declares another length unit; angles are radians, anticlockwise from +x.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax.tree_util import register_dataclass
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

Scalar = Float[Array, ""]
Traced = Any
"""A number of the settings: a plain float where parameters are built, an array of shape () inside compiled code."""
State = Any
"""A filter's own state: any pytree of arrays."""


class Measurements(NamedTuple):
    """One scan at fixed capacity."""

    points: Float[Array, "max_points m"]
    """Detected points (m), or what else a sensor measures of a point object; padding rows may hold anything."""
    mask: Bool[Array, "max_points"]
    """True where a real detection sits."""
    overflow: Bool[Array, ""]
    """True if the scan had more points than the capacity."""
    sources: Int[Array, "max_points"] | None = None
    """Component of a connected object that each point comes from, -1 for clutter; only simulation knows it."""
    skipped: Bool[Array, ""] | None = None
    """Whether screening took out a point; None before screening."""
    statistics: Any = None
    """`scans.ScanStatistics` of the real points, where they were computed beforehand."""


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


@register_dataclass
@dataclass(frozen=True)
class Articulated:
    """Connected object, by the lengths and angles in its state."""

    parameters: Float[Array, "n"]
    plan: Any = field(metadata={"static": True})
    """What it is made of: a `shapes.connected.Connected`, fixed when a program is compiled."""


POSITION, VELOCITY = ("x", "y", "z"), ("vx", "vy", "vz")
"""Names of the entries of a state that are positions (m) and velocities (m/s)."""


@register_dataclass
@dataclass(frozen=True)
class Point:
    """Object without extent: all there is to know is its state."""

    names: tuple[str, ...] = field(metadata={"static": True})
    """Of the entries of the state."""
    measured: int = field(metadata={"static": True})
    """Numbers per measurement."""
    modes: tuple[str, ...] = field(default=(), metadata={"static": True})
    """Names that a true mode is a place in."""

    def places(self, names: tuple[str, ...]) -> tuple[int, ...]:
        """Places in the state of those of these names that it has."""
        return tuple(self.names.index(name) for name in names if name in self.names)


class Truth(NamedTuple):
    """True object at one step."""

    state: Float[Array, "n"]
    """Of an ellipse: position (m) and velocity (m/s) x, y, vx, vy. Of a connected object: its parameters. Of a point:
    as its names say."""
    shape: Ellipse | Articulated | Point
    mode: Int[Array, ""] | None = None
    """Place of the true mode, or of the model closest to it, in the names of a point's modes."""

    @staticmethod
    def moving(position: Float[Array, "2"], velocity: Float[Array, "2"], ellipse: Ellipse) -> "Truth":
        """An ellipse on its way."""
        return Truth(jnp.concatenate([position, velocity], axis=-1), ellipse)

    @property
    def position(self) -> Float[Array, "2"]:
        """Position of an ellipse (m)."""
        return self.state[..., :2]

    @property
    def velocity(self) -> Float[Array, "2"]:
        """Velocity of an ellipse (m/s)."""
        return self.state[..., 2:4]

    @property
    def ellipse(self) -> Ellipse:
        """The shape of an object that is an ellipse."""
        if not isinstance(self.shape, Ellipse):
            raise TypeError("this object is no ellipse")
        return self.shape


class Prior(NamedTuple):
    """What every filter of an ellipse is told before the first scan."""

    mean: Float[Array, "4"]
    """Position (m) and velocity (m/s): x, y, vx, vy."""
    cov: Float[Array, "4 4"]
    ellipse: Ellipse
    turn_rate: Traced = 0.0
    """Mean turn rate (rad/s), for filters that estimate it."""
    turn_rate_var: Traced = 0.0
    """Its variance (rad²/s²)."""


class StatePrior(NamedTuple):
    """What every filter of another object is told before the first scan."""

    mean: Float[Array, "n"]
    cov: Float[Array, "n n"]


class Estimate(NamedTuple):
    """What a filter reports; the only thing metrics see of it."""

    mean: Float[Array, "n"]
    """Of an ellipse: position (m) and velocity (m/s) x, y, vx, vy. Of others: their state."""
    cov: Float[Array, "n n"]
    shape: Ellipse | StarConvex | Articulated | Point
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
    confusion: Float[Array, "c c"] | None = None
    """Points from component i (row) that were given to component j, as sums of association weights; from filters of
    connected objects where the scan tells the sources."""
    effective_samples: Scalar | None = None
    """Effective sample size of a particle filter before resampling, as a fraction of its particles."""
    active_models: Scalar | None = None
    """Models that a multiple-model filter ran in this step."""


class Filter(NamedTuple):
    """A tracker: four pure functions of one step of one run."""

    init: Callable[[Any, PRNGKeyArray], State]
    """(prior, key) -> state; the prior is a `Prior` for ellipses, else a `StatePrior`."""
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
    """Scans may come screened, with their statistics (see `scans.prepared`): all filters are then spared it."""

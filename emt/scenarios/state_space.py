"""A point whose state moves by a known motion, by one after the other, or switching between several."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import register_dataclass
from jaxtyping import Array, Float, Int
from pydantic import Field, PositiveInt, field_validator, model_validator

from emt.keys import start_key, step_key
from emt.linalg import semidefinite_root
from emt.matrices import Matrix, SquareMatrix
from emt.models.state_space.belief import belief_faults, belief_in_units
from emt.models.state_space.measurements import Measurement
from emt.models.state_space.motions import Alike, Motion, grouped
from emt.models.state_space.settings import (
    ConstantVelocitySettings,
    MeasurementSettings,
    MotionSettings,
    Name,
    measurement_faults,
    motion_faults,
)
from emt.models.switching import SwitchingSettings
from emt.registry import SCENARIOS, UnknownName, suggest
from emt.settings import Duration, Fraction, Settings
from emt.types import Measurements, Point, Scenario, Traced, Truth


class Leg(Settings):
    """Some steps with the same motion."""

    steps: PositiveInt
    motion: MotionSettings
    mode: Name | None = None
    """Motion of the model that is closest to it, for the identification of modes."""

    @property
    def is_maneuver(self) -> bool:
        """Whether it is anything but straight on at constant speed."""
        return not isinstance(self.motion, ConstantVelocitySettings) or any(self.motion.acceleration)


class StartSettings(Settings):
    """The true state at the time of the prior."""

    mean: tuple[float, ...]
    cov: Annotated[Matrix, SquareMatrix(semidefinite=True)] | None = None
    """Each run starts from a draw of N(mean, cov); by default all start from the mean."""


class StateSpaceScenarioSettings(Settings):
    """A point with a state of your choice: a motion, legs of several, or random switches between several."""

    kind: Literal["state_space"] = "state_space"
    dt: Duration = 1.0
    """Time between scans."""
    steps: PositiveInt | None = None
    """Scans; legs have their own."""
    motion: MotionSettings | None = None
    """The only motion."""
    legs: tuple[Leg, ...] = ()
    """Motions one after the other, instead."""
    motions: dict[Name, MotionSettings] = Field(default_factory=dict)
    """Motions to switch between at random, instead."""
    switching: SwitchingSettings | None = None
    """The Markov chain over `motions`."""
    first: Name | None = None
    """Motion at the start, before the first switch; by default the first of `motions`."""
    start: StartSettings
    """The true state one step before the first scan."""
    start_time: float = 0.0
    """Time of the start in seconds, where motion or measurement depends on time."""
    measurement: MeasurementSettings
    detection_probability: Fraction = 1.0
    """Probability that a scan holds a measurement."""
    has_truth: ClassVar[bool] = True
    tracks: ClassVar[str] = "state_space"

    @field_validator("start", mode="before")
    @classmethod
    def _in_units(cls, given: Any, info: Any) -> Any:
        """Texts with units become numbers, now that the names of the state are known."""
        motions = [info.data.get("motion"), *(leg.motion for leg in info.data.get("legs") or ())]
        motions += (info.data.get("motions") or {}).values()
        states = next((motion.states for motion in motions if motion is not None), None)
        return given if states is None else belief_in_units(given, states)

    @model_validator(mode="after")
    def _fit(self):
        faults = self.motion_faults()
        if not faults:
            faults += [f"measurement: {fault}" for fault in measurement_faults(self.measurement, self.states)]
            faults += belief_faults("start", self.start.mean, self.start.cov, self.states)
        if faults:
            raise ValueError("; ".join(faults))
        return self

    def motion_faults(self) -> list[str]:
        """What is wrong with the motions and their order."""
        if (self.motion is not None) + bool(self.legs) + bool(self.motions) != 1:
            return ["give one of motion, legs or motions"]
        faults = []
        if self.legs and self.steps is not None:
            faults.append("steps: the legs have their own")
        if not self.legs and self.steps is None:
            faults.append("steps: is required")
        names = tuple(self.motions)
        if bool(self.motions) != (self.switching is not None):
            faults.append("switching: goes with motions")
        elif self.switching is not None:
            faults += [f"switching.{fault}" for fault in self.switching.faults(names)]
        if self.first is not None and self.first not in names:
            faults.append(f"first: {UnknownName(self.first, names, suggest(self.first, names), 'motion')}")
        if len({leg.mode is None for leg in self.legs}) > 1:
            faults.append("legs: give the mode of all or of none")
        for key, motion in self.keyed_motions:
            faults += [f"{key}: {fault}" for fault in motion_faults(motion)]
            if motion.states != self.states:
                faults.append(f"{key}: its state is {', '.join(motion.states)}, not {', '.join(self.states)}")
        return faults

    def faults_with(self, model) -> list[tuple[str, str]]:
        """What does not fit the model that filters are told, by key."""
        faults = []
        if self.states != model.states:
            faults.append(
                ("start", f"the state is {', '.join(self.states)}, that of the model {', '.join(model.states)}")
            )
        elif self.measurement.size != model.measurement.size:
            sizes = f"{self.measurement.size} numbers, that of the model {model.measurement.size}"
            faults.append(("measurement", f"a measurement has {sizes}"))
        known = tuple(model.named_motions)
        for k, leg in enumerate(self.legs):
            if leg.mode is not None and leg.mode not in known:
                faults.append((f"legs.{k}.mode", str(UnknownName(leg.mode, known, suggest(leg.mode, known), "motion"))))
        return faults

    @property
    def keyed_motions(self) -> list[tuple[str, Any]]:
        """Every motion with the key it stands under."""
        single = [] if self.motion is None else [("motion", self.motion)]
        legs = [(f"legs[{k}].motion", leg.motion) for k, leg in enumerate(self.legs)]
        return [*single, *legs, *((f"motions.{name}", motion) for name, motion in self.motions.items())]

    @property
    def states(self) -> tuple[str, ...]:
        """Names of the entries of the state."""
        return self.keyed_motions[0][1].states

    @property
    def n_steps(self) -> int:
        return self.steps if self.steps is not None else sum(leg.steps for leg in self.legs)

    @property
    def modes(self) -> tuple[str, ...]:
        """Names of the modes that the truth tells; none if it does not."""
        return tuple(self.motions) or tuple(dict.fromkeys(leg.mode for leg in self.legs if leg.mode is not None))

    @property
    def true_modes(self) -> tuple[str, ...] | None:
        """The true mode at every step where all runs have the same."""
        known = [leg.mode for leg in self.legs for _ in range(leg.steps) if leg.mode is not None]
        return tuple(known) or None

    @property
    def maneuvers(self) -> tuple[tuple[int, int], ...]:
        """First and last scan of every manoeuvre, adjoining legs as one."""
        found: list[tuple[int, int]] = []
        last = 0
        for leg in self.legs:
            first, last = last + 1, last + leg.steps
            if leg.is_maneuver and found and found[-1][1] == first - 1:
                found[-1] = (found[-1][0], last)
            elif leg.is_maneuver:
                found.append((first, last))
        return tuple(found)


@register_dataclass
@dataclass(frozen=True)
class Params:
    """Traced numbers of the scenario."""

    dt: Traced
    motions: tuple[Motion, ...]
    order: Int[Array, "n_steps"]
    """Motion at every step; unused where switches are random."""
    transition: Float[Array, "n_modes n_modes"] | None
    first: Int[Array, ""]
    mean: Float[Array, "n"]
    cov: Float[Array, "n n"]
    start_time: Traced
    measurement: Measurement
    detection_probability: Traced
    point: Point = field(metadata={"static": True})


def motion_order(params: Params, n_steps: int, key) -> Int[Array, "n_steps"]:
    """Motion at every step of a run."""
    if params.transition is None:
        return params.order
    bounds = jnp.cumsum(params.transition, axis=1)

    def step(mode, k):
        u = jax.random.uniform(jax.random.fold_in(step_key(key, k), 1), dtype=bounds.dtype)
        new = jnp.minimum((u >= bounds[mode]).sum(), bounds.shape[0] - 1)
        return new, new

    return jax.lax.scan(step, params.first, jnp.arange(n_steps))[1]


def places_in(groups: Sequence[Alike]) -> tuple[Int[Array, "n_motions"], Int[Array, "n_motions"]]:
    """Group of each motion, and its place there."""
    where = {place: (g, k) for g, group in enumerate(groups) for k, place in enumerate(group.places)}
    both = np.array([where[place] for place in range(len(where))])
    return jnp.asarray(both[:, 0]), jnp.asarray(both[:, 1])


def build(settings: StateSpaceScenarioSettings, runs: int):
    """Traced parameters and static builder of the settings."""
    n_steps, n, modes = settings.n_steps, len(settings.states), settings.modes
    names, motions = tuple(settings.motions), [motion for _, motion in settings.keyed_motions]
    legs = [k for k, leg in enumerate(settings.legs) for _ in range(leg.steps)]
    params = Params(
        settings.dt,
        tuple(motion.build() for motion in motions),
        jnp.asarray(legs if legs else [0] * n_steps),
        None if settings.switching is None else jnp.asarray(settings.switching.matrix(names)),
        jnp.asarray(names.index(settings.first) if settings.first else 0),
        jnp.asarray(settings.start.mean),
        jnp.zeros((n, n)) if settings.start.cov is None else jnp.asarray(settings.start.cov),
        settings.start_time,
        settings.measurement.build(),
        settings.detection_probability,
        Point(settings.states, settings.measurement.size, modes),
    )
    # places of the legs' modes in the names of modes; motions that switch are modes themselves
    closest = jnp.asarray([modes.index(leg.mode) for leg in settings.legs if leg.mode is not None] or range(len(names)))

    def make(params: Params) -> Scenario:
        def sample_truth(key) -> Truth:
            dtype = params.mean.dtype
            order, groups = motion_order(params, n_steps, key), grouped(params.motions)
            group_of, place_in = places_in(groups)
            first = params.mean + semidefinite_root(params.cov) @ jax.random.normal(start_key(key), (n,), dtype)

            def step(state, now):
                k, motion = now
                time = params.start_time + (k + 1).astype(dtype) * params.dt
                noise_key = jax.random.fold_in(step_key(key, k), 0)

                def moved(alike: Alike):
                    def branch(x):
                        one = jax.tree.map(lambda leaf: leaf[place_in[motion]], alike.motion)
                        return one.move(x, time, params.dt) + one.draws(noise_key, 1, params.dt)[:, 0]

                    return branch

                branches = [moved(alike) for alike in groups]
                state = jax.lax.switch(group_of[motion], branches, state) if len(groups) > 1 else branches[0](state)
                return state, state

            _, states = jax.lax.scan(step, first, (jnp.arange(n_steps), order))
            return Truth(states, params.point, closest[order] if modes else None)

        def sample_scans(truth: Truth, key) -> Measurements:
            dtype = truth.state.dtype

            def one(k, state):
                time = params.start_time + (k + 1).astype(dtype) * params.dt
                value = params.measurement.draw(state, time, jax.random.fold_in(step_key(key, k), 0))
                u = jax.random.uniform(jax.random.fold_in(step_key(key, k), 1), dtype=dtype)
                return value[None, :], (u < params.detection_probability)[None]

            points, mask = jax.vmap(one)(jnp.arange(n_steps), truth.state)
            return Measurements(points, mask, jnp.zeros(n_steps, bool))

        return Scenario(jnp.full(n_steps, params.dt), sample_truth, sample_scans)

    return params, make


SCENARIOS.register("state_space", StateSpaceScenarioSettings, build)

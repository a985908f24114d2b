"""The world as every filter of a point is told it is."""

from typing import Annotated, Any, Literal

from pydantic import Field, field_validator, model_validator

from emt.matrices import Matrix, SquareMatrix
from emt.models.state_space.belief import belief_faults, belief_in_units
from emt.models.state_space.settings import (
    MeasurementSettings,
    MotionSettings,
    Name,
    measurement_faults,
    motion_faults,
)
from emt.models.switching import ROUNDING, SwitchingSettings, unreachable
from emt.registry import UnknownName, suggest
from emt.settings import Fraction, Settings


class StateSpacePriorSettings(Settings):
    """What every filter believes before the first prediction."""

    mean: tuple[float, ...]
    """Of the state, in the order of its names."""
    cov: Annotated[Matrix, SquareMatrix()]
    drawn: bool = False
    """Whether each run starts from a mean of its own, drawn from N(mean, cov), the same for all filters."""


class StateSpaceModelSettings(Settings):
    """A point whose state moves and is measured as described; with several motions, it may switch between them."""

    kind: Literal["state_space"]
    motion: MotionSettings | None = None
    """How the point moves."""
    motions: dict[Name, MotionSettings] = Field(default_factory=dict)
    """Several ways to move, by name, instead."""
    switching: SwitchingSettings | None = None
    """The Markov chain over the motions."""
    start: dict[Name, Fraction] | None = None
    """Probabilities of the motions before the first prediction; by default equal."""
    measurement: MeasurementSettings
    start_time: float = 0.0
    """Time of the prior in seconds, where motion or measurement depends on time."""
    prior: StateSpacePriorSettings

    @field_validator("prior", mode="before")
    @classmethod
    def _in_units(cls, given: Any, info: Any) -> Any:
        """Texts with units become numbers, now that the names of the state are known."""
        motions = [info.data.get("motion"), *(info.data.get("motions") or {}).values()]
        states = next((motion.states for motion in motions if motion is not None), None)
        return given if states is None else belief_in_units(given, states)

    @model_validator(mode="after")
    def _fit(self):
        faults = self.motion_faults()
        if not faults:
            faults += [f"measurement: {fault}" for fault in measurement_faults(self.measurement, self.states)]
            faults += belief_faults("prior", self.prior.mean, self.prior.cov, self.states)
            names = tuple(self.named_motions)
            if self.switching is not None:
                faults += [f"switching.{fault}" for fault in self.switching.faults(names)]
            for name in self.start or {}:
                if name not in names:
                    faults.append(f"start: {UnknownName(name, names, suggest(name, names), 'motion')}")
            if self.start is not None and abs(sum(self.start.values()) - 1.0) > ROUNDING:
                faults.append(f"start: the probabilities sum to {sum(self.start.values()):.6g}, not 1")
        if faults:
            raise ValueError("; ".join(faults))
        return self

    def motion_faults(self) -> list[str]:
        """What is wrong with the motions."""
        if (self.motion is None) == (not self.motions):
            return ["give either motion or motions"]
        faults = []
        for name, motion in self.named_motions.items():
            key = f"motions.{name}" if self.motions else "motion"
            faults += [f"{key}: {fault}" for fault in motion_faults(motion)]
            if motion.states != self.states:
                faults.append(f"{key}: its state is {', '.join(motion.states)}, not {', '.join(self.states)}")
        return faults

    @property
    def named_motions(self) -> dict[str, Any]:
        """The motions by name; a single one has the name 'motion'."""
        return self.motions or {"motion": self.motion}

    @property
    def states(self) -> tuple[str, ...]:
        """Names of the entries of the state."""
        return next(iter(self.named_motions.values())).states

    @property
    def transition_matrix(self) -> tuple[tuple[float, ...], ...]:
        """The Markov chain; without one, the point never switches."""
        switching = SwitchingSettings(stay=1.0) if self.switching is None else self.switching
        return switching.matrix(tuple(self.named_motions))

    @property
    def start_probabilities(self) -> tuple[float, ...]:
        """Probabilities of the motions before the first prediction."""
        names = tuple(self.named_motions)
        return tuple(1.0 / len(names) if self.start is None else self.start.get(name, 0.0) for name in names)

    @property
    def unreachable(self) -> tuple[str, ...]:
        """Motions that the chain can neither start in nor come to."""
        return unreachable(self.transition_matrix, self.start_probabilities, tuple(self.named_motions))

"""Settings of the tracker of connected objects."""

from math import pi
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field, PositiveInt, model_validator

from emt.models.switching import SwitchingSettings
from emt.settings import Fraction, Length, PositiveFloat, Quantity, Settings
from emt.shapes.connected import Name, connected, probability_faults

GateProbability = Annotated[float, Quantity("1", gt=0, lt=1)]


class SampleSettings(Settings):
    """Deterministic samples of a standard normal density."""

    rule: Literal["lcd", "unscented", "cubature"] = "lcd"
    """"lcd": placed so that the localised cumulative distributions agree (Steinbring and Hanebeck 2013)."""
    count: PositiveInt | None = None
    """Number of LCD samples, at least twice their dimension, which is the default."""
    seed: Annotated[int, Field(ge=0)] = 0
    """Of the optimiser of the LCD samples."""
    kappa: float | None = None
    """Of the unscented rule; by default 3 less the dimension."""

    @model_validator(mode="after")
    def _fit(self):
        if self.rule != "lcd" and self.count is not None:
            raise ValueError(f"count: the {self.rule} rule has a count of its own")
        if self.rule != "unscented" and self.kappa is not None:
            raise ValueError(f"kappa: the {self.rule} rule has none")
        return self

    def fault(self, dimension: int) -> str | None:
        """What is wrong with the samples for this dimension."""
        if self.count is not None and self.count < 2 * dimension:
            return f"{self.count} samples are fewer than twice their dimension, 2 x {dimension}"
        if self.kappa is not None and self.kappa <= -dimension:
            return f"kappa must be greater than -{dimension}, minus the dimension of the samples"
        return None


class DiscDensitySettings(Settings):
    """How a disc's density is compared with those of the other components."""

    cross_term: bool = True
    """Whether the spread of |y - b|² includes twice the product of source and noise, which the paper leaves out."""
    density_factor: PositiveFloat = 1.0 / pi
    """Density per area in units of the density of |y - b|²: 1/π is exact, the paper's 1 compares unlike units."""


class MarkovSettings(SwitchingSettings):
    """Components of successive scans form a Markov chain; all points of a scan come from the same component."""

    method: Literal["imm", "gpb2"] = "imm"


class ClutterSettings(Settings):
    """Points that come from no component, uniform over a rectangle."""

    probability: Fraction
    low: tuple[Length, Length]
    high: tuple[Length, Length]

    @model_validator(mode="after")
    def _has_area(self):
        if not (self.low[0] < self.high[0] and self.low[1] < self.high[1]):
            raise ValueError("high: must lie right of and above low")
        return self

    @property
    def area(self) -> float:
        """Area of the rectangle (m²)."""
        return (self.high[0] - self.low[0]) * (self.high[1] - self.low[1])


class ShapeMixtureSettings(Settings):
    """Interacting shape models: a sampling Kalman update per component of a connected object, then association."""

    kind: Literal["shape_mixture"] = "shape_mixture"
    association: Literal["weighted", "direct", "nearest", "known"] = "weighted"
    """"weighted" by posterior probability, "direct" the most probable component alone, "nearest" the closest one, or
    the "known" true component of simulated points: a bound on what association can reach."""
    probabilities: dict[Name, Fraction] | None = None
    """Probability that a point comes from each component; by default equal."""
    markov: MarkovSettings | None = None
    """A Markov switch instead of independent components."""
    samples: SampleSettings = SampleSettings()
    sensor_noise: Literal["additive", "augmented"] = "additive"
    """"additive": exact, for isotropic noise; "augmented": sampled with the state, as the paper reads literally."""
    disc: DiscDensitySettings = DiscDensitySettings()
    gate: GateProbability | None = None
    """A point is used if a component validates it: its squared distance lies below this quantile of χ²."""
    clutter: ClutterSettings | None = None
    """Clutter as one more component."""
    tracks: ClassVar[str] = "connected"

    @model_validator(mode="after")
    def _fit(self):
        if self.markov is not None:
            given = {"gate": self.gate, "clutter": self.clutter, "probabilities": self.probabilities}
            faults = [f"{key}: a Markov switch has none" for key, value in given.items() if value is not None]
            if self.association != "weighted":
                faults.append("association: a Markov switch weighs its components")
            if faults:
                raise ValueError("; ".join(faults))
        return self

    def faults_with(self, model: Any) -> list[tuple[str, str]]:
        """(key, what is wrong) for the object and the sensor noise of a model."""
        plan = connected(model.shape)
        faults = [("probabilities", fault) for fault in probability_faults(self.probabilities, plan.components)]
        if self.markov is not None:
            faults += [("markov", fault) for fault in self.markov.faults(plan.components)]
        if fault := self.samples.fault(len(plan.state) + (3 if self.sensor_noise == "augmented" else 1)):
            faults.append(("samples", fault))
        if self.sensor_noise == "additive":
            (a, b), (_, d) = model.noise_cov
            if a != d or b != 0.0:
                faults.append(("sensor_noise", "the noise_cov of the model is not isotropic: use 'augmented'"))
            if plan.bodies:
                names = ", ".join(plan.components[body.component] for body in plan.bodies)
                faults.append(("sensor_noise", f"noise does not add to the residual of {names}: use 'augmented'"))
        return faults

"""The world as every filter of a connected object is told it is."""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from emt.settings import (
    Angle,
    AngleVariance,
    LengthVariance,
    NoiseCovariance,
    PositiveLength,
    Quantity,
    Settings,
    TurnRate,
    TurnRateVariance,
)
from emt.shapes.connected import ConnectedSettings, Name, parameter_faults

Variance = Annotated[float, Quantity("1", ge=0)]


class VarianceSettings(Settings):
    """Variance of every entry of the state, by what it is."""

    length: LengthVariance
    angle: AngleVariance
    rate: TurnRateVariance
    named: dict[Name, Variance] = Field(default_factory=dict)
    """Other variances for single entries, by `NAME` or `NAME_rate`, in SI units."""

    def of(self, shape: ConnectedSettings) -> list[float]:
        """The diagonal of the covariance."""
        found = []
        for name, kind in shape.parameters.items():
            found.append(self.named.get(name, self.length if kind == "length" else self.angle))
            if kind == "angle":
                found.append(self.named.get(f"{name}_rate", self.rate))
        return found


class ConnectedPriorSettings(Settings):
    """What every filter believes before the first scan."""

    lengths: dict[Name, PositiveLength] = Field(default_factory=dict)
    angles: dict[Name, Angle] = Field(default_factory=dict)
    rates: dict[Name, TurnRate] = Field(default_factory=dict)
    """Rates by the name of their angle; 0 where not given."""
    variance: VarianceSettings
    drawn: bool = False
    """Whether each run starts from a mean of its own, drawn from the prior, the same for all filters."""


class ConnectedModelSettings(Settings):
    """A connected object with nearly constant lengths and angular velocities."""

    kind: Literal["connected"]
    shape: ConnectedSettings
    process_variance: VarianceSettings
    """Variance of the noise added per step."""
    noise_cov: NoiseCovariance
    """Covariance of the sensor noise of one point."""
    prior: ConnectedPriorSettings

    @model_validator(mode="after")
    def _fit(self):
        prior, shape = self.prior, self.shape
        faults = [f"prior.{fault}" for fault in parameter_faults(shape, prior.lengths, prior.angles)]
        angles = [name for name, kind in shape.parameters.items() if kind == "angle"]
        faults += [f"prior.rates: '{name}' is no angle of the shape" for name in prior.rates if name not in angles]
        known = {*shape.parameters, *(f"{name}_rate" for name in angles)}
        for key, group in (("process_variance", self.process_variance), ("prior.variance", prior.variance)):
            faults += [f"{key}.named: the state has no '{name}'" for name in group.named if name not in known]
        if not min(prior.variance.of(shape)) > 0.0:
            faults.append("prior.variance: must be positive for every entry of the state")
        if faults:
            raise ValueError("; ".join(faults))
        return self

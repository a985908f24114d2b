"""Settings of the motion of a point and of what a sensor measures of it."""

from typing import Annotated, Any, ClassVar, Literal

import jax
import jax.numpy as jnp
from pydantic import AfterValidator, Field, PositiveInt, StringConstraints, model_validator

from emt.device import configure
from emt.matrices import Matrix, SquareMatrix, check_square
from emt.models.motion import NoiseSettings
from emt.models.state_space.measurements import (
    FunctionMeasurement,
    GrowthMeasurement,
    LinearMeasurement,
    Position,
    RangeBearing,
)
from emt.models.state_space.motions import (
    ConstantTurn,
    ConstantVelocity,
    FunctionMotion,
    Growth,
    LinearMotion,
    SpeedChange,
)
from emt.registry import load_function
from emt.settings import (
    Acceleration,
    Covariance2,
    Length,
    PositiveAngle,
    PositiveFloat,
    PositiveLength,
    Settings,
    TurnRate,
)

Name = Annotated[str, StringConstraints(pattern=r"^[A-Za-z][A-Za-z0-9_]{0,39}$")]
KINEMATIC = ("x", "y", "vx", "vy")


def known_function(reference: str) -> str:
    """A reference `module:function` that can be loaded."""
    configure()  # before the user's module makes its first array
    load_function(reference)
    return reference


FunctionName = Annotated[str, AfterValidator(known_function)]


class PlanarSettings(Settings):
    """What motions of (x, y, vx, vy) have in common."""

    noise: NoiseSettings | None = None
    """Process noise; none by default."""
    states: ClassVar[tuple[str, ...]] = KINEMATIC

    def built_noise(self):
        return None if self.noise is None else self.noise.build()


class ConstantVelocitySettings(PlanarSettings):
    """Constant velocity, or a constant known acceleration."""

    kind: Literal["constant_velocity"] = "constant_velocity"
    acceleration: tuple[Acceleration, Acceleration] = (0.0, 0.0)

    def build(self) -> ConstantVelocity:
        return ConstantVelocity(jnp.asarray(self.acceleration), self.built_noise())


class ConstantTurnSettings(PlanarSettings):
    """A turn at a known rate."""

    kind: Literal["constant_turn"] = "constant_turn"
    rate: TurnRate
    """Anticlockwise."""

    def build(self) -> ConstantTurn:
        return ConstantTurn(self.rate, self.built_noise())


class SpeedChangeSettings(PlanarSettings):
    """A known acceleration along the velocity."""

    kind: Literal["speed_change"] = "speed_change"
    acceleration: Acceleration

    def build(self) -> SpeedChange:
        return SpeedChange(self.acceleration, self.built_noise())


class LinearMotionSettings(Settings):
    """x ← F x + b + v per step."""

    kind: Literal["linear"] = "linear"
    states: tuple[Name, ...]
    """Names of the entries of the state; x, y, z are positions, vx, vy, vz velocities."""
    transition: tuple[tuple[float, ...], ...]
    """F, row by row."""
    offset: tuple[float, ...] | None = None
    """b; zero by default."""
    noise_cov: Annotated[Matrix, SquareMatrix(semidefinite=True)]
    """Covariance of v."""

    @model_validator(mode="after")
    def _fit(self):
        n = len(self.states)
        faults = [*check_names(self.states), *check_square("transition", self.transition, n)]
        faults += check_square("noise_cov", self.noise_cov, n)
        if self.offset is not None and len(self.offset) != n:
            faults.append(f"offset: expected {n} numbers, got {len(self.offset)}")
        if faults:
            raise ValueError("; ".join(faults))
        return self

    def build(self) -> LinearMotion:
        offset = self.offset or (0.0,) * len(self.states)
        return LinearMotion(jnp.asarray(self.transition), jnp.asarray(offset), jnp.asarray(self.noise_cov))


class GammaSettings(Settings):
    """A gamma density of whole shape."""

    shape: PositiveInt
    rate: PositiveFloat


class GrowthSettings(Settings):
    """The growth series of van der Merwe et al. 2000: x ← 1 + sin(ω t) + x/2 + v with gamma noise v."""

    kind: Literal["growth"] = "growth"
    frequency: float = 0.04 * 3.141592653589793
    noise: GammaSettings = GammaSettings(shape=3, rate=2.0)
    """Kalman filters take it as Gaussian with mean 0 and this variance."""
    states: ClassVar[tuple[str, ...]] = ("level",)

    def build(self) -> Growth:
        return Growth(self.frequency, self.noise.rate, self.noise.shape)


class FunctionMotionSettings(Settings):
    """x ← f(x, time, dt) + v with a function of your own, `module:function` beside the configuration."""

    kind: Literal["function"] = "function"
    function: FunctionName
    states: tuple[Name, ...]
    """Names of the entries of the state; x, y, z are positions, vx, vy, vz velocities."""
    noise_cov: Annotated[Matrix, SquareMatrix(semidefinite=True)]

    @model_validator(mode="after")
    def _fit(self):
        n = len(self.states)
        faults = [*check_names(self.states), *check_square("noise_cov", self.noise_cov, n)]
        if faults:
            raise ValueError("; ".join(faults))
        return self

    def build(self) -> FunctionMotion:
        return FunctionMotion(jnp.asarray(self.noise_cov), load_function(self.function))


MotionSettings = Annotated[
    ConstantVelocitySettings
    | ConstantTurnSettings
    | SpeedChangeSettings
    | LinearMotionSettings
    | GrowthSettings
    | FunctionMotionSettings,
    Field(discriminator="kind"),
]


class PositionSettings(Settings):
    """The position in the plane."""

    kind: Literal["position"] = "position"
    noise_cov: Covariance2
    states: ClassVar[tuple[str, ...]] = ("x", "y")
    size: ClassVar[int] = 2

    def build(self) -> Position:
        return Position(jnp.asarray(self.noise_cov))


class RangeBearingSettings(Settings):
    """Range and bearing from a sensor."""

    kind: Literal["range_bearing"] = "range_bearing"
    range_std: PositiveLength
    bearing_std: PositiveAngle
    sensor: tuple[Length, Length] = (0.0, 0.0)
    states: ClassVar[tuple[str, ...]] = ("x", "y")
    size: ClassVar[int] = 2

    def build(self) -> RangeBearing:
        return RangeBearing(jnp.asarray(self.sensor), self.range_std, self.bearing_std)


class LinearMeasurementSettings(Settings):
    """z = H x + w."""

    kind: Literal["linear"] = "linear"
    matrix: tuple[tuple[float, ...], ...]
    """H, row by row."""
    noise_cov: Annotated[Matrix, SquareMatrix()]
    states: ClassVar[tuple[str, ...]] = ()

    @property
    def size(self) -> int:
        return len(self.noise_cov)

    def build(self) -> LinearMeasurement:
        return LinearMeasurement(jnp.asarray(self.matrix), jnp.asarray(self.noise_cov))


class GrowthMeasurementSettings(Settings):
    """What is measured of the growth series: x²/5 until a time, x/2 - 2 from then on."""

    kind: Literal["growth"] = "growth"
    variance: PositiveFloat
    change: float = 30.0
    states: ClassVar[tuple[str, ...]] = ("level",)
    size: ClassVar[int] = 1

    def build(self) -> GrowthMeasurement:
        return GrowthMeasurement(self.variance, self.change)


class FunctionMeasurementSettings(Settings):
    """z = h(x, time) + w with a function of your own, `module:function` beside the configuration."""

    kind: Literal["function"] = "function"
    function: FunctionName
    noise_cov: Annotated[Matrix, SquareMatrix()]
    angles: tuple[bool, ...] = ()
    """Which of the numbers are angles in radians; none by default."""
    states: ClassVar[tuple[str, ...]] = ()

    @property
    def size(self) -> int:
        return len(self.noise_cov)

    @model_validator(mode="after")
    def _fit(self):
        if self.angles and len(self.angles) != self.size:
            raise ValueError(f"angles: expected {self.size} entries, got {len(self.angles)}")
        return self

    def build(self) -> FunctionMeasurement:
        return FunctionMeasurement(jnp.asarray(self.noise_cov), load_function(self.function), self.angles)


MeasurementSettings = Annotated[
    PositionSettings
    | RangeBearingSettings
    | LinearMeasurementSettings
    | GrowthMeasurementSettings
    | FunctionMeasurementSettings,
    Field(discriminator="kind"),
]


def check_names(names: tuple[str, ...]) -> list[str]:
    """What is wrong with the names of a state."""
    if not names:
        return ["states: needs at least one name"]
    return [f"states: '{name}' is given twice" for k, name in enumerate(names) if name in names[:k]]


def measurement_faults(measurement: Any, states: tuple[str, ...]) -> list[str]:
    """What is wrong with a measurement of a state with these names."""
    if states[: len(measurement.states)] != measurement.states:
        return [f"'{measurement.kind}' measures {', '.join(measurement.states)}; the state is {', '.join(states)}"]
    n, m = len(states), measurement.size
    if isinstance(measurement, LinearMeasurementSettings):
        rows = measurement.matrix
        if len(rows) != m or any(len(row) != n for row in rows):
            return [f"matrix: expected {m} rows (as many as noise_cov has) of {n} numbers"]
    if isinstance(measurement, FunctionMeasurementSettings):
        return shape_faults("the measurement function", load_function(measurement.function), (n,), (m,))
    return []


def motion_faults(motion: Any) -> list[str]:
    """What is wrong with a motion that only calling it shows."""
    if not isinstance(motion, FunctionMotionSettings):
        return []
    n, function = len(motion.states), load_function(motion.function)
    return shape_faults("the motion function", lambda x, t: function(x, t, t), (n,), (n,))


def shape_faults(what: str, function: Any, given: tuple[int, ...], expected: tuple[int, ...]) -> list[str]:
    """Whether a function of (state, time) can be traced and returns what it should."""
    arguments = jax.ShapeDtypeStruct(given, jnp.float64), jax.ShapeDtypeStruct((), jnp.float64)
    try:
        found = jax.eval_shape(function, *arguments)
    except Exception as error:  # somebody else's code: whatever it raises is a message
        return [f"{what} cannot be traced by JAX: {type(error).__name__}: {str(error).splitlines()[0]}"]
    shape = getattr(found, "shape", None)
    if shape != expected:
        return [f"{what} returns shape {shape if shape is not None else type(found).__name__}, expected {expected}"]
    return []

"""Strict settings: the base class and the field types that carry a unit.

A field is a bare number in the SI unit of its type, or a text such as ``"50 km/h"``. Which settings class a
mapping becomes is decided by ``kind``, a discriminated union over classes that each fix their own kind:

    class Straight(Settings):
        kind: Literal["straight"] = "straight"
        speed: Speed
        duration: Duration = 10.0

    class Turn(Settings):
        kind: Literal["turn"] = "turn"
        rate: Annotated[float, Quantity("rad/s")]

    Leg = Annotated[Straight | Turn, Field(discriminator="kind")]

    class Course(Settings):
        legs: tuple[Leg, ...]
        position_cov: Covariance2
        labels: dict[str, Leg] = {}

A union over a registry reads ``Annotated[Union[tuple(classes)], Field(discriminator="kind")]``. The file must
name the kind even where the class has a default for it. Counts are pydantic's ``PositiveInt`` and
``NonNegativeInt``; choices are ``Literal``; sequences are tuples, never lists, so that settings hash.
Other units: ``Annotated[float, Quantity("m/s^2", gt=0)]``, ``Annotated[Matrix, Covariance(2, "rad")]``.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, get_args, get_origin

from pydantic import BaseModel, ConfigDict, GetJsonSchemaHandler, model_validator
from pydantic_core import core_schema

from emt.matrices import Covariance, Matrix, Vector
from emt.units import refusal, text_schema, to_si


class Settings(BaseModel):
    """Frozen, strict settings: no unknown key, no text or bool for a number, nothing non-finite.

    Lists become tuples on the way in; an int is accepted where a float is meant. Defaults are checked too.

    Raises:
        TypeError: A subclass declares a list or set field.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False, validate_default=True)

    @model_validator(mode="before")
    @classmethod
    def _lists_to_tuples(cls, data: Any) -> Any:
        return _to_tuples(data)

    @classmethod
    def __pydantic_init_subclass__(cls, **kwargs: Any) -> None:
        super().__pydantic_init_subclass__(**kwargs)
        for name, field in cls.model_fields.items():
            kinds = [get_origin(part) or part for part in _parts(field.annotation)]
            if any(kind is list or kind is set for kind in kinds):
                raise TypeError(f"{cls.__name__}.{name}: declare tuple[...], settings hold no lists or sets")


def reads_points(settings: Settings) -> bool:
    """Whether a filter of these settings reads the points of a scan; else count, mean and scatter are all it needs, and
    its settings say so: `reads_points: ClassVar[bool] = False`."""
    return getattr(settings, "reads_points", True)


class PointSettings(Settings):
    """Settings of a filter of a point."""

    tracks: ClassVar[str] = "state_space"


def _to_tuples(data: Any) -> Any:
    if isinstance(data, dict):
        return {key: _to_tuples(value) for key, value in data.items()}
    if isinstance(data, (list, tuple)):
        return tuple(_to_tuples(value) for value in data)
    return data


def _parts(annotation: Any) -> Iterator[Any]:
    """The annotation, everything it is built from, and the markers in its ``Annotated`` layers."""
    yield annotation
    for argument in get_args(annotation):
        yield from _parts(argument)


@dataclass(frozen=True)
class Quantity:
    """Marks a float as a quantity: ``Annotated[float, Quantity("m/s", ge=0)]``.

    Attributes:
        unit: SI unit of the stored number, made of m, s and rad; ``"1"`` if it has none.
        gt, ge, lt, le: Bounds in that unit.
    """

    unit: str
    gt: float | None = None
    ge: float | None = None
    lt: float | None = None
    le: float | None = None

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> core_schema.CoreSchema:
        number = core_schema.float_schema(
            strict=True, allow_inf_nan=False, gt=self.gt, ge=self.ge, lt=self.lt, le=self.le
        )
        if self.unit == "1":
            return number
        return core_schema.no_info_before_validator_function(self._from_text, number)

    def _from_text(self, value: Any) -> Any:
        if not isinstance(value, str):
            return value
        try:
            return to_si(value, self.unit)
        except ValueError as error:
            raise refusal(str(error)) from None

    def __get_pydantic_json_schema__(self, schema: Any, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        number = dict(handler(schema))
        if self.unit == "1":
            return number
        return {"anyOf": [number, text_schema(self.unit)], "unit": self.unit}


def quantity(
    unit: str,
    gt: float | None = None,
    ge: float | None = None,
    lt: float | None = None,
    le: float | None = None,
) -> Any:
    """``Annotated[float, Quantity(...)]``, for types made at run time; checkers want it written out."""
    return Annotated[float, Quantity(unit, gt, ge, lt, le)]


def vector(n: int, unit: str | tuple[str, ...]) -> Any:
    """``Annotated[tuple[float, ...], Vector(n, unit)]``, for types made at run time."""
    return Annotated[tuple[float, ...], Vector(n, unit)]


def covariance(n: int, unit: str | tuple[str, ...], semidefinite: bool = False) -> Any:
    """``Annotated[Matrix, Covariance(n, unit, semidefinite)]``; the unit is the vector's."""
    return Annotated[Matrix, Covariance(n, unit, semidefinite)]


def field_unit(model: type[BaseModel], name: str) -> str | None:
    """The SI unit of a field, also inside tuples and unions; None if it has none.

    Several units are listed, ``"m, m/s"``; those of a covariance are the units of its variances.
    """
    field = model.model_fields[name]
    units: dict[str, None] = {}
    for part in (*field.metadata, *_parts(field.annotation)):
        if isinstance(part, Quantity):
            units[part.unit] = None
        elif isinstance(part, Vector):
            units |= dict.fromkeys(part.entry_units)
    units.pop("1", None)
    return ", ".join(units) or None


Length = Annotated[float, Quantity("m")]
PositiveLength = Annotated[float, Quantity("m", gt=0)]
NonNegativeLength = Annotated[float, Quantity("m", ge=0)]
Area = Annotated[float, Quantity("m^2", gt=0)]
Speed = Annotated[float, Quantity("m/s")]
Acceleration = Annotated[float, Quantity("m/s^2")]
Angle = Annotated[float, Quantity("rad")]
TurnRate = Annotated[float, Quantity("rad/s")]
Duration = Annotated[float, Quantity("s", gt=0)]
Rate = Annotated[float, Quantity("1/s", gt=0)]
Density = Annotated[float, Quantity("1/m^2", ge=0)]
LengthVariance = Annotated[float, Quantity("m^2", ge=0)]
SpeedVariance = Annotated[float, Quantity("m^2/s^2", ge=0)]
AngleVariance = Annotated[float, Quantity("rad^2", ge=0)]
AccelerationDensity = Annotated[float, Quantity("m^2/s^3", ge=0)]
AccelerationVariance = Annotated[float, Quantity("m^2/s^4", ge=0)]
PositiveFloat = Annotated[float, Quantity("1", gt=0)]
NonNegativeFloat = Annotated[float, Quantity("1", ge=0)]
Fraction = Annotated[float, Quantity("1", ge=0, le=1)]
UnitInterval = Annotated[float, Quantity("1", gt=0, le=1)]

Vector2 = Annotated[tuple[float, ...], Vector(2, "m")]
Vector4 = Annotated[tuple[float, ...], Vector(4, ("m", "m", "m/s", "m/s"))]
Covariance2 = Annotated[Matrix, Covariance(2, "m")]  # position
Covariance3 = Annotated[Matrix, Covariance(3, ("rad", "m", "m"))]  # orientation, semi-axes
Covariance4 = Annotated[Matrix, Covariance(4, ("m", "m", "m/s", "m/s"))]  # position, velocity

PositiveAngle = Annotated[float, Quantity("rad", gt=0)]
PositiveAngleVariance = Annotated[float, Quantity("rad^2", gt=0)]
ShapeParameter = Annotated[float, Quantity("1", gt=1)]  # of an inverse gamma that has a mean
NoiseCovariance = Annotated[Matrix, Covariance(2, "m", semidefinite=True)]
MomentCovariance = Annotated[Matrix, Covariance(3, "m^2")]  # image moments n11, n20, n02
MomentNoise = Annotated[Matrix, Covariance(3, "m^2", semidefinite=True)]
TurnRateVariance = Annotated[float, Quantity("rad^2/s^2", ge=0)]
ShapeNoise = Annotated[Matrix, Covariance(3, ("rad", "m", "m"), semidefinite=True)]
KinematicNoise = Annotated[Matrix, Covariance(4, ("m", "m", "m/s", "m/s"), semidefinite=True)]

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

import math
import re
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Annotated, Any, get_args, get_origin

import numpy as np
from pydantic import BaseModel, ConfigDict, GetJsonSchemaHandler, model_validator
from pydantic_core import PydanticCustomError, core_schema

Matrix = tuple[tuple[float, ...], ...]

_DEFINITIONS = """
meter = [length] = m = metre; second = [time] = s = sec; radian = [angle] = rad
degree = 0.017453292519943295 * radian = deg; turn = 6.283185307179586 * radian = rev = revolution
arcminute = degree / 60 = arcmin; arcsecond = degree / 3600 = arcsec; rpm = turn / minute
minute = 60 * second = min; hour = 3600 * second = h; day = 24 * hour = d; hertz = 1 / second = Hz
inch = 0.0254 * meter = in; foot = 0.3048 * meter = ft = feet; yard = 0.9144 * meter = yd
mile = 1609.344 * meter = mi; nautical_mile = 1852 * meter = nmi; knot = nautical_mile / hour = kn = kt
mph = mile / hour; kph = 1000 * meter / hour = kmh
kilo- = 1000 = k-; centi- = 0.01 = c-; milli- = 1e-3 = m-; micro- = 1e-6 = u- = µ- = μ-; nano- = 1e-9 = n-
"""
_MEANINGS = {
    "m": ("a length", "m, km"),
    "m^2": ("an area", "m^2, cm^2"),
    "m/s": ("a speed", "m/s, km/h"),
    "m^2/s^2": ("a speed variance", "m^2/s^2, km^2/h^2"),
    "m/s^2": ("an acceleration", "m/s^2"),
    "m^2/s^3": ("an acceleration power density", "m^2/s^3"),
    "s": ("a duration", "s, ms, min"),
    "rad": ("an angle", "rad, deg"),
    "rad^2": ("an angle variance", "rad^2, deg^2"),
    "rad/s": ("a turn rate", "rad/s, deg/s"),
    "1/s": ("a rate", "Hz, s^-1"),
    "1/m^2": ("a density", "m^-2, km^-2"),
}
_LONGEST_TEXT = 40
_FACTOR = r"[A-Za-zµμ°]+(?:(?:\^|\*\*)-?[1-9])?"
_TEXT = re.compile(
    r"([-+]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][-+]?\d{1,3})?)\s*"
    rf"({_FACTOR}(?:(?:\s*[*/·]\s*|\s+){_FACTOR})*)",
    re.ASCII,
)


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


def describe(value: Any) -> str:
    """A value in the words of a message: ``the text 'abc'``, ``a list``, ``true``, ``-1``."""
    if isinstance(value, str):
        return f"the text {value if len(value) <= 60 else value[:57] + '...'!r}"
    if value is None or isinstance(value, bool):
        return {None: "nothing", True: "true", False: "false"}[value]
    if isinstance(value, (list, tuple)):
        return "a list"
    if isinstance(value, (Mapping, BaseModel)):
        return "a group of settings"
    return repr(value)[:60]


def to_si(text: str, unit: str) -> float:
    """The number of SI units in a text such as ``"50 km/h"``.

    Args:
        text: A number and a unit, at most 40 characters.
        unit: The SI unit wanted, such as ``"m/s"``.

    Raises:
        ValueError: The text is not a number with a unit, or its unit measures something else.
    """
    meaning, examples = _MEANINGS.get(unit, (f"a quantity in {unit}", unit))
    hint = f"give {examples}, or a bare number in {unit}"
    text = text.strip()
    # Only this narrow form reaches pint, and of it only the unit: no arithmetic, no large exponents.
    match = _TEXT.fullmatch(text[: _LONGEST_TEXT + 1].replace("²", "^2").replace("³", "^3"))
    if match is None or len(text) > _LONGEST_TEXT:
        raise ValueError(f"expected a number, got {describe(text)}; {hint}")
    factor = _factor(match[2].replace("°", "deg").replace("·", "*"), unit)
    if factor is None:
        raise ValueError(f"{text!r} is not {meaning}; {hint}")
    return float(match[1]) * factor


@cache
def _units() -> Any:
    import pint  # only when a text with a unit is met: it is slow to import

    # Not pint's own list: there an angle has no dimension, so '5 percent' would be one.
    units = pint.UnitRegistry(None)  # pyright: ignore[reportArgumentType]
    for line in re.split(r"[;\n]", _DEFINITIONS.strip()):
        units.define(line.strip())
    return units


def _factor(unit: str, wanted: str) -> float | None:
    import pint

    units = _units()
    try:
        return float(units.Quantity(1.0, units.parse_units(unit)).to(units.parse_units(wanted)).magnitude)
    except (pint.PintError, ArithmeticError):
        return None


def _number(value: Any, unit: str) -> float:
    """A finite float in the unit, or a ValueError in the user's terms."""
    if isinstance(value, str) and unit != "1":
        value = to_si(value, unit)
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise ValueError(f"expected a number, got {describe(value)}")
    if not math.isfinite(value):
        raise ValueError(f"must be finite, got {value}")
    return float(value)


def _refusal(message: str) -> PydanticCustomError:
    return PydanticCustomError("settings", "{message}", {"message": message})


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
            raise _refusal(str(error)) from None

    def __get_pydantic_json_schema__(self, schema: Any, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        number = dict(handler(schema))
        if self.unit == "1":
            return number
        return {"anyOf": [number, _text_schema(self.unit)], "unit": self.unit}


def _text_schema(unit: str) -> dict[str, Any]:
    return {"type": "string", "maxLength": _LONGEST_TEXT, "description": f"number and unit, see {unit}"}


@dataclass(frozen=True)
class Vector:
    """Marks ``tuple[float, ...]`` as a vector of fixed length.

    Attributes:
        n: Number of entries.
        unit: SI unit of every entry, or one per entry.
    """

    n: int
    unit: str | tuple[str, ...]

    @property
    def axes(self) -> tuple[str, ...]:
        """Unit of each axis of the space."""
        return (self.unit,) * self.n if isinstance(self.unit, str) else self.unit

    @property
    def entry_units(self) -> tuple[str, ...]:
        """The different units among the entries, in order of appearance."""
        return tuple(dict.fromkeys(self.axes))

    def __post_init__(self) -> None:
        if len(self.axes) != self.n:
            raise ValueError(f"{self.n} entries need {self.n} units, got {len(self.axes)}")

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> core_schema.CoreSchema:
        def checked(value: Any) -> Any:
            try:
                return self.check(value)
            except ValueError as error:
                raise _refusal(str(error)) from None

        return core_schema.no_info_plain_validator_function(checked)

    def check(self, value: Any) -> Any:
        """The vector as a tuple of floats.

        Raises:
            ValueError: Not a list of n finite numbers (or texts with a unit).
        """
        return _numbers(value, self.axes, "")

    def _row_schema(self) -> dict[str, Any]:
        entry = {"anyOf": [{"type": "number"}, {"type": "string", "maxLength": _LONGEST_TEXT}]}
        return {"type": "array", "items": entry, "minItems": self.n, "maxItems": self.n}

    def __get_pydantic_json_schema__(self, schema: Any, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        return {**self._row_schema(), "unit": ", ".join(self.entry_units)}


def _numbers(value: Any, units: tuple[str, ...], where: str) -> tuple[float, ...]:
    if not isinstance(value, (list, tuple)):
        raise ValueError(f"{where}expected a list of {len(units)} numbers, got {describe(value)}")
    if len(value) != len(units):
        raise ValueError(f"{where}expected {len(units)} numbers, got {len(value)}")
    numbers, faults = [], []
    for i, (entry, unit) in enumerate(zip(value, units, strict=True)):
        try:
            numbers.append(_number(entry, unit))
        except ValueError as error:
            faults.append(f"{where}entry [{i}]: {error}")
    if faults:
        raise ValueError("; ".join(faults))
    return tuple(numbers)


@dataclass(frozen=True)
class Covariance(Vector):
    """Marks ``Matrix`` as the covariance of a vector: symmetric and positive definite.

    Accepts n rows of n numbers, a flat list of n variances, or ``{diagonal: [...]}`` with n variances.

    Attributes:
        n: Number of rows.
        unit: SI unit of the vector (not of the matrix), or one per axis; entries carry the product of two.
        semidefinite: Also accept a singular matrix, as process noise may be.
    """

    semidefinite: bool = False

    @property
    def entry_units(self) -> tuple[str, ...]:
        """The different units on the diagonal, in order of appearance."""
        return tuple(dict.fromkeys(_product(unit, unit) for unit in self.axes))

    def check(self, value: Any) -> Matrix:
        """The covariance as rows of floats, as given: never symmetrised or repaired.

        Raises:
            ValueError: Wrong shape, entries that are no finite numbers, not symmetric, not definite.
        """
        n, axes = self.n, self.axes
        if isinstance(value, Mapping):
            if set(value) != {"diagonal"}:
                raise ValueError(f"expected {n} rows of {n} numbers or only the key 'diagonal'")
            value = value["diagonal"]
            if isinstance(value, (list, tuple)) and any(isinstance(row, (list, tuple)) for row in value):
                raise ValueError(f"diagonal: expected {n} numbers, got rows")
        if not isinstance(value, (list, tuple)):
            raise ValueError(f"expected {n} rows of {n} numbers or {n} variances, got {describe(value)}")
        if not any(isinstance(row, (list, tuple)) for row in value):
            variances = _numbers(value, tuple(_product(unit, unit) for unit in axes), "variances: ")
            matrix = tuple(tuple(v if i == j else 0.0 for j in range(n)) for i, v in enumerate(variances))
        else:
            if len(value) != n:
                raise ValueError(f"expected {n} rows of {n} numbers, got {len(value)} rows")
            matrix, faults = (), []
            for i, row in enumerate(value):
                try:
                    units = tuple(_product(axes[i], unit) for unit in axes)
                    matrix += (_numbers(row, units, f"row [{i}]: "),)
                except ValueError as error:
                    faults.append(str(error))
            if faults:
                raise ValueError("; ".join(faults))
        _check_covariance(matrix, self.semidefinite)
        return matrix

    def __get_pydantic_json_schema__(self, schema: Any, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        row = self._row_schema()
        rows = {"type": "array", "items": row, "minItems": self.n, "maxItems": self.n}
        diagonal = {
            "type": "object",
            "properties": {"diagonal": row},
            "required": ["diagonal"],
            "additionalProperties": False,
        }
        return {"anyOf": [rows, row, diagonal], "unit": ", ".join(self.entry_units)}


def _check_covariance(matrix: Matrix, semidefinite: bool) -> None:
    n = len(matrix)
    for i in range(n):
        for j in range(i):
            a, b = matrix[i][j], matrix[j][i]
            if abs(a - b) > 1e-12 * max(abs(a), abs(b)):
                raise ValueError(f"not symmetric: entries [{i}][{j}] = {a} and [{j}][{i}] = {b} differ")
    variances = np.array([matrix[i][i] for i in range(n)])
    for i, variance in enumerate(variances):
        if variance < 0 or (variance == 0 and not semidefinite):
            bound = "at least 0" if semidefinite else "greater than 0"
            raise ValueError(f"variance [{i}][{i}] must be {bound}, got {variance}")
    for i, j in np.argwhere((variances[:, None] == 0) & (np.array(matrix) != 0)):
        raise ValueError(f"variance [{i}][{i}] is 0, so entry [{i}][{j}] must be 0, got {matrix[i][j]}")
    # Definiteness does not depend on units, so it is judged on the correlations.
    spread = np.sqrt(np.where(variances > 0, variances, 1.0))
    with np.errstate(over="ignore"):
        correlations = np.array(matrix) / spread[:, None] / spread[None, :]
    # No Cauchy-Schwarz, no covariance; and a huge ratio would overflow the eigenvalues.
    bounded = bool((np.abs(correlations) <= 1.0 + 1e-12).all())
    smallest = float(np.linalg.eigvalsh(correlations)[0]) if bounded else -1.0
    if smallest < -1e-12 if semidefinite else smallest <= n * np.finfo(float).eps:
        scale = float(np.abs(matrix).max())
        eigenvalue = scale * float(np.linalg.eigvalsh(np.array(matrix) / scale)[0])
        if abs(eigenvalue) < 1e-12 * scale:
            eigenvalue = 0.0
        kind = "semidefinite" if semidefinite else "definite"
        raise ValueError(f"not positive {kind}: the smallest eigenvalue is {eigenvalue:.6g}")


def _product(a: str, b: str) -> str:
    powers: Counter[str] = Counter()
    for unit in (a, b):
        for slash, name, power in re.findall(r"(/?)([a-z]+)(?:\^(\d))?", unit):
            powers[name] += int(power or 1) * (-1 if slash else 1)
    above = "*".join(name + (f"^{p}" if p > 1 else "") for name, p in powers.items() if p > 0)
    below = "".join(f"/{name}" + (f"^{-p}" if p < -1 else "") for name, p in powers.items() if p < 0)
    return (above or "1") + below


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
ShapeNoise = Annotated[Matrix, Covariance(3, ("rad", "m", "m"), semidefinite=True)]
KinematicNoise = Annotated[Matrix, Covariance(4, ("m", "m", "m/s", "m/s"), semidefinite=True)]

"""Numbers with units in texts, and how values are named in messages."""

import math
import re
from collections.abc import Mapping
from functools import cache
from typing import Any

from pydantic import BaseModel
from pydantic_core import PydanticCustomError

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
    "rad^2/s^2": ("a turn rate variance", "rad^2/s^2, deg^2/s^2"),
    "m^2/s^4": ("an acceleration variance", "m^2/s^4"),
    "rad^2/s^4": ("a turn acceleration variance", "rad^2/s^4, deg^2/s^4"),
    "m^4": ("a variance of moments", "m^4, cm^4"),
    "1/s": ("a rate", "Hz, s^-1"),
    "1/m^2": ("a density", "m^-2, km^-2"),
}
LONGEST_TEXT = 40
_FACTOR = r"[A-Za-zµμ°]+(?:(?:\^|\*\*)-?[1-9])?"
_TEXT = re.compile(
    r"([-+]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][-+]?\d{1,3})?)\s*"
    rf"({_FACTOR}(?:(?:\s*[*/·]\s*|\s+){_FACTOR})*)",
    re.ASCII,
)


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
    match = _TEXT.fullmatch(text[: LONGEST_TEXT + 1].replace("²", "^2").replace("³", "^3"))
    if match is None or len(text) > LONGEST_TEXT:
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


def number(value: Any, unit: str) -> float:
    """A finite float in the unit, or a ValueError in the user's terms."""
    if isinstance(value, str) and unit != "1":
        value = to_si(value, unit)
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise ValueError(f"expected a number, got {describe(value)}")
    if not math.isfinite(value):
        raise ValueError(f"must be finite, got {value}")
    return float(value)


def refusal(message: str) -> PydanticCustomError:
    """A validation error with this message and nothing around it."""
    return PydanticCustomError("settings", "{message}", {"message": message})


def text_schema(unit: str) -> dict[str, Any]:
    """JSON Schema of a number and unit in a text."""
    return {"type": "string", "maxLength": LONGEST_TEXT, "description": f"number and unit, see {unit}"}

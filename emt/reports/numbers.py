"""How numbers are printed: values to the digit their uncertainty supports."""

import math


def significant(value: float, digits: int = 3) -> str:
    """A number in plain notation with about this many significant digits."""
    if value == 0.0 or not math.isfinite(value):
        return f"{value:g}"
    magnitude = math.floor(math.log10(abs(value)))
    if magnitude >= 7 or magnitude < -5:
        return f"{value:.{digits - 1}e}"
    return f"{value:.{max(digits - 1 - magnitude, 0)}f}"


def decimals_for(error: float) -> int:
    """Decimals that show an uncertainty to two significant digits."""
    if error <= 0.0 or not math.isfinite(error):
        return 3
    return min(max(1 - math.floor(math.log10(error)), 0), 9)


def value_and_error(value: float | None, error: float | None) -> tuple[str, str]:
    """A value and its standard error, both to two significant digits of the error."""
    if value is None:
        return "–", ""
    if error is None or error <= 1e-9 * abs(value):
        return significant(value, 4), ""
    if abs(value) >= 1e7:
        return f"{value:.1e}", f"{error:.1e}"
    decimals = decimals_for(error)
    return f"{value:.{decimals}f}", f"{error:.{decimals}f}"


def unit_text(unit: str, length_unit: str) -> str:
    """The unit of a metric with the experiment's length unit put in; empty for pure numbers."""
    return "" if unit == "1" else unit.replace("L", length_unit)

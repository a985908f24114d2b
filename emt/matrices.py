"""Vectors and covariances in settings, checked: length, symmetry, definiteness, a unit per axis."""

import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydantic import GetJsonSchemaHandler
from pydantic_core import core_schema

from emt.units import LONGEST_TEXT, describe, number, refusal

Matrix = tuple[tuple[float, ...], ...]


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
                raise refusal(str(error)) from None

        return core_schema.no_info_plain_validator_function(checked)

    def check(self, value: Any) -> Any:
        """The vector as a tuple of floats.

        Raises:
            ValueError: Not a list of n finite numbers (or texts with a unit).
        """
        return _numbers(value, self.axes, "")

    def _row_schema(self) -> dict[str, Any]:
        entry = {"anyOf": [{"type": "number"}, {"type": "string", "maxLength": LONGEST_TEXT}]}
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
            numbers.append(number(entry, unit))
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


@dataclass(frozen=True)
class SquareMatrix:
    """Marks ``Matrix`` as a covariance whose size and units the settings around it fix: numbers in SI units.

    Accepts what ``Covariance`` does.
    """

    semidefinite: bool = False

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> core_schema.CoreSchema:
        def checked(value: Any) -> Any:
            given = value["diagonal"] if isinstance(value, Mapping) and set(value) == {"diagonal"} else value
            n = len(given) if isinstance(given, (list, tuple)) else 0
            if n == 0:
                raise refusal(f"expected rows of numbers or a list of variances, got {describe(value)}")
            try:
                return Covariance(n, "1", self.semidefinite).check(value)
            except ValueError as error:
                raise refusal(str(error)) from None

        return core_schema.no_info_plain_validator_function(checked)

    def __get_pydantic_json_schema__(self, schema: Any, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        row = {"type": "array", "items": {"type": "number"}}
        diagonal = {
            "type": "object",
            "properties": {"diagonal": row},
            "required": ["diagonal"],
            "additionalProperties": False,
        }
        return {"anyOf": [{"type": "array", "items": row}, row, diagonal]}


def check_square(name: str, rows: Matrix, n: int) -> list[str]:
    """What is wrong with the shape of a matrix that should be n by n."""
    if len(rows) == n and all(len(row) == n for row in rows):
        return []
    return [f"{name}: expected {n} rows of {n} numbers, got {len(rows)} rows of {', '.join(str(len(r)) for r in rows)}"]


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

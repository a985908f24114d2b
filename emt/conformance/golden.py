"""Golden vectors: files of inputs and outputs of other implementations, compared with emt's own functions."""

import json
import math
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from emt.registry import suggest
from emt.scans import as_scan
from emt.types import Measurements

MAX_BYTES = 64 << 20
DEFAULT_TOLERANCE = 1e-9


class GoldenError(Exception):
    """A golden file that cannot be used; the message names the file and what is wrong."""


class Quantity(NamedTuple):
    """One compared number or array of one case."""

    name: str
    got: Any
    expected: Any
    scale: float | None = None
    """What the error is relative to; by default the largest magnitude of the expected array."""
    tolerance: float | None = None
    """Own tolerance of this quantity; by default that of the file."""


class Row(NamedTuple):
    """Worst errors of one quantity over the cases of a file."""

    quantity: str
    cases: int
    absolute: float
    relative: float
    tolerance: float

    @property
    def passed(self) -> bool:
        return self.relative <= self.tolerance


class Kind(NamedTuple):
    """How a kind of golden file is run."""

    compare: Callable[..., Iterable[Quantity]]
    tolerance: float
    needs_data: bool = False


def read_golden(path: Path) -> dict[str, Any]:
    """A golden file as a dictionary.

    Raises:
        GoldenError: missing, too large, not JSON, or without a `kind`.
    """
    try:
        if path.stat().st_size > MAX_BYTES:
            raise GoldenError(f"{path}: larger than {MAX_BYTES >> 20} MiB")
        content = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise GoldenError(f"{path}: cannot be read: {error.strerror or error}") from error
    except (ValueError, RecursionError) as error:
        raise GoldenError(f"{path}: not valid JSON: {error}") from error
    if not isinstance(content, dict) or not isinstance(content.get("kind"), str):
        raise GoldenError(f"{path}: kind: is required: the name of the kind of golden vectors")
    return content


def verify(path: Path, kinds: Mapping[str, Kind], data: Path | None = None) -> list[Row]:
    """Runs one golden file and returns the worst errors per quantity.

    Raises:
        GoldenError: the file is of an unknown kind, lacks a field, or needs data that was not given.
    """
    content = read_golden(path)
    name = content["kind"]
    if name not in kinds:
        near = suggest(name, kinds)
        hint = f" (did you mean '{near}'?)" if near else ""
        raise GoldenError(f"{path}: kind: unknown kind '{name}'{hint}; known: {', '.join(sorted(kinds))}")
    kind = kinds[name]
    if kind.needs_data and data is None:
        raise GoldenError(f"{path}: kind '{name}' compares with a recording: give it with --data PATH")
    tolerance = content.get("tolerance", kind.tolerance)
    tolerance = tolerance if isinstance(tolerance, float) else kind.tolerance
    try:
        quantities = list(kind.compare(content, data) if kind.needs_data else kind.compare(content))
    except KeyError as error:
        raise GoldenError(f"{path}: {error.args[0]}: is required by kind '{name}'") from error
    except (TypeError, ValueError, IndexError) as error:
        raise GoldenError(f"{path}: not usable as kind '{name}': {error}") from error
    if not quantities:
        raise GoldenError(f"{path}: holds no case")
    return summarise(quantities, tolerance)


def summarise(quantities: list[Quantity], tolerance: float) -> list[Row]:
    """Worst errors by quantity name and tolerance, in order of first appearance."""
    rows: dict[tuple[str, float], Row] = {}
    for quantity in quantities:
        got, expected = np.asarray(quantity.got, float), np.asarray(quantity.expected, float)
        if got.shape != expected.shape:
            raise ValueError(f"{quantity.name}: shape {expected.shape} in the file, {got.shape} computed")
        absolute = float(np.max(np.abs(got - expected), initial=0.0))
        absolute = absolute if math.isfinite(absolute) else math.inf
        scale = float(np.max(np.abs(expected), initial=0.0)) if quantity.scale is None else quantity.scale
        relative = absolute / scale if scale > 0.0 else (0.0 if absolute == 0.0 else math.inf)
        limit = tolerance if quantity.tolerance is None else quantity.tolerance
        old = rows.get((quantity.name, limit), Row(quantity.name, 0, 0.0, 0.0, limit))
        rows[quantity.name, limit] = Row(
            quantity.name, old.cases + 1, max(old.absolute, absolute), max(old.relative, relative), limit
        )
    return list(rows.values())


def array(values: Any) -> Array:
    """A float64 array of nested lists."""
    return jnp.asarray(np.asarray(values, dtype=np.float64))


def scan_of(points: Any, capacity: int) -> Measurements:
    """A padded scan of the listed points."""
    return as_scan(array(points).reshape(-1, 2), capacity)


def largest_scan(content: Mapping[str, Any]) -> int:
    """Capacity that fits every scan of the file, so that one compilation serves all cases."""
    cases = [*content.get("cases", []), *(step for s in content.get("sequences", []) for step in s["steps"])]
    return max([1, *(len(case["y"]) for case in cases)])


def check_position_measurement(matrix: Any) -> None:
    """emt's trackers measure the position: any other measurement matrix cannot be compared."""
    h = np.asarray(matrix, float)
    if not np.array_equal(h, np.eye(2, h.shape[1])):
        raise ValueError("only H = [I 0] can be compared")


def time_step(transition: Any) -> float:
    """T of a constant-velocity transition matrix [I, T I; 0, I]."""
    f = np.asarray(transition, float)[:4, :4]
    dt = float(f[0, 2])
    if not np.array_equal(f, np.eye(4) + dt * np.eye(4, k=2)):
        raise ValueError("only the constant-velocity transition [I, T I; 0, I] can be compared")
    return dt

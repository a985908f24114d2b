"""What is tuned: numbers of a configuration file, named by their keys, and the scale on which each is searched."""

import copy
import itertools
import math
import re
from collections.abc import Iterator, Sequence
from typing import Any, Literal, NamedTuple

from emt.config.errors import COMMAND_LINE, ConfigError, KeyPath, Problem, dotted
from emt.config.load import Loaded, check
from emt.config.overrides import parse_key
from emt.config.source import Source, plain_scalar
from emt.registry import suggest

TUNABLE = ("filters", "model")
"""Sections whose numbers do not change the data."""
DEFAULT_FACTORS = (0.1, 10.0**-0.5, 1.0, 10.0**0.5, 10.0)
"""Grid about the configuration's value where none is asked for."""
DEFAULT_COUNT = 7
MOST_CANDIDATES = 10_000
DIGITS = 4
"""Significant digits of a tuned number."""
_WITH_UNIT = re.compile(r"([-+]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][-+]?\d{1,3})?)(\s*\D.*)")


class Parameter(NamedTuple):
    """A number that is tuned."""

    name: str
    """Dotted key, with `*` where several keys share the number."""
    paths: tuple[KeyPath, ...]
    """Keys that get its value."""
    start: Any
    """Value in the file, in the unit used there; text for a choice on a grid."""
    unit: str
    """Unit as written in the file, with the blank before it; empty for a bare number."""
    bounds: tuple[float, float] | None
    values: tuple[Any, ...] | None
    """What a grid tries."""

    @property
    def scale(self) -> Literal["log", "linear"]:
        """Positive numbers are searched on a logarithmic scale."""
        return "log" if (self.bounds[0] if self.bounds else self.start) > 0.0 else "linear"

    def value(self, theta: float) -> float:
        """The number at an unconstrained coordinate: exp θ or θ, squeezed between the bounds by a sigmoid."""
        if self.bounds is not None:
            low, high = map(self._along, self.bounds)
            theta = low + (high - low) / (1.0 + math.exp(-theta))
        return math.exp(theta) if self.scale == "log" else theta

    def theta(self, value: float) -> float:
        """The coordinate of a number; one on a bound starts just inside."""
        along = self._along(value)
        if self.bounds is None:
            return along
        low, high = map(self._along, self.bounds)
        share = min(max((along - low) / (high - low), 1e-3), 1.0 - 1e-3)
        return math.log(share / (1.0 - share))

    def _along(self, value: float) -> float:
        return math.log(value) if self.scale == "log" else value

    def text(self, value: Any) -> Any:
        """The value as it stands in the file, with its unit."""
        return f"{value!r}{self.unit}" if self.unit else value


def parse_parameters(texts: Sequence[str], loaded: Loaded, grid: bool) -> list[Parameter]:
    """Parameters named by `KEY`, `KEY=LOW:HIGH[:COUNT]` or, for a grid, `KEY=VALUE,VALUE,...`.

    A key that holds several numbers stands for each of them. A `*` in a key stands for every name at its place, and
    numbers found under several names are then tuned as one.

    Raises:
        ConfigError: with every text that cannot be used.
    """
    parameters: list[Parameter] = []
    problems: list[Problem] = []
    for text in texts:
        key, equals, wanted = text.partition("=")
        try:
            found = list(_parameters_at(key.strip(), loaded.source.data))
            parameters += [_with_range(parameter, wanted if equals else None, grid) for parameter in found]
        except ValueError as error:
            problems.append(Problem(COMMAND_LINE, None, key.strip(), str(error)))
    seen: dict[KeyPath, str] = {}
    for parameter in parameters:
        for path in parameter.paths:
            if path in seen:
                problems.append(Problem(COMMAND_LINE, None, dotted(path), "is named twice"))
            seen[path] = parameter.name
    if problems:
        raise ConfigError(problems)
    return parameters


def label_of(parameters: Sequence[Parameter], wanted: str | None, loaded: Loaded) -> str:
    """The filter that is tuned: the one whose settings are named, or the one asked for.

    Raises:
        ConfigError: it is not clear which, or there is none of that name.
    """
    labels = list(loaded.experiment.filters)
    named = {str(path[1]) for parameter in parameters for path in parameter.paths if path[0] == "filters"}
    if wanted is not None and wanted not in labels:
        near = suggest(wanted, labels)
        hint = f" (did you mean '{near}'?)" if near else ""
        raise ConfigError([Problem(COMMAND_LINE, None, "--filter", f"no filter '{wanted}'{hint}; {', '.join(labels)}")])
    chosen = named or ({wanted} if wanted else set(labels) if len(labels) == 1 else set())
    if len(chosen) != 1 or (wanted is not None and chosen != {wanted}):
        given = ", ".join(sorted(named | ({wanted} if wanted else set()))) or "none"
        message = f"one filter is tuned at a time; named: {given}, known: {', '.join(labels)} (--filter chooses one)"
        raise ConfigError([Problem(COMMAND_LINE, None, "", message)])
    return chosen.pop()


def candidate(loaded: Loaded, parameters: Sequence[Parameter], values: Sequence[Any]) -> Loaded:
    """The experiment with other numbers.

    Raises:
        ConfigError: a value is not valid for its key.
    """
    data: Any = copy.deepcopy(loaded.source.data)
    for parameter, value in zip(parameters, values, strict=True):
        for path in parameter.paths:
            here = data
            for part in path[:-1]:
                here = here[part]
            here[path[-1]] = parameter.text(value)
    source = Source(loaded.source.path, data, loaded.source.places)
    return Loaded(loaded.name, check(source, loaded.source.path), source)


def combinations(parameters: Sequence[Parameter]) -> list[tuple[Any, ...]]:
    """Every point of the grid.

    Raises:
        ConfigError: there are too many.
    """
    count = math.prod(len(parameter.values or ()) for parameter in parameters)
    if count > MOST_CANDIDATES:
        message = f"the grid has {count} points, at most {MOST_CANDIDATES} are tried; give fewer values per key"
        raise ConfigError([Problem(COMMAND_LINE, None, "", message)])
    return list(itertools.product(*(parameter.values or () for parameter in parameters)))


def rounded(value: Any) -> Any:
    """A number to the digits that are written; anything else as it is."""
    return float(f"{value:.{DIGITS}g}") if isinstance(value, float) else value


def _parameters_at(key: str, data: Any) -> Iterator[Parameter]:
    pattern = parse_key(key)
    if pattern[0] not in TUNABLE:
        raise ValueError(f"only settings under {' and '.join(TUNABLE)} can be tuned; others change the data")
    tied: dict[tuple[Any, ...], list[KeyPath]] = {}
    for path in _matches(data, pattern, ()):
        for leaf in _leaves(_at(data, path), path):
            tied.setdefault(leaf[len(path) :], []).append(leaf)
    if not tied:
        raise ValueError("holds no number")
    for rest, paths in tied.items():
        values = {str(_at(data, path)) for path in paths}
        if len(values) > 1:
            raise ValueError(f"the numbers to tie differ ({', '.join(sorted(values))}); make them equal first")
        value = _at(data, paths[0])
        split = _WITH_UNIT.fullmatch(value) if isinstance(value, str) else None
        name = dotted((*pattern, *rest)).replace("'*'", "*")
        start, unit = (float(split[1]), split[2]) if split else (value, "")
        yield Parameter(name, tuple(paths), start, unit, None, None)


def _at(data: Any, path: tuple[Any, ...]) -> Any:
    for part in path:
        data = data[part]
    return data


def _matches(data: Any, pattern: tuple[Any, ...], path: tuple[Any, ...]) -> Iterator[KeyPath]:
    """Paths in the data that fit a pattern with `*`."""
    if not pattern:
        yield path
        return
    part, rest = pattern[0], pattern[1:]
    if isinstance(data, list) and isinstance(part, str) and part.isdecimal():
        part = int(part)
    names: list[Any] = list(data if isinstance(data, dict) else range(len(data)) if isinstance(data, list) else ())
    found = names if part == "*" else [part] if part in names else []
    if not found:
        near = suggest(str(part), map(str, names))
        hint = f" (did you mean '{near}'?)" if near else ""
        known = f"; given there: {', '.join(map(str, names))} (--set KEY=VALUE gives more)" if names else ""
        raise ValueError(f"'{dotted(path) or 'the file'}' gives no '{part}'{hint}{known}")
    for name in found:
        yield from _matches(_at(data, (name,)), rest, (*path, name))


def _leaves(value: Any, path: tuple[Any, ...]) -> Iterator[KeyPath]:
    """Every number below a value; the value itself, whatever it is, if nothing is below it."""
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else None
    if items is None:
        yield path
        return
    for name, item in items:
        is_number = isinstance(item, (int, float)) and not isinstance(item, bool)
        if isinstance(item, (dict, list)) or is_number or (isinstance(item, str) and _WITH_UNIT.fullmatch(item)):
            yield from _leaves(item, (*path, name))


def _with_range(parameter: Parameter, wanted: str | None, grid: bool) -> Parameter:
    start = parameter.start
    is_number = isinstance(start, (int, float)) and not isinstance(start, bool)
    if wanted is None:
        if not is_number:
            raise ValueError(f"is {start!r}, not a number" + ("; give values: KEY=A,B" if grid else ""))
        if not grid:
            return parameter._replace(start=float(start))
        if start <= 0:
            raise ValueError(f"is {start:g}, not positive: give LOW:HIGH or values")
        return parameter._replace(values=tuple(rounded(float(start) * factor) for factor in DEFAULT_FACTORS))
    if ":" not in wanted:
        if not grid:
            raise ValueError("a gradient search takes KEY or KEY=LOW:HIGH; values are for --method grid")
        values = tuple(plain_scalar(text.strip()) for text in wanted.split(","))
        return parameter._replace(values=values)
    if not is_number:
        raise ValueError(f"is {start!r}, not a number")
    try:
        low, high = (float(text) for text in wanted.split(":")[:2])
        count = int(wanted.split(":")[2]) if wanted.count(":") == 2 else DEFAULT_COUNT
    except (ValueError, IndexError):
        raise ValueError(f"expected LOW:HIGH or LOW:HIGH:COUNT, got '{wanted}'") from None
    if not (math.isfinite(low) and math.isfinite(high) and low < high and count >= 2 and wanted.count(":") <= 2):
        raise ValueError(f"expected LOW < HIGH and a COUNT of at least 2, got '{wanted}'")
    bounded = parameter._replace(start=float(start), bounds=(low, high))
    if not grid:
        if not low <= start <= high:
            raise ValueError(f"the search starts from the file's value {start:g}, which is outside {wanted}")
        return bounded
    along = [bounded._along(low) + k * (bounded._along(high) - bounded._along(low)) / (count - 1) for k in range(count)]
    return bounded._replace(values=tuple(rounded(math.exp(a) if bounded.scale == "log" else a) for a in along))

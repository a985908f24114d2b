"""Settings changed on the command line: ``filters.vb.iterations=3``."""

import copy
import re
from collections.abc import Iterable
from typing import Any

from emt.config.errors import COMMAND_LINE, ConfigError, KeyPath, Problem, dotted
from emt.config.source import Place, Source, parse_document
from emt.units import describe

_NAME = re.compile(r"[^\s.\[\]=]+")
_INDEX = re.compile(r"\[(\d{1,6})\]", re.ASCII)
_POSITION = re.compile(r"\d{1,6}", re.ASCII)


def apply_overrides(source: Source, overrides: Iterable[str]) -> Source:
    """A source with some values replaced; the given one is left alone.

    A key is dotted; a list entry is ``legs.0.steps`` or ``legs[0].steps``. A value is YAML on one line: a
    number, a text, ``[a, b]``, ``{a: 1}``. A key that is not there yet is created, to be validated like the
    file.

    Args:
        source: What the file holds.
        overrides: Texts ``key=value``, applied in order.

    Raises:
        ConfigError: With every override that cannot be read or applied, or that undoes an earlier one.
    """
    data: Any = copy.deepcopy(source.data)
    places = dict(source.places)
    problems: list[Problem] = []
    done: list[KeyPath] = []
    for override in overrides:
        key, _, _ = override.partition("=")
        try:
            wanted, value = parse_override(override)
            path = _assign(data, wanted, value)
            undone = next((earlier for earlier in done if earlier[: len(path)] == path), None)
            if undone is not None:
                raise ValueError(f"undoes the earlier override of {dotted(undone)}; give only one of them")
        except ValueError as error:
            problems.append(Problem(COMMAND_LINE, None, key.strip(), str(error)))
            continue
        done.append(path)
        for known in [known for known in places if known[: len(path)] == path]:
            del places[known]
        # Sections made on the way were given on the command line too.
        for length in range(1, len(path) + 1):
            places.setdefault(path[:length], Place(COMMAND_LINE, None))
    if problems:
        raise ConfigError(problems)
    return Source(source.path, data, places)


def parse_override(override: str) -> tuple[KeyPath, Any]:
    """Key path and value of ``key=value``; list positions may still be digits in a text.

    Raises:
        ValueError: No ``=``, no key, a malformed key, or a value that is not one YAML value on one line.
    """
    key, equals, text = override.partition("=")
    if not equals:
        raise ValueError("expected key=value")
    path = parse_key(key)
    if not text.strip():
        raise ValueError("no value given; write key=null for nothing, key='' for an empty text")
    try:
        document = parse_document(text, COMMAND_LINE)
    except ConfigError as error:
        faults = [f"{problem.key}: {problem.message}".removeprefix(": ") for problem in error.problems]
        raise ValueError("; ".join(faults)) from None
    if document is None or text[document.end :].strip():
        raise ValueError("the value reads as a comment from '#' on; put it in quotes")
    if isinstance(document.value, (dict, list)) and not document.flow:
        raise ValueError("write lists as [a, b] and groups as {a: 1}, or put a text in quotes")
    return path, document.value


def parse_key(key: str) -> KeyPath:
    """``legs[0].steps`` as ``("legs", 0, "steps")``; ``legs.0`` keeps the text ``"0"``.

    Raises:
        ValueError: The key is empty or malformed.
    """
    key = key.strip()
    if not key:
        raise ValueError("no key given; expected key=value")
    path: list[str | int] = []
    rest = key
    while rest:
        match = _NAME.match(rest)
        if match is None:
            raise ValueError(f"malformed key {key!r}; write it like filters.vb.iterations or legs[0].steps")
        path.append(match[0])
        rest = rest[match.end() :]
        while index := _INDEX.match(rest):
            path.append(int(index[1]))
            rest = rest[index.end() :]
        if rest.startswith(".") and len(rest) > 1:
            rest = rest[1:]
        elif rest:
            raise ValueError(f"malformed key {key!r}; write it like filters.vb.iterations or legs[0].steps")
    return tuple(path)


def _assign(data: Any, wanted: KeyPath, value: Any) -> KeyPath:
    """Sets a value in place; returns its path with list positions as numbers."""
    path: list[str | int] = []
    here: Any = data
    for i, part in enumerate(wanted):
        is_last = i == len(wanted) - 1
        where = dotted(path)
        if isinstance(here, list):
            if not isinstance(part, int) and not _POSITION.fullmatch(part):
                raise ValueError(f"{where} is a list; give a position such as {where}[0]")
            position = part = int(part)
            if position >= len(here):
                raise ValueError(f"{where} has {len(here)} entries, the last is [{len(here) - 1}]")
        elif isinstance(here, dict):
            if isinstance(part, int):
                raise ValueError(f"{where} is not a list")
            if not is_last and here.get(part) is None:
                here[part] = {}
        else:
            raise ValueError(f"{where} is {describe(here)}, it has no settings inside")
        path.append(part)
        container: Any = here
        if is_last:
            container[part] = value
        else:
            here = container[part]
    return tuple(path)

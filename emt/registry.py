"""Names and what they build: built-in kinds, installed plug-ins, and ``module:attribute``.

Listing names imports nothing. A plug-in is imported only when ``get`` is asked for its name, that is, when
the user's own file names it. A plug-in is either a pair ``(settings class, builder)`` or a settings class
with a method ``build``.
"""

import difflib
import re
from collections.abc import Callable, Iterable
from importlib import import_module, metadata
from typing import Any, Generic, NamedTuple, TypeVar

from pydantic import BaseModel

T = TypeVar("T")
_REFERENCE = re.compile(r"[A-Za-z_]\w*(?:\.[A-Za-z_]\w*)*:[A-Za-z_]\w*(?:\.[A-Za-z_]\w*)*", re.ASCII)


class UnknownName(ValueError):  # noqa: N818
    """A name nobody registered.

    Attributes:
        name: What was asked for.
        valid: What could have been asked for.
        suggestion: The nearest valid name, if any is near.
    """

    def __init__(self, name: str, valid: Iterable[str], suggestion: str | None, what: str = "kind"):
        self.name, self.valid, self.suggestion = name, tuple(valid), suggestion
        hint = f" (did you mean {suggestion!r}?)" if suggestion else ""
        known = ", ".join(self.valid) or "none"
        super().__init__(f"unknown {what} {name!r}{hint}; known: {known}")


class PluginError(ValueError):
    """A plug-in that was named but cannot be imported or used."""


class Entry(NamedTuple, Generic[T]):
    """One kind.

    Attributes:
        name: The text after ``kind:``.
        settings: Class that checks the settings of this kind.
        builder: Called with an instance of ``settings`` (and whatever the registry's owner agrees on).
    """

    name: str
    settings: type[BaseModel]
    builder: T


def suggest(name: str, candidates: Iterable[str]) -> str | None:
    """The candidate nearest to a misspelt name, or None if none is near."""
    best, best_score = None, 0.6
    given = name.lower().replace("-", "_")
    for candidate in candidates:
        known = candidate.lower().replace("-", "_")
        score = difflib.SequenceMatcher(None, given, known).ratio()
        if len(given) >= 3 and known[:2] == given[:2]:
            # An abbreviation is near the beginning of what it abbreviates.
            start = difflib.SequenceMatcher(None, given, known[: len(given)]).ratio()
            score = max(score, 0.95 * start)
        if score > best_score:
            best, best_score = candidate, score
    return best


class Registry(Generic[T]):
    """Maps the name of a kind to its settings class and its builder.

    Args:
        what: What the names stand for, for messages: ``"filter"``.
        group: Entry-point group of installed plug-ins, such as ``"emt.filters"``; None for none.
    """

    def __init__(self, what: str, group: str | None = None):
        self.what = what
        self.group = group
        self._entries: dict[str, Entry[T]] = {}
        self._loaded: dict[str, Entry[T]] = {}
        self._plugins: dict[str, list[metadata.EntryPoint]] | None = None

    def register(self, name: str, settings: type[BaseModel], builder: T) -> Entry[T]:
        """Adds a built-in kind.

        Raises:
            ValueError: The name is taken.
            TypeError: The settings are not a settings class.
        """
        if name in self._entries:
            raise ValueError(f"{self.what} {name!r} is registered twice")
        self._entries[name] = entry = _entry(name, settings, builder)
        return entry

    def builtin(self) -> tuple[str, ...]:
        """Names registered by this package itself, sorted."""
        return tuple(sorted(self._entries))

    def names(self) -> tuple[str, ...]:
        """Every built-in and installed name, sorted; imports no plug-in."""
        return tuple(sorted({*self._entries, *self._installed()}))

    def get(self, name: str) -> Entry[T]:
        """The kind of that name; a plug-in is imported now.

        Args:
            name: A built-in name, an installed plug-in, or ``package.module:attribute``.

        Raises:
            UnknownName: No such name.
            PluginError: The plug-in cannot be imported, is not a plug-in, or two packages offer the name.
        """
        for known in (self._entries, self._loaded):
            if name in known:
                return known[name]
        installed = self._installed().get(name, [])
        if len(installed) > 1:
            raise PluginError(f"{self.what} {name!r} is offered by more than one installed package")
        if installed:
            target = f"{installed[0].module}:{installed[0].attr}"
        elif _REFERENCE.fullmatch(name):
            target = name
        else:
            raise UnknownName(name, self.names(), suggest(name, self.names()), self.what)
        self._loaded[name] = entry = _load(name, target)
        return entry

    def forget(self) -> None:
        """Drops the plug-ins imported so far; those that are asked for again are looked up again."""
        self._loaded.clear()

    def _installed(self) -> dict[str, list[metadata.EntryPoint]]:
        if self._plugins is None:
            self._plugins = {}
            if self.group is not None:
                for point in metadata.entry_points(group=self.group):
                    self._plugins.setdefault(point.name, []).append(point)
        return self._plugins


def _import(name: str, target: str) -> Any:
    module, _, attributes = target.partition(":")
    try:
        found: Any = import_module(module)
        for attribute in attributes.split("."):
            found = getattr(found, attribute)
    except Exception as error:  # somebody else's code: whatever it raises is a message
        raise PluginError(f"plug-in {name!r} cannot be imported: {type(error).__name__}: {error}") from error
    return found


def load_function(reference: str) -> Callable[..., Any]:
    """A function of the user's, by ``package.module:attribute``.

    Raises:
        PluginError: not such a reference, or the function cannot be imported or called.
    """
    if not _REFERENCE.fullmatch(reference):
        raise PluginError(f"expected 'module:function', got {reference!r}")
    found = _import(reference, reference)
    if not callable(found):
        raise PluginError(f"{reference!r} is a {type(found).__name__}, not a function")
    return found


def _load(name: str, target: str) -> Entry[Any]:
    found = _import(name, target)
    if isinstance(found, type) and callable(getattr(found, "build", None)):
        settings, builder = found, getattr(found, "build")  # noqa: B009
    elif isinstance(found, tuple) and len(found) >= 2:
        settings, builder = found[-2:]
    else:
        raise PluginError(
            f"plug-in {name!r} is neither a settings class with 'build' nor a pair (settings class, builder)"
        )
    try:
        return _entry(name, settings, builder)
    except TypeError as error:
        raise PluginError(f"plug-in {name!r}: {error}") from None


def _entry(name: str, settings: Any, builder: Any) -> Entry[Any]:
    if not (isinstance(settings, type) and issubclass(settings, BaseModel)):
        raise TypeError(f"{settings!r} is not a settings class")
    if not callable(builder):
        raise TypeError(f"the builder {builder!r} cannot be called")
    return Entry(name, settings, builder)


FILTERS: Registry[Any] = Registry("filter", "emt.filters")
"""Builders ``(settings) -> (params, make)`` with ``make(params, model) -> Filter``: see README."""
SCENARIOS: Registry[Any] = Registry("scenario", "emt.scenarios")
"""Builders ``(settings, runs) -> (params, make)`` with ``make(params) -> Scenario``."""

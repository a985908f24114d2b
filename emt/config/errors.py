"""What is wrong with a configuration, in the user's terms: every problem at once, each with its place."""

import re
import types
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple, TypeVar, Union, get_args, get_origin

from pydantic import BaseModel, Discriminator, Tag, ValidationError

from emt.registry import UnknownName, suggest
from emt.units import describe

if TYPE_CHECKING:
    from emt.config.source import Source

KeyPath = tuple[str | int, ...]
M = TypeVar("M", bound=BaseModel)

COMMAND_LINE = "<command line>"


class Problem(NamedTuple):
    """One mistake; its text is ``file:line: key: message``.

    Attributes:
        file: Path as the user gave it, or ``COMMAND_LINE``.
        line: Line number from 1; None if there is no line.
        key: Dotted key with list positions as ``[0]``; empty if the whole file is meant.
        message: What is wrong, the value, what would be right.
    """

    file: str
    line: int | None
    key: str
    message: str

    def __str__(self) -> str:
        place = "command line" if self.file == COMMAND_LINE else self.file
        place += f":{self.line}" if self.line is not None else ""
        # A terminal must not obey control characters that come from a file.
        text = ": ".join(part for part in (place, self.key, self.message) if part)
        return "".join(char if char.isprintable() else repr(char)[1:-1] for char in text)


class ConfigError(Exception):
    """A configuration that cannot be used.

    Attributes:
        problems: All that was found, by line; those without a line come last.
        readable: What could be read of the file in spite of them, to look for further problems in; or None.
    """

    def __init__(self, problems: Iterable[Problem], readable: Any = None):
        self.readable = readable
        unique = dict.fromkeys(problems)
        self.problems = tuple(sorted(unique, key=lambda p: (p.line is None, p.line or 0)))
        super().__init__("\n".join(map(str, self.problems)))


def dotted(key_path: Sequence[str | int]) -> str:
    """``("legs", 0, "steps")`` as ``legs[0].steps``; odd names are quoted."""
    text = ""
    for part in key_path:
        if isinstance(part, int):
            text += f"[{part}]"
        else:
            text += ("." if text else "") + (part if re.fullmatch(r"[\w-]+", part) else repr(part))
    return text


def validate(model: type[M], source: "Source") -> M:
    """The settings a source holds.

    Raises:
        ConfigError: With every problem the model finds.
    """
    try:
        return model.model_validate(source.data)
    except ValidationError as error:
        raise ConfigError(problems_from_validation(error, source, model)) from None


def problems_from_validation(error: ValidationError, source: "Source", model: type[BaseModel]) -> list[Problem]:
    """Rewrites pydantic's errors: the user's keys and lines, what was expected, what was given.

    Args:
        error: What validating ``source.data`` raised.
        source: Where the data came from.
        model: The class that was validated against.
    """
    found: dict[Any, tuple[KeyPath, list[str], str]] = {}
    for number, item in enumerate(error.errors(include_url=False)):
        spot = _locate(item["loc"], model, source.data)
        if item["type"] == "too_short" and _counts_enough(item, spot.path, source.data):
            continue
        path, expected, got = _explain(item, spot, source.data)
        # The alternatives of a union without a kind are one problem, not one each.
        _, alternatives, _ = found.setdefault(path if spot.is_alternative else number, (path, [], got))
        if expected not in alternatives:
            alternatives.append(expected)
    problems = []
    for path, alternatives, got in found.values():
        place = source.place(path)
        message = " or ".join(alternatives) + (f", got {got}" if got else "")
        problems.append(Problem(place.file, place.line, dotted(path), message))
    return problems


class _Spot(NamedTuple):
    """Where a pydantic location is in the data and in the model."""

    path: KeyPath
    owner: type[BaseModel] | None  # innermost settings class
    shape: Any  # annotation there, None if unknown
    is_alternative: bool  # inside a union without discriminator


def _locate(loc: Sequence[str | int], model: type[BaseModel], data: Any) -> _Spot:
    """Follows a location through model and data, dropping what only pydantic knows: tags, labels."""
    path: list[str | int] = []
    owner: type[BaseModel] | None = None
    shape, is_alternative = _unwrap(model), False
    for i, part in enumerate(loc):
        is_last = i == len(loc) - 1
        if isinstance(shape, _Union):
            is_alternative = is_alternative or shape.discriminator is None
            shape = _unwrap(shape.member(part))
            continue
        if part == "[key]" and is_last:
            break
        arguments = get_args(shape)
        if isinstance(shape, type) and issubclass(shape, BaseModel):
            owner, name = shape, part
            fields = {field.alias or name: field for name, field in shape.model_fields.items()}
            field = fields.get(str(name)) or shape.model_fields.get(str(name))
            shape = _unwrap(field.annotation, field.discriminator, field.metadata) if field else None
        elif _is_mapping(shape):
            shape = _unwrap(arguments[1])
        elif get_origin(shape) is tuple and isinstance(part, int):
            entries = list(arguments)
            if entries[1:] == [Ellipsis]:
                entries = entries[:1] * (part + 1)
            shape = _unwrap(entries[part] if part < len(entries) else None)
        elif not _holds(data, part):
            continue
        else:
            shape = None
        path.append(part)
        data = data[part] if _holds(data, part) else None
    return _Spot(tuple(path), owner, shape, is_alternative)


def _is_mapping(shape: Any) -> bool:
    origin = get_origin(shape)
    return isinstance(origin, type) and issubclass(origin, Mapping)


def _holds(data: Any, part: str | int) -> bool:
    if isinstance(data, Mapping):
        return part in data
    return isinstance(data, (list, tuple)) and isinstance(part, int) and 0 <= part < len(data)


class _Union(NamedTuple):
    """A union of two or more members, None aside."""

    members: tuple[Any, ...]
    discriminator: str | None

    def tags(self) -> dict[str, Any]:
        """Each kind and the member it stands for."""
        tags: dict[str, Any] = {}
        for member in self.members:
            metadata = getattr(member, "__metadata__", ())
            tags |= {mark.tag: member for mark in metadata if isinstance(mark, Tag)}
            bare = _unwrap(member)
            if isinstance(bare, _Union):
                tags |= bare.tags()
            elif isinstance(bare, type) and issubclass(bare, BaseModel) and self.discriminator:
                field = bare.model_fields.get(self.discriminator)
                if field is not None and get_origin(field.annotation) is Literal:
                    tags |= {str(kind): member for kind in get_args(field.annotation)}
        return tags

    def member(self, label: str | int) -> Any:
        """The member pydantic means by a part of a location."""
        if self.discriminator is not None:
            return self.tags().get(str(label))
        for member in self.members:
            bare = _unwrap(member)
            origin = get_origin(bare)
            if getattr(bare, "__name__", None) == label or (origin and str(label).startswith(origin.__name__)):
                return member
        return None


def _unwrap(annotation: Any, discriminator: Any = None, metadata: Sequence[Any] = ()) -> Any:
    """The annotation without ``Annotated`` and ``None``; a union as ``_Union``."""
    marks = list(metadata)
    while True:
        if get_origin(annotation) is Annotated:
            annotation, *more = get_args(annotation)
            marks += more
        elif get_origin(annotation) in (Union, types.UnionType):
            members = [member for member in get_args(annotation) if member is not type(None)]
            if len(members) > 1:
                break
            annotation = members[0]
        else:
            return annotation
    for mark in marks:
        discriminator = discriminator or getattr(mark, "discriminator", None)
    if isinstance(discriminator, Discriminator):
        discriminator = discriminator.discriminator
    if callable(discriminator):
        discriminator = "kind"
    return _Union(tuple(members), discriminator)


_EXPECTED = {
    "float_type": "expected a number",
    "float_parsing": "expected a number",
    "int_type": "expected a whole number",
    "int_from_float": "expected a whole number",
    "int_parsing": "expected a whole number",
    "bool_type": "expected true or false",
    "bool_parsing": "expected true or false",
    "string_type": "expected a text",
    "tuple_type": "expected a list",
    "list_type": "expected a list",
    "dict_type": "expected a group of settings",
    "model_type": "expected a group of settings",
    "model_attributes_type": "expected a group of settings",
    "none_required": "expected nothing",
    "finite_number": "must be finite",
}
_BOUNDS = {
    "greater_than": ("gt", "must be greater than"),
    "greater_than_equal": ("ge", "must be at least"),
    "less_than": ("lt", "must be less than"),
    "less_than_equal": ("le", "must be at most"),
    "multiple_of": ("multiple_of", "must be a multiple of"),
}


def _explain(item: Any, spot: _Spot, data: Any) -> tuple[KeyPath, str, str]:
    """The key, what was expected, and what was given (empty if that says nothing)."""
    kind, context, path = item["type"], item.get("ctx", {}), spot.path
    is_name = item["loc"][-1:] == ("[key]",)
    # The user's own text rather than the number made from it.
    value = item["input"] if is_name else _given(data, path, item["input"])
    shown = repr(value) if isinstance(value, str) and len(value) <= 60 else describe(value)
    if kind in _EXPECTED:
        return path, _EXPECTED[kind], describe(value)
    if kind in _BOUNDS:
        name, words = _BOUNDS[kind]
        return path, f"{words} {_short(context[name])}", shown
    if kind == "string_pattern_mismatch":
        return path, f"{'the name ' if is_name else ''}must match {context['pattern']!r}", shown
    if kind == "extra_forbidden":
        return path, _unknown_key(str(path[-1]) if path else "", spot.owner), ""
    if kind == "missing":
        is_entry = bool(path) and isinstance(path[-1], int)
        return path, "is required: the list is too short" if is_entry else "is required", ""
    if kind in ("union_tag_invalid", "union_tag_not_found"):
        union = spot.shape if isinstance(spot.shape, _Union) else _Union((), None)
        kinds = sorted(union.tags()) or re.findall(r"'([^']*)'", context.get("expected_tags", ""))
        path = (*path, union.discriminator or "kind")
        if kind == "union_tag_not_found" and isinstance(value, Mapping) and path[-1] not in value:
            return path, f"is required; known: {', '.join(kinds)}", ""
        if not isinstance(value, Mapping):
            return spot.path, "expected a group of settings", describe(value)
        tag = value.get(path[-1])
        if not isinstance(tag, str):
            return path, f"expected one of {', '.join(kinds)}", describe(tag)
        return path, str(UnknownName(tag, kinds, suggest(tag, kinds))), ""
    if kind == "literal_error":
        choices = re.findall(r"'([^']*)'", context["expected"])
        near = suggest(value, choices) if isinstance(value, str) else None
        return path, f"must be {context['expected']}", shown + (f" (did you mean {near!r}?)" if near else "")
    if kind in ("too_short", "too_long"):
        is_short = kind == "too_short"
        bound = f"at least {context['min_length']}" if is_short else f"at most {context['max_length']}"
        return path, f"needs {bound} entries", str(context["actual_length"])
    if kind in ("value_error", "assertion_error"):
        return path, str(context["error"]), ""
    if kind == "settings":
        return path, item["msg"], ""
    return path, item["msg"][:1].lower() + item["msg"][1:], shown


def _given(data: Any, path: KeyPath, otherwise: Any) -> Any:
    for part in path:
        if not _holds(data, part):
            return otherwise
        data = data[part]
    return data


def _counts_enough(item: Any, path: KeyPath, data: Any) -> bool:
    # pydantic counts the valid entries; those that are not valid are reported already.
    given = _given(data, path, ())
    return isinstance(given, (list, tuple, dict)) and len(given) >= item["ctx"]["min_length"]


def _short(number: Any) -> str:
    return f"{number:.15g}" if isinstance(number, float) else str(number)


def _unknown_key(key: str, owner: type[BaseModel] | None) -> str:
    known = [] if owner is None else [field.alias or name for name, field in owner.model_fields.items()]
    near = suggest(key, known)
    hint = f" (did you mean {near!r}?)" if near else ""
    return f"not a known setting{hint}; known: {', '.join(known) or 'none'}"

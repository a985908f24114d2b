"""Reads a YAML file into plain data and remembers the line of every key.

Of ruamel.yaml only the event parser is used: no constructor runs, so no tag can build anything. Scalars
follow the YAML 1.2 core schema (``1e-3`` is a number, ``no`` is text), names of settings are always text, and
the limits below hold while reading, before an alias is expanded.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

from ruamel.yaml import YAML
from ruamel.yaml.error import MarkedYAMLError
from ruamel.yaml.events import (
    AliasEvent,
    DocumentStartEvent,
    MappingEndEvent,
    MappingStartEvent,
    ScalarEvent,
    SequenceEndEvent,
    SequenceStartEvent,
    StreamEndEvent,
)
from ruamel.yaml.reader import ReaderError

from emt.config.errors import ConfigError, KeyPath, Problem, dotted

MAX_BYTES = 1 << 20
MAX_LINE = 20_000  # characters; parsing time grows with the square of some lines
MAX_DEPTH = 40
MAX_NODES = 20_000  # values and keys, once as written and once with aliases expanded
_TEXT_PER_NODE = 64  # a text counts as one node for each so many characters
_MAX_DIGITS = 40

_INTEGER = re.compile(r"[-+]?[0-9]+")
_OTHER_BASE = re.compile(r"0o[0-7]+|0x[0-9a-fA-F]+")
_FLOAT = re.compile(r"[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?")
_SPECIAL_FLOAT = re.compile(r"([-+]?)\.(inf|Inf|INF|(?<!-\.)(?<!\+\.)(?:nan|NaN|NAN))")
_SURROGATE = re.compile(r"[\ud800-\udfff]")
_WORDS: dict[str, bool | None] = {
    "": None, "~": None, "null": None, "Null": None, "NULL": None,
    "true": True, "True": True, "TRUE": True, "false": False, "False": False, "FALSE": False,
}  # fmt: skip


class Place(NamedTuple):
    """Where a key was given.

    Attributes:
        file: Path as the user gave it, or ``COMMAND_LINE``.
        line: Line number from 1; None on the command line.
    """

    file: str
    line: int | None


@dataclass(frozen=True)
class Source:
    """The content of a configuration file.

    Attributes:
        path: The file, as the user gave it.
        data: Dicts with text keys, lists, float, int, str, bool, None.
        places: Where each key and list entry was given; ``()`` is the top.
    """

    path: Path
    data: dict[str, Any]
    places: Mapping[KeyPath, Place]

    def place(self, key_path: Sequence[str | int]) -> Place:
        """Where a key, or its nearest ancestor that was given, stands."""
        for length in range(len(key_path), 0, -1):
            place = self.places.get(tuple(key_path[:length]))
            if place is not None:
                return place
        return self.places[()]

    def line(self, key_path: Sequence[str | int]) -> int | None:
        """Line of a key or of its nearest ancestor; None if that is on the command line."""
        return self.place(key_path).line


def load_source(path: str | Path) -> Source:
    """Reads a configuration file.

    Raises:
        ConfigError: The file cannot be read, breaks a limit, or is not one plain YAML mapping without tags
            and without equal keys. Nothing else is raised, whatever the file holds.
    """
    file = str(path)
    try:
        with open(path, "rb") as stream:
            content = stream.read(MAX_BYTES + 1)
    except FileNotFoundError:
        raise ConfigError([Problem(file, None, "", "no such file")]) from None
    except IsADirectoryError:
        raise ConfigError([Problem(file, None, "", "is a folder, not a YAML file")]) from None
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise ConfigError([Problem(file, None, "", f"cannot be read: {reason}")]) from None
    if len(content) > MAX_BYTES:
        raise ConfigError([Problem(file, None, "", f"larger than the limit of {MAX_BYTES >> 10} KiB")])
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        raise ConfigError([Problem(file, line, "", "not UTF-8 text; save the file as UTF-8")]) from None
    return parse_source(text, path)


def parse_source(text: str, path: str | Path) -> Source:
    """Like ``load_source``, for text that was already read.

    Args:
        text: YAML.
        path: What messages call it.

    Raises:
        ConfigError: As for ``load_source``.
    """
    file = str(path)
    try:
        document = parse_document(text, file)
    except ConfigError as error:
        if isinstance(error.readable, Document) and isinstance(error.readable.value, dict):
            raise ConfigError(error.problems, _source_of(error.readable, path)) from None
        raise ConfigError(error.problems) from None
    if document is None or document.value is None:
        raise ConfigError([Problem(file, None, "", "the file is empty")])
    if not isinstance(document.value, dict):
        message = "expected settings as 'key: value' at the top of the file"
        raise ConfigError([Problem(file, document.line, "", message)])
    return _source_of(document, path)


def _source_of(document: "Document", path: str | Path) -> Source:
    places = {key_path: Place(str(path), line) for key_path, line in document.lines.items()}
    return Source(Path(path), document.value, places)


class Document(NamedTuple):
    """One parsed YAML value of any type.

    Attributes:
        value: Plain data.
        lines: Line of each key and list entry.
        line: Line where the value starts.
        flow: Whether it is a collection in brackets or braces.
        end: Position in the text just after the value.
        spans: Begin and end in the text of each value; uses of one alias or merge share theirs.
    """

    value: Any
    lines: dict[KeyPath, int]
    line: int
    flow: bool
    end: int
    spans: dict[KeyPath, tuple[int, int]]


def parse_document(text: str, file: str) -> Document | None:
    """The only value in a YAML text; None if there is none.

    Raises:
        ConfigError: As for ``load_source``.
    """
    return _Parser(text, file).document()


@dataclass
class _Node:
    """A value as written; an alias shares the node of its anchor."""

    kind: str  # "scalar", "list", "mapping"; "broken" for an alias without a value
    value: Any = None
    entries: list[tuple[int, "_Node"]] = field(default_factory=list)
    pairs: dict[str, tuple[int, "_Node"]] = field(default_factory=dict)
    merged: list[tuple[int, "_Node"]] = field(default_factory=list)
    is_open: bool = True  # still being read: an alias to it would contain itself
    flat: dict[str, tuple[int, "_Node"]] | None = None  # pairs with merges resolved
    span: tuple[int, int] = (0, 0)


class _Parser:
    """Reads one document: first into nodes, then, aliases expanded, into plain data."""

    def __init__(self, text: str, file: str):
        self.text, self.file = text, file
        self.problems: list[Problem] = []
        self.anchors: dict[str, _Node] = {}
        self.lines: dict[KeyPath, int] = {}
        self.spans: dict[KeyPath, tuple[int, int]] = {}
        self.spent = 0
        self.events: Iterator[Any] = iter(())

    def document(self) -> Document | None:
        for number, line in enumerate(self.text.split("\n"), start=1):
            if len(line) > MAX_LINE:
                self.stop(number, f"line longer than {MAX_LINE} characters")
        self.events = iter(YAML(typ="safe", pure=True).parse(self.text))
        while not isinstance(event := self.next_event(), (DocumentStartEvent, StreamEndEvent)):
            pass
        if isinstance(event, StreamEndEvent):
            return None
        first = self.next_event()
        line = first.start_mark.line + 1
        root, end = self.read(first, (), 0)
        while not isinstance(event := self.next_event(), StreamEndEvent):
            if isinstance(event, DocumentStartEvent):
                self.stop(event.start_mark.line + 1, "a second document starts here; only one is allowed")
        self.spent = 0
        self.lines[()] = line
        value = self.expand(root, (), 0, line)
        document = Document(value, self.lines, line, bool(getattr(first, "flow_style", False)), end, self.spans)
        if self.problems:
            raise ConfigError(self.problems, document)
        return document

    def stop(self, line: int | None, message: str) -> NoReturn:
        raise ConfigError([*self.problems, Problem(self.file, line, "", message)])

    def report(self, line: int, key_path: KeyPath, message: str) -> None:
        self.problems.append(Problem(self.file, line, dotted(key_path), message))

    def spend(self, line: int, text: Any = "") -> None:
        self.spent += 1 + (len(text) // _TEXT_PER_NODE if isinstance(text, str) else 0)
        if self.spent > MAX_NODES:
            self.stop(line, f"more than {MAX_NODES} values, counting each use of an alias")

    def next_event(self) -> Any:
        try:
            return next(self.events)
        except MarkedYAMLError as error:
            mark = error.problem_mark or error.context_mark
            self.stop(mark.line + 1 if mark else None, f"not valid YAML: {error.problem or error.context}")
        except ReaderError as error:
            line = self.text.count("\n", 0, error.position) + 1
            self.stop(line, f"not valid YAML: the character {_code(error.character)} is not allowed")
        except Exception as error:  # the parser lets some of its own slips through, such as OverflowError
            self.stop(None, f"not valid YAML: {error}")

    def read(self, event: Any, path: KeyPath, depth: int) -> tuple[_Node, int]:
        """The node that starts with an event, and the position just after it."""
        line = event.start_mark.line + 1
        if depth > MAX_DEPTH:
            self.stop(line, f"nested deeper than {MAX_DEPTH} levels")
        self.spend(line, getattr(event, "value", ""))
        if isinstance(event, AliasEvent):
            return self.aliased(event, path, line), event.end_mark.index
        if event.tag is not None:
            tag = str(event.tag).replace("tag:yaml.org,2002:", "!!")
            self.report(line, path, f"the tag {tag} is not allowed; write the plain value")
        if isinstance(event, ScalarEvent):
            node = _Node("scalar", self.scalar(event, path, line))
        else:
            node = _Node("mapping" if isinstance(event, MappingStartEvent) else "list")
        if event.anchor is not None:
            self.anchors[event.anchor] = node
        begin = event.start_mark.index
        if isinstance(event, MappingStartEvent):
            event = self.read_pairs(node, path, depth)
        elif isinstance(event, SequenceStartEvent):
            while not isinstance(event := self.next_event(), SequenceEndEvent):
                entry_path = (*path, len(node.entries))
                line = event.start_mark.line + 1
                node.entries.append((line, self.read(event, entry_path, depth + 1)[0]))
        node.is_open = False
        node.span = begin, event.end_mark.index
        return node, event.end_mark.index

    def aliased(self, event: Any, path: KeyPath, line: int) -> _Node:
        node = self.anchors.get(event.anchor)
        if node is None:
            self.report(line, path, f"the alias *{event.anchor} has no anchor above it")
        elif node.is_open:
            self.report(line, path, f"the alias *{event.anchor} contains itself")
        else:
            return node
        return _Node("broken")

    def read_pairs(self, node: _Node, path: KeyPath, depth: int) -> Any:
        """Fills a mapping; returns the event that ends it."""
        first_lines: dict[str, int] = {}
        while not isinstance(event := self.next_event(), MappingEndEvent):
            line = event.start_mark.line + 1
            key = self.key(event, path, line)
            if key is None:
                if not isinstance(event, (ScalarEvent, AliasEvent)):
                    self.read(event, path, depth + 1)
                self.read(self.next_event(), path, depth + 1)
                continue
            self.spend(line, key)
            child_path = (*path, key)
            child, _ = self.read(self.next_event(), child_path, depth + 1)
            if key in first_lines:
                where = f", first on line {first_lines[key]}" if first_lines[key] != line else ""
                self.report(line, child_path, f"is given twice{where}")
                continue
            first_lines[key] = line
            if key == "<<" and not event.style:
                node.merged = child.entries if child.kind == "list" else [(line, child)]
                if any(source.kind not in ("mapping", "broken") for _, source in node.merged):
                    self.report(line, child_path, "can only merge a mapping or a list of mappings")
                    node.merged = []
            else:
                node.pairs[key] = (line, child)
        return event

    def key(self, event: Any, path: KeyPath, line: int) -> str | None:
        if not isinstance(event, ScalarEvent) or event.tag is not None or event.anchor is not None:
            self.report(line, path, "a key must be a plain name")
        elif event.value == "" or _SURROGATE.search(event.value):
            self.report(line, path, "a key is missing or is not text")
        else:
            return event.value
        return None

    def scalar(self, event: Any, path: KeyPath, line: int) -> Any:
        text: str = event.value
        if event.style:
            if _SURROGATE.search(text):
                self.report(line, path, "an escape in this text is half a character")
            return text
        if len(text) > _MAX_DIGITS and _INTEGER.fullmatch(text):
            self.report(line, path, f"a whole number of more than {_MAX_DIGITS} digits")
            return 0
        return plain_scalar(text)

    def flattened(self, node: _Node, line: int, depth: int) -> dict[str, tuple[int, _Node]]:
        """The pairs of a mapping; its own win over merged ones, earlier merges over later ones."""
        if node.flat is None:
            if depth > MAX_DEPTH:
                self.stop(line, f"merges nested deeper than {MAX_DEPTH} levels")
            flat = {}
            for source_line, source in node.merged:
                merged = self.flattened(source, source_line, depth + 1)
                for _ in merged:
                    self.spend(source_line)
                flat = {**merged, **flat}
            node.flat = {**flat, **node.pairs}
        return node.flat

    def expand(self, node: _Node, path: KeyPath, depth: int, line: int) -> Any:
        if depth > MAX_DEPTH:
            self.stop(line, f"nested deeper than {MAX_DEPTH} levels, aliases included")
        self.spend(line, node.value)
        if node.kind in ("scalar", "broken"):
            return node.value
        is_list = node.kind == "list"
        pairs = enumerate(node.entries) if is_list else self.flattened(node, line, 0).items()
        result: dict[Any, Any] = {}
        for key, (child_line, child) in pairs:
            child_path = (*path, key)
            self.lines[child_path] = child_line
            self.spans[child_path] = child.span
            self.spend(child_line, key)
            result[key] = self.expand(child, child_path, depth + 1, child_line)
        return list(result.values()) if is_list else result


def _code(character: Any) -> str:
    return f"U+{character if isinstance(character, int) else ord(character):04X}"


def plain_scalar(text: str) -> str | int | float | bool | None:
    """What an unquoted scalar means in the YAML 1.2 core schema."""
    if text in _WORDS:
        return _WORDS[text]
    if _INTEGER.fullmatch(text):
        return int(text)
    if _OTHER_BASE.fullmatch(text) and len(text) <= _MAX_DIGITS:
        return int(text, 0)
    if _FLOAT.fullmatch(text):
        return float(text)
    if special := _SPECIAL_FLOAT.fullmatch(text):
        return float(special[1] + special[2])
    return text

"""Changes single values in the text of a configuration; comments, order and everything else stay as they are."""

import os
import tempfile
from collections.abc import Iterable, Mapping
from pathlib import Path

from emt.config.errors import ConfigError, KeyPath, Problem, dotted
from emt.config.source import Document, parse_document

ORIGINS = ("paper", "published_code")
"""Groups of `sources` in which a tuned setting cannot stay."""


def with_values(text: str, file: str, values: Mapping[KeyPath, str]) -> str:
    """The text with other scalars under the given keys.

    Raises:
        ConfigError: a key is not given in this file, or a value is shared by an anchor with keys that are not changed.
    """
    document = _document(text, file)
    problems, changes = [], {}
    for path, value in values.items():
        span = document.spans.get(path)
        if span is None:
            problems.append(Problem(file, None, dotted(path), "is not given in this file, so it cannot be changed"))
            continue
        others = [dotted(p) for p, other in document.spans.items() if other == span and values.get(p) != value]
        if others:
            message = f"shares its value with {', '.join(others)} by an anchor; give it a value of its own first"
            problems.append(Problem(file, document.lines[path], dotted(path), message))
        changes[span] = value
    if problems:
        raise ConfigError(problems)
    return _replaced(text, changes)


def marked_calibrated(text: str, file: str, keys: Iterable[str]) -> str:
    """The text with the dotted keys listed under `sources.calibrated` and no longer as printed anywhere."""
    for key in keys:
        document = _document(text, file)
        sources = document.value.get("sources") or {}
        for group in ORIGINS:
            if key in (sources.get(group) or []):
                text = _without_entry(text, document, ("sources", group), sources[group].index(key))
                document = _document(text, file)
        if key not in (sources.get("calibrated") or []):
            text = _with_entry(text, document, key)
    return text


def replace_file(path: Path, text: str) -> None:
    """Writes a file whole or not at all."""
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}-")
    try:
        with os.fdopen(handle, "w", encoding="utf-8", newline="") as stream:
            stream.write(text)
        os.chmod(temporary, path.stat().st_mode & 0o777)
        os.replace(temporary, path)
    except OSError as error:
        Path(temporary).unlink(missing_ok=True)
        raise ConfigError([Problem(str(path), None, "", f"cannot be written: {error.strerror or error}")]) from error


def _document(text: str, file: str) -> Document:
    document = parse_document(text, file)
    if document is None or not isinstance(document.value, dict):
        raise ConfigError([Problem(file, None, "", "expected settings as 'key: value' at the top of the file")])
    return document


def _replaced(text: str, changes: Mapping[tuple[int, int], str]) -> str:
    for (begin, end), value in sorted(changes.items(), reverse=True):
        text = text[:begin] + value + text[end:]
    return text


def _line_of(text: str, position: int) -> tuple[int, int]:
    """Begin of the line around a position, and of the next one."""
    end = text.find("\n", position)
    return text.rfind("\n", 0, position) + 1, len(text) if end < 0 else end + 1


def _without_entry(text: str, document: Document, path: KeyPath, index: int) -> str:
    """The text without one entry of a list; a list that would be empty stays as `[]`."""
    spans = [document.spans[(*path, k)] for k in range(_length(document, path))]
    begin, end = spans[index]
    line, after = _line_of(text, begin)
    in_block = text[line:begin].strip() == "-"
    if len(spans) == 1:
        whole = document.spans[path]
        return text[: whole[0]] + "[]" + text[end:] if in_block else text[:begin] + text[end:]
    if in_block:
        return text[:line] + text[after:]
    begin, end = (spans[index - 1][1], end) if index else (begin, spans[1][0])
    return text[:begin] + text[end:]


def _length(document: Document, path: KeyPath) -> int:
    value = document.value
    for part in path:
        value = value[part]
    return len(value)


def _with_entry(text: str, document: Document, key: str) -> str:
    """The text with one more entry under sources.calibrated."""
    path = ("sources", "calibrated")
    newline = "\r\n" if "\r\n" in text else "\n"
    if path in document.spans and (entries := document.value["sources"]["calibrated"]):
        begin, end = document.spans[(*path, len(entries) - 1)]
        line, _ = _line_of(text, begin)
        if text[line:begin].strip() == "-":
            return text[:end] + newline + text[line:begin] + key + text[end:]
        return text[:end] + f", {key}" + text[end:]
    if path in document.spans:
        begin, end = document.spans[path]
        return text[:begin] + f"{'' if text[begin - 1 : begin].isspace() else ' '}[{key}]" + text[end:]
    if document.value.get("sources"):
        begin, _ = document.spans[("sources",)]
        if text[begin] == "{":
            return text[: begin + 1] + f"calibrated: [{key}], " + text[begin + 1 :]
        number = min(line for p, line in document.lines.items() if p[:1] == ("sources",) and len(p) == 2) - 1
        lines = text.splitlines(keepends=True)
        indent = lines[number][: len(lines[number]) - len(lines[number].lstrip())]
        lines.insert(number, f"{indent}calibrated: [{key}]{newline}")
        return "".join(lines)
    if document.value.get("sources") == {}:
        begin, end = document.spans[("sources",)]
        return text[:begin] + f"{{calibrated: [{key}]}}" + text[end:]
    if "sources" in document.value:
        lines = text.splitlines(keepends=True)
        lines.insert(document.lines[("sources",)], f"  calibrated: [{key}]{newline}")
        return "".join(lines)
    return text.rstrip() + f"{newline}{newline}sources:{newline}  calibrated: [{key}]{newline}"

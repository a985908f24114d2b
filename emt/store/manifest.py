"""The manifest: to which configuration a folder belongs, and on what it was computed."""

import hashlib
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from emt.store.errors import Difference, NotARunFolder, StoreError

MANIFEST = "manifest.json"
MAX_JSON_BYTES = 16 * 2**20
FORMAT = "emt run folder"
FORMAT_VERSION = 1
OWN_KEYS = ("format", "format_version", "identity_sha256", "environments")
ABSENT = "(absent)"


def encode_json(value: Any) -> bytes:
    """JSON with sorted keys, two spaces of indentation, UTF-8.

    Raises:
        ValueError: A NaN or infinity, which JSON does not have, or more than the 16 MiB emt reads back.
        TypeError: A value that is not plain data.
    """
    text = json.dumps(value, sort_keys=True, indent=2, allow_nan=False, ensure_ascii=False)
    data = (text + "\n").encode()
    if len(data) > MAX_JSON_BYTES:
        raise ValueError(f"{len(data)} bytes of JSON are more than the {MAX_JSON_BYTES} that emt reads back")
    return data


def decode_json(data: bytes) -> Any:
    """Parse JSON; NaN, infinities and absurd nesting are a `ValueError`."""
    try:
        return json.loads(data, parse_constant=_refuse_constant)
    except RecursionError:
        raise ValueError("nested too deeply") from None


def fingerprint(identity: Any) -> str:
    """SHA-256 of an identity, independent of the order of keys."""
    return hashlib.sha256(encode_json(identity)).hexdigest()


def make_manifest(given: Mapping[str, Any], stored: Mapping[str, Any] | None) -> dict[str, Any]:
    """The manifest to keep: identity of the stored one, everything else as given now.

    Args:
        given: `identity`, optionally `environment`, and further keys for information.
        stored: The manifest found in the folder, None for a new folder.

    Returns:
        A manifest in which `environment` is the present one and `environments` lists every
        distinct one in order of first use.

    Raises:
        ValueError: `given` has no identity, or uses a key that the store writes itself.
    """
    if "identity" not in given or any(key in given for key in OWN_KEYS):
        raise ValueError(f"a manifest needs 'identity' and must not set {', '.join(OWN_KEYS)}")
    manifest = decode_json(encode_json(dict(given)))
    environments = list(stored["environments"]) if stored else []
    environment = manifest.get("environment")
    if environment is not None and environment not in environments:
        environments.append(environment)
    if stored:
        manifest["identity"] = stored["identity"]
    return manifest | {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "identity_sha256": fingerprint(manifest["identity"]),
        "environments": environments,
    }


def parse_manifest(data: bytes, path: Path) -> dict[str, Any]:
    """Check that bytes are a manifest of ours.

    Args:
        data: Content of the file.
        path: The file, for messages.

    Raises:
        NotARunFolder: The file belongs to some other program.
        StoreError: The file is damaged, or of a later version of emt.
    """
    damaged = f"{path}: damaged (%s). Restore this file from a copy, or choose another output folder."
    try:
        manifest = decode_json(data)
    except ValueError as error:
        raise StoreError(damaged % error) from error
    if not isinstance(manifest, dict) or manifest.get("format") != FORMAT:
        raise NotARunFolder(
            f"{path.parent}: is not a run folder, its {path.name} is of another program. Choose another output folder."
        )
    if manifest.get("format_version") != FORMAT_VERSION:
        raise StoreError(
            f"{path}: written in format {manifest.get('format_version')}, this emt knows {FORMAT_VERSION}. "
            "Use the version of emt that wrote it, or choose another output folder."
        )
    if not isinstance(manifest.get("environments"), list):
        raise StoreError(damaged % "no list of environments")
    if fingerprint(manifest.get("identity")) != manifest.get("identity_sha256"):
        raise StoreError(damaged % "the configuration does not match its checksum")
    return manifest


def list_differences(stored: Any, given: Any) -> list[Difference]:
    """Keys in which two JSON values differ, dotted, list positions included (`filters.0.forgetting`).

    The order of keys means nothing; 1 and 1.0 are the same number; true and 1 are not the same.
    """
    return list(_walk(stored, decode_json(encode_json(given)), ""))


def _walk(stored: Any, given: Any, key: str) -> Iterator[Difference]:
    if isinstance(stored, dict) and isinstance(given, dict):
        for name in sorted(stored.keys() | given.keys()):
            yield from _walk_entry(stored, given, name, f"{key}.{name}" if key else name)
    elif isinstance(stored, list) and isinstance(given, list):
        left, right = dict(enumerate(stored)), dict(enumerate(given))
        for index in range(max(len(stored), len(given))):
            yield from _walk_entry(left, right, index, f"{key}.{index}" if key else str(index))
    elif isinstance(stored, bool) != isinstance(given, bool) or stored != given:
        yield Difference(key, json.dumps(stored, ensure_ascii=False), json.dumps(given, ensure_ascii=False))


def _walk_entry(stored: dict[Any, Any], given: dict[Any, Any], name: Any, key: str) -> Iterator[Difference]:
    if name in stored and name in given:
        yield from _walk(stored[name], given[name], key)
    elif name in stored:
        yield Difference(key, json.dumps(stored[name], ensure_ascii=False), ABSENT)
    else:
        yield Difference(key, ABSENT, json.dumps(given[name], ensure_ascii=False))


def _refuse_constant(text: str) -> Any:
    raise ValueError(f"{text} is not a number JSON knows")

"""Check mappings against config schemas; report a mistake in one line with its key and the nearest valid choice."""

import dataclasses
import difflib
import hashlib
import json
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, TypeVar

from pydantic import TypeAdapter, ValidationError
from pydantic_core import ErrorDetails

from atlantis_exp.faults import ConfigError

T = TypeVar("T")

_LONGEST = 10 * 365 * 24 * 3600  # seconds


def nearest(word: str, choices: Iterable[str]) -> str:
    """Return the end of an error line: the closest of `choices`, and all if there are at most 12."""
    choices = sorted(choices)
    close = difflib.get_close_matches(word, choices, n=1, cutoff=0.5)
    listed = f" (valid: {', '.join(choices)})" if 0 < len(choices) <= 12 else ""
    return (f"did you mean '{close[0]}'?" if close else "no valid choice is near") + listed


def seconds(text: str | int) -> int:
    """Return a duration such as 90, 90s, 10min, 3h or 1h30m in seconds; 0 if it cannot be parsed."""
    if re.fullmatch(r"\d+", str(text)):
        return int(text)
    parts = re.fullmatch(r"(?:(\d+)h)?(?:(\d+)m(?:in)?)?(?:(\d+)s)?", str(text))
    hours, minutes, seconds = (int(part or 0) for part in parts.groups()) if parts else (0, 0, 0)
    return 3600 * hours + 60 * minutes + seconds


def check_time(key: str, text: str | int | None, example: str) -> None:
    """Raise ConfigError unless a key holds a duration of at most ten years."""
    if text is None:
        return
    if not (length := seconds(text)):
        raise ConfigError(f"{key}={text}: not a duration; use {example}")
    if length > _LONGEST:
        raise ConfigError(f"{key}={text}: should be at most 10 years")


def share(key: str, text: str | float) -> float:
    """Parse a share such as 20% or 0.2. Raises: ConfigError."""
    try:
        value = float(str(text).removesuffix("%")) / (100 if str(text).endswith("%") else 1)
    except ValueError:
        value = -1.0
    if not 0 < value <= 1:
        raise ConfigError(f"{key}={text}: write a share, as in {key}=20% or {key}=0.2")
    return value


def absolute(key: str, text: str) -> Path:
    """Return a typed path as an absolute one, with `~` expanded. Raises: ConfigError."""
    try:
        path = Path(text).expanduser().absolute()
        str(path).encode()
    except RuntimeError:
        raise ConfigError(f"{key}={text}: no such user") from None
    except UnicodeEncodeError:
        raise ConfigError(f"{key}={text}: is in a folder whose name is not UTF-8; name another folder") from None
    return path


def check_new(folder: Path) -> None:
    """Raise ConfigError if the folder of `to=` exists and is not empty."""
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise ConfigError(f"to={folder}: is not empty; name another folder")


def check_server(key: str, uri: str | None) -> None:
    """Raise ConfigError unless a key holds a server's address without a password, since it is written to files."""
    if uri is not None and not re.fullmatch(r"https?://[^\s@?#]+", uri):
        raise ConfigError(
            f"{key}: should be null or a server's address, as in http://127.0.0.1:5000; user and password "
            "belong in the environment, as MLFLOW_TRACKING_USERNAME and MLFLOW_TRACKING_PASSWORD"
        )


def parse(schema: type[T], tree: Mapping[str, Any]) -> T:
    """Check a plain nested mapping against a schema class. Raises: ConfigError, naming the first fault's key."""
    # Through JSON, whose strict mode takes a list for a tuple: YAML has no tuples.
    text = json.dumps(tree)
    try:
        return TypeAdapter(schema).validate_json(text)
    except ValidationError as error:  # its keys are strings, as in JSON
        raise ConfigError(_explain(error.errors(include_url=False), json.loads(text))) from None


def to_dict(config: Any) -> dict[str, Any]:
    """Return a config as plain JSON containers."""
    tree: dict[str, Any] = json.loads(json.dumps(dataclasses.asdict(config)))
    return tree


def flatten(tree: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return dotted keys and their leaves; lists are leaves."""
    leaves: dict[str, Any] = {}
    for key, value in tree.items():
        if isinstance(value, Mapping):
            leaves |= flatten(value, f"{prefix}{key}.")
        else:
            leaves[f"{prefix}{key}"] = value
    return leaves


def digest(tree: Mapping[str, Any]) -> str:
    """Return ten hexadecimal digits of the hash of a mapping's canonical JSON."""
    return hashlib.sha256(json.dumps(tree, sort_keys=True).encode()).hexdigest()[:10]


def _explain(faults: list[ErrorDetails], tree: Mapping[str, Any]) -> str:
    """Return one line for the first fault of a tree, or for an unknown key if there is one."""
    if isinstance(cause := faults[0].get("ctx", {}).get("error"), ConfigError):
        return str(cause)
    located = [(fault, *_locate(fault, tree)) for fault in faults]
    # A misspelt key shows twice, as one missing and one extra: the extra one is the user's.
    _, above, *_ = min(located, key=lambda each: each[0]["type"] != "unexpected_keyword_argument")
    within = [each for each in located if each[1][: len(above)] == above]
    fault, path, siblings, node = max(within, key=lambda each: len(each[1]))  # of a list's items rather than its type
    key, kind = ".".join(path), fault["type"]
    if kind == "unexpected_keyword_argument":
        return f"{key}: no such key; {nearest(path[-1], set(siblings) - {path[-1]})}"
    if kind == "missing" or node == "???":
        return f"{key}: missing; it has no default"
    if kind == "union_tag_invalid":
        tags = str(fault["ctx"]["expected_tags"]).replace("'", "").split(", ")
        given = str(fault["ctx"]["tag"])
        return f"{key}.name={given}: no such choice; {nearest(given, tags)}"
    if kind == "literal_error":
        choices = str(fault["ctx"]["expected"]).replace("'", "").replace(" or ", ", ").split(", ")
        return f"{key}={node}: no such choice; {nearest(str(node), choices)}"
    # A union has a fault for each of its types.
    here = [other for other, place, *_ in located if place == path]
    is_whole = isinstance(node, float) and node.is_integer() and abs(node) < 2**63
    if is_whole and any(other["type"] == "int_type" for other in here):
        return f"{key}={node:g}: should be an integer; write {key}={int(node):_}"
    alternatives = dict.fromkeys(re.sub(r"^\w+ should ", "", other["msg"]) for other in here)
    bounds = re.sub(r"\b0\.0{4,}\d+", lambda tiny: f"{float(tiny[0]):g}", " or ".join(alternatives))
    shown = json.dumps(node)
    shown = shown if len(shown) <= 60 else f"{shown[:54]}..."
    return f"{key}={shown}: should {bounds}"


def _locate(fault: ErrorDetails, tree: Mapping[str, Any]) -> tuple[list[str], Mapping[str, Any], Any]:
    """Return a fault's key as the user wrote it, the mapping that holds it, and its value."""
    path: list[str] = []
    node: Any = tree
    siblings: Mapping[str, Any] = tree
    for part in fault["loc"]:
        # Pydantic's path also names the member of a union, which is not a key of the tree.
        if isinstance(node, Mapping):
            siblings = node
            if part in node:
                node = node[str(part)]
                path.append(str(part))
            elif fault["type"] == "missing" and part == fault["loc"][-1]:
                path.append(str(part))
        elif isinstance(node, list) and isinstance(part, int):
            node = node[part] if part < len(node) else None
            path.append(str(part))
    return path, siblings, node

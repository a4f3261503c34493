"""Error texts in the terms of the configuration file; remedies for removed keys, commands and options."""

from __future__ import annotations

import difflib
import math
import re
import reprlib
import types
import typing
from typing import Annotated, Any, Final, Literal, Union

import msgspec
from msgspec import Meta

from companion.config.sections import Config
from companion.errors import ConfigError

KEYS: Final[dict[str, str]] = {
    "calibration.fleet_prior": "0.2: delete the line (calibration.prior, of the aircraft's own power-ups, stays)",
    "push.dither": "0.2: delete the line (floats tell every IMU: on ArduPilot companion autopilot script)",
}
"""Removed configuration keys ("imu.port" for "imu[0].port"), each with the version that removed it and the remedy."""

_PROXY: Final = "0.2: put a web server with https before the page, as docs/fleet.md shows (The page)"
COMMAND_LINE: Final[dict[str, str]] = {
    "companion align --show": "0.3: type companion align show",
    "companion align --forget": "0.3: type companion align forget",
    "companion report --flight": "0.2: companion log flight LOG prints all of it, companion history a line per flight",
    "companion ground params": "0.2: set CMP_ parameters in the parameter list of a ground station program",
    "companion fleet run --cert": _PROXY,
    "companion fleet run --key": _PROXY,
    "companion fleet acl emqx": "0.2: give other brokers the rights that companion fleet acl mosquitto lists",
    "companion fleet demo": "0.2: run python -m sim fleet in the folder of the companion's sources",
    "companion fleet export": "0.2: use psql, sqlite3 or DuckDB, as docs/fleet.md shows (Export)",
}
"""Removed commands ("companion NAME") and options ("companion NAME --option"), each with version and remedy."""

_LONGEST: Final = 200
_INT_BITS: Final = 63
_briefly: Final = reprlib.Repr()
_briefly.maxstring = _briefly.maxother = _briefly.maxlong = 80


def refusal_of_key(path: str) -> str | None:
    remedy = KEYS.get(re.sub(r"\[\d+\]", "", path))
    return None if remedy is None else f"{path} was removed in {remedy}; see CHANGELOG"


def refusal_of_words(command: str, word: str) -> str | None:
    remedy = COMMAND_LINE.get(f"{command} {word}")
    return None if remedy is None else f"{word} was removed in {remedy}"


def refuse_unknown_keys(raw: dict[str, Any], section: type[msgspec.Struct], path: str, name: str) -> None:
    """Refuse unknown keys, and values that no key can have, such as nan.

    Raises:
        ConfigError: the text names the first unknown key and the nearest known key, or all allowed keys.
    """
    known = typing.get_type_hints(section)
    for key, value in raw.items():
        here = f"{path}.{key}" if path else key
        if key not in known:
            if (refusal := refusal_of_key(here)) is not None:
                raise ConfigError(f"{name}: {refusal}")
            kind = "section" if isinstance(value, dict) else "key"
            near = difflib.get_close_matches(key, known, n=1)
            hint = f"did you mean {near[0]!r}?" if near else f"allowed: {', '.join(sorted(known))}"
            raise ConfigError(f"{name}: unknown {kind} {shown(here)}; {hint}")
        inner, listed = _section_in(known[key]), isinstance(value, list)
        for index, item in enumerate(value if listed else [value]):
            if inner is not None and isinstance(item, dict):
                refuse_unknown_keys(item, inner, f"{here}[{index}]" if listed else here, name)
            else:
                _refuse_unusable(item, here, name)


def _refuse_unusable(value: object, here: str, name: str) -> None:
    """Refuse values that are valid TOML but wrong for every key: nan, inf, huge integers, invisible characters."""
    within = [value]
    while within:  # no recursion: dots in a key may nest to any depth
        item = within.pop()
        if isinstance(item, dict):
            within += [*item, *item.values()]
        elif isinstance(item, list):
            within += item
        elif isinstance(item, float) and not math.isfinite(item):
            raise ConfigError(f"{name}: {here!r}: found {shown(item)}; allowed: {allowed(here)}, finite")
        elif isinstance(item, int) and item.bit_length() > _INT_BITS:
            raise ConfigError(f"{name}: {here!r}: found a number of {item.bit_length()} bits; allowed: {allowed(here)}")
        elif isinstance(item, str) and not item.isprintable():
            raise ConfigError(f"{name}: {here!r}: found {shown(item)}; allowed: printable characters")


def shown(value: object) -> str:
    return {True: "true", False: "false"}[value] if isinstance(value, bool) else _briefly.repr(value)


def brief(words: str) -> str:
    return words if len(words) <= _LONGEST else f"{words[:_LONGEST]}..."


def _section_in(annotation: object) -> type[msgspec.Struct] | None:
    """Return the section type inside an annotation such as `Section | None` or `list[Section]`."""
    if isinstance(annotation, type) and issubclass(annotation, msgspec.Struct):
        return annotation
    for inner in typing.get_args(annotation):
        found = _section_in(inner)
        if found is not None:
            return found
    return None


_AT_PATH = re.compile(r"^(?P<what>.*?)(?: - at `\$(?P<path>[^`]*)`)?$", re.DOTALL)
_MISSING = re.compile(r"missing required field `(?P<field>\w+)`")


def explain(message: str, raw: dict[str, Any]) -> str:
    """Translate an error message of msgspec into `key: found ...; allowed: ...`, in the terms of the file."""
    match = _AT_PATH.match(message)
    what, path = (match["what"], (match["path"] or "").lstrip(".")) if match else (message, "")
    missing = _MISSING.search(what)
    if missing:
        key = f"{path}.{missing['field']}" if path else missing["field"]
        return f"{key!r} is missing; allowed: {allowed(key)}"
    found = _value_at(raw, path)
    return f"{path!r}: found {shown(found)}; allowed: {allowed(path)}"


def _value_at(raw: object, path: str) -> object:
    for key, index in re.findall(r"(\w+)|\[(\d+|\.\.\.)\]", path):
        if key and isinstance(raw, dict) and key in raw:
            raw = raw[key]
        elif index.isdigit() and isinstance(raw, list) and int(index) < len(raw):
            raw = raw[int(index)]
        else:
            break
    return raw


def allowed(path: str) -> str:
    """Describe the allowed values of a configuration key such as `imu[0].source` in words."""
    annotation: object = Config
    for key in re.findall(r"\w+(?=\[|\.|$)", re.sub(r"\[[^\]]*\]", "", path)):
        section = _section_in(annotation)
        if section is None:
            break
        annotation = typing.get_type_hints(section, include_extras=True).get(key, annotation)
    return _describe(annotation)


_WORDS: dict[object, str] = {
    str: "a text", int: "a whole number", float: "a number", bool: "true or false", types.NoneType: "",
}  # fmt: skip


def _describe(annotation: object) -> str:
    origin, arguments = typing.get_origin(annotation), typing.get_args(annotation)
    if origin is Annotated:
        return _describe(arguments[0]) + _describe_limits(arguments[1])
    if origin is Literal:
        return ", ".join(f'"{value}"' for value in arguments)
    if origin in (Union, types.UnionType):
        return " or ".join(words for words in map(_describe, arguments) if words)
    if origin is tuple and Ellipsis in arguments:
        return f"a list, each {_describe(arguments[0])}"
    if origin is tuple:
        return f"[{', '.join('number' for _ in arguments)}]"
    if origin is list or (isinstance(annotation, type) and issubclass(annotation, msgspec.Struct)):
        section = _section_in(annotation)
        brackets = "[[{}]]" if origin is list else "[{}]"
        return f"a section {brackets.format(section.__name__.lower().removesuffix('section') if section else '')}"
    return _WORDS.get(annotation, str(annotation))


def _describe_limits(meta: Meta) -> str:
    if meta.ge is not None and meta.le is not None:
        return f" from {meta.ge:g} to {meta.le:g}"
    if meta.gt is not None:
        return f" above {meta.gt:g}" + (f", at most {meta.le:g}" if meta.le is not None else "")
    if meta.min_length is not None:
        return ", not empty"
    return ""

"""Functions that parse and check JSON files and requests, and that make received text printable."""

from __future__ import annotations

import datetime
import functools
import threading
from typing import Any, Final

import msgspec

_FIRST_USE: Final = threading.Lock()
"""Lock for the first use of a type: msgspec 0.22 crashes if two threads use a new type at the same time."""


def decode(data: bytes, kind: Any, newest: int | None) -> Any:
    """Parse JSON as type `kind`; raise msgspec.MsgspecError for other JSON or a `format_version` above `newest`."""
    if newest is not None:
        said = msgspec.json.decode(data, type=dict[str, msgspec.Raw]).get("format_version")
        if said is not None and (version := msgspec.json.decode(said, type=int)) > newest:
            raise msgspec.ValidationError(
                f"found format {version}; allowed: up to {newest} (a newer companion has saved it)"
            )
    with _FIRST_USE:
        decoder = _decoder(kind)
    return decoder.decode(data)


@functools.cache
def _decoder(kind: Any) -> msgspec.json.Decoder[Any]:
    return msgspec.json.Decoder(kind)


def utc_now() -> str:
    return datetime.datetime.now(tz=datetime.UTC).isoformat(timespec="milliseconds")


Object = dict[str, Any]  # a JSON object: a request or an answer

Value = str | int | float | bool | None


def parse_request(data: bytes) -> dict[str, Any]:
    """Parse a JSON object of strings, numbers, true, false and null; raise ValueError for any other content."""
    found = msgspec.json.decode(data, type=dict[str, Value])
    for key, value in found.items():
        if isinstance(value, str) and "\0" in value:
            raise ValueError(f"{key!r}: found a text with a zero byte; allowed: texts without")
    return found


def printable(text: str) -> str:
    """Return a text as one line with control characters and invisible characters escaped.

    Uses `ascii`, not a codec: Python loads a codec from a file at first use, which needs a free file descriptor.
    """
    if text.isprintable():
        return text
    return "".join(letter if letter.isprintable() else ascii(letter)[1:-1] for letter in text)

"""A request in JSON, judged at the door: the same at the control socket and at the page."""

from __future__ import annotations

from typing import Any

import msgspec

Object = dict[str, Any]
"""A request or an answer, as JSON can hold it."""

Value = str | int | float | bool | None


def parse_request(data: bytes) -> dict[str, Any]:
    """Read an object of texts, numbers, true, false and null.

    Raises:
        ValueError: it is none, and why, in one line.
    """
    found = msgspec.json.decode(data, type=dict[str, Value])
    for key, value in found.items():
        if isinstance(value, str) and "\0" in value:
            raise ValueError(f"{key!r}: found a text with a zero byte; allowed: texts without")
    return found

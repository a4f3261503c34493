"""The format version in a file of ours: an older one is read, a newer one refused in one line."""

from __future__ import annotations

from typing import Any

import msgspec


class _Versioned(msgspec.Struct):
    format_version: int = 0


def decode(data: bytes, kind: Any, newest: int | None) -> Any:
    """JSON as that type; `newest` is the latest version of it that is known, None where it has none.

    Raises:
        msgspec.MsgspecError: it is nothing of the kind, or of a newer companion.
    """
    if newest is not None:
        version = msgspec.json.decode(data, type=_Versioned).format_version
        if version > newest:
            raise msgspec.ValidationError(
                f"found format {version}; allowed: up to {newest} (a newer companion has saved it)"
            )
    return msgspec.json.decode(data, type=kind)

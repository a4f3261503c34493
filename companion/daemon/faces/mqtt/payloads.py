"""What may be asked for over MQTT: the bytes of a request, judged."""

from __future__ import annotations

import difflib
from collections.abc import Callable
from typing import Final

import msgspec

from companion.calibration.request import What, is_time_limit
from companion.links.system.request import Object
from companion.printable import printable

Transaction = str | int | None

MAX_PAYLOAD_BYTES: Final = 4096
MAX_TRANSACTION: Final = 128
MAX_NUMBER: Final = 2**53
"""The largest integer that every reader of JSON keeps exactly."""
MAX_SHOWN: Final = 60


class Request(msgspec.Struct, frozen=True):
    """A request that can be asked of the daemon."""

    command: str
    transaction: Transaction
    content: Object
    """Everything but the transaction."""

    @property
    def question(self) -> Object:
        """In the words of the control socket."""
        return {"command": self.command, **self.content}


class Misfit(msgspec.Struct, frozen=True):
    """A request that is none, and why, in one line."""

    transaction: Transaction
    reason: str


def parse(command: str, payload: bytes) -> Request | Misfit:
    """Judge a request's payload: a JSON object with known keys, or nothing. Never raises."""
    if command not in KEYS:
        return Misfit(None, f"unknown request {command!r}; known: {', '.join(KEYS)}")
    if len(payload) > MAX_PAYLOAD_BYTES:
        return Misfit(None, f"a payload of {len(payload)} bytes; allowed: at most {MAX_PAYLOAD_BYTES}")
    try:
        content = msgspec.json.decode(payload) if payload.strip() else {}
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        why = "nested too deeply" if isinstance(error, RecursionError) else str(error)
        return Misfit(None, f"the payload is not JSON: {why}; allowed: a JSON object, or nothing")
    if not isinstance(content, dict):
        return Misfit(None, f"the payload is {_shown(content)}; allowed: a JSON object, or nothing")
    transaction = content.pop("transaction", None)
    if not _is_transaction(transaction):
        return Misfit(
            None,
            f"'transaction': found {_shown(transaction)}; allowed: a text of at most {MAX_TRANSACTION} characters, or a"
            " whole number",
        )
    for key, value in content.items():
        known = KEYS[command]
        if key not in known:
            near = difflib.get_close_matches(key[:MAX_SHOWN], known, n=1)
            hint = f"did you mean {near[0]!r}?" if near else f"known: {', '.join(('transaction', *known))}"
            return Misfit(transaction, f"unknown key {_shown(key)}; {hint}")
        fits, allowed = known[key]
        if not fits(value):
            return Misfit(transaction, f"{key!r}: found {_shown(value)}; allowed: {allowed}")
    return Request(command, transaction, content)


def _is_transaction(value: object) -> bool:
    if isinstance(value, str):
        return len(value) <= MAX_TRANSACTION
    return value is None or (isinstance(value, int) and not isinstance(value, bool) and abs(value) <= MAX_NUMBER)


def _shown(value: object) -> str:
    """A value as JSON, short enough for one line."""
    try:
        text = msgspec.json.encode(value).decode()
    except (OverflowError, RecursionError):
        return "what is too large"
    text = printable(text)
    return text if len(text) <= MAX_SHOWN else f"{text[:MAX_SHOWN]}..."


_WHAT: Final = [what.name.lower() for what in What]
_FLAG: Final = (lambda value: isinstance(value, bool), "true or false")

KEYS: Final[dict[str, dict[str, tuple[Callable[[object], bool], str]]]] = {
    "calibrate": {
        "what": (_WHAT.__contains__, ", ".join(f'"{what}"' for what in _WHAT)),
        "timeout_s": (is_time_limit, "a number of seconds above 0"),
        "reboot": _FLAG,
    },
    "cancel": {},
    "undo": {"force": _FLAG},
}
"""Of each request, beside its transaction: what fits, and what is allowed in words."""

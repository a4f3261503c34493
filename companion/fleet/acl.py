"""Access list of a broker: each aircraft publishes below its own name only, the collector only its answers.

No user of the list may publish below an aircraft's `request/`: the operator adds who may press its buttons.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Sequence
from typing import Final, Literal, NamedTuple

from companion.errors import ConfigError
from companion.fleet.contract import AIRCRAFT_ID

Broker = Literal["mosquitto", "emqx"]
COLLECTOR: Final = "collector"
_USER: Final = re.compile(r"[A-Za-z0-9._@-]{1,64}")
_WRITES: Final = (
    "fleet/{id}/hello",
    "fleet/{id}/item",
    "companion/{user}/status",
    "companion/{user}/state",
    "companion/{user}/calibration/state",
    "companion/{user}/calibration/progress",
    "companion/{user}/attitude",
    "companion/{user}/response/+",
)
_READS: Final = (
    "fleet/{id}/confirmed",
    "fleet/{id}/wanted",
    "companion/{user}/status",
    "companion/{user}/request/+",
)


class Right(NamedTuple):
    """Rights of one user; `user` None: rights of every user, with the user name in the topics."""

    user: str | None
    writes: tuple[str, ...]
    reads: tuple[str, ...]


def access_list(broker: Broker, aircraft: Sequence[str]) -> list[str]:
    """Make the lines of the file for aircraft given as "USER=ID"; none: every aircraft's user name is its id.

    Raises:
        ConfigError: one is no such pair, or an id has two users.
    """
    name, words = _BROKERS[broker]
    rights = [Right(COLLECTOR, ("fleet/+/confirmed", "fleet/+/wanted"), ("fleet/+/hello", "fleet/+/item"))]
    pairs: list[tuple[str | None, str]] = [*_pairs(aircraft)]
    for user, which in pairs or [(None, name)]:
        writes, reads = ([each.format(id=which, user=user or which) for each in topics] for topics in (_WRITES, _READS))
        rights.append(Right(user, tuple(writes), tuple(reads)))
    return words(rights)


def _pairs(aircraft: Iterable[str]) -> list[tuple[str, str]]:
    users: dict[str, str] = {}
    for words in aircraft:
        user, _, which = words.partition("=")
        if _USER.fullmatch(user) is None or user == COLLECTOR or AIRCRAFT_ID.fullmatch(which) is None:
            raise ConfigError(
                f"found {words[:80]!r}; allowed: USER=ID, a user name of letters, digits and . _ @ - (not {COLLECTOR}),"
                " and the aircraft's id of 16 or 36 hex digits (companion status --json has it under fleet)"
            )
        if users.setdefault(which, user) != user:
            raise ConfigError(f"found {words[:80]!r}; {which} is {users[which]}'s already: allowed: one user for each")
    return [(user, which) for which, user in users.items()]


def _mosquitto(rights: Iterable[Right]) -> list[str]:
    lines = ["# mosquitto.conf: allow_anonymous false, password_file FILE, acl_file THIS FILE"]
    for right in rights:
        lines += [] if right.user is None else [f"user {right.user}"]
        what = "pattern" if right.user is None else "topic"
        lines += [f"{what} write {topic}" for topic in right.writes]
        lines += [f"{what} read {topic}" for topic in right.reads]
    return lines


def _emqx(rights: Iterable[Right]) -> list[str]:
    lines = ["%% EMQX: this file as the only authorization source, and authorization.no_match = deny"]
    for right in rights:
        who = "all" if right.user is None else f'{{username, "{right.user}"}}'
        for verb, topics in (("publish", right.writes), ("subscribe", right.reads)):
            lines.append(f"{{allow, {who}, {verb}, {json.dumps(topics)}}}.")
    return [*lines, "{deny, all}."]


_BROKERS: Final[dict[Broker, tuple[str, Callable[[Iterable[Right]], list[str]]]]] = {
    "mosquitto": ("%u", _mosquitto),
    "emqx": ("${username}", _emqx),
}
"""Placeholder of the user name in topics, and writer of the file, by broker."""

"""Access list for the MQTT broker Mosquitto: an aircraft publishes under its own name only, the collector only answers.

No user of this list may publish under an aircraft's `request/`: the operator adds the users who may send requests.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from typing import Final

from companion.errors import ConfigError

COLLECTOR: Final = "collector"
AIRCRAFT_ID: Final = re.compile(r"[0-9a-f]{16}|[0-9a-f]{36}")
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


def access_list(aircraft: Sequence[str]) -> list[str]:
    """Make the access list's lines for aircraft given as "USER=ID"; without any, each aircraft's user name is its id.

    Raises:
        ConfigError: an entry is not USER=ID, or an id has two users.
    """
    lines = ["# mosquitto.conf: allow_anonymous false, password_file FILE, acl_file THIS FILE", f"user {COLLECTOR}"]
    lines += [f"topic write fleet/+/{what}" for what in ("confirmed", "wanted")]
    lines += [f"topic read fleet/+/{what}" for what in ("hello", "item")]
    for user, which in _pairs(aircraft):
        lines += [f"user {user}", *_rights("topic", user, which)]
    return lines if aircraft else [*lines, *_rights("pattern", "%u", "%u")]


def _rights(kind: str, user: str, which: str) -> list[str]:
    rights = (("write", _WRITES), ("read", _READS))
    return [f"{kind} {verb} {each.format(id=which, user=user)}" for verb, topics in rights for each in topics]


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

"""What of `companion status` goes to the topic `state`, and when it is worth a message."""

from __future__ import annotations

from typing import Final

from companion.links.system.request import Object

LEAST_S: Final = 1.0
SLOW_S: Final = 10.0
_COPIED = ("state", "reason", "progress", "waiting_for", "vehicle", "warnings", "fault", "putting_back", "last")
_ARMING = ("at_arm", "verdict", "words", "state", "in_force")


def summary(status: Object) -> Object:
    """The state as others show it: without the figures that change with every look."""
    return {
        **{key: status[key] for key in _COPIED},
        "arming": {key: status["arming"][key] for key in _ARMING},
        "devices": [
            {
                "name": device["name"],
                "kind": device["kind"],
                "good": device["good"],
                "problem": None if device["good"] else device["summary"],
            }
            for device in status["devices"]
        ],
    }


class Pace:
    """Says when a state is worth a message.

    At once when the state itself changes, within a second when anything else does; every ten seconds when only words
    change that tell how long ago something was.
    """

    def __init__(self) -> None:
        self._said: Object | None = None
        self._said_s = 0.0

    def is_due(self, state: Object, now_s: float) -> bool:
        """Whether to send it now; if so, it counts as sent."""
        said = self._said
        if said == state:
            return False
        due = (
            said is None
            or said["state"] != state["state"]
            or now_s - self._said_s >= (SLOW_S if _lasting(said) == _lasting(state) else LEAST_S)
        )
        if due:
            self._said, self._said_s = state, now_s
        return due


def _lasting(state: Object) -> Object:
    return {**state, "arming": {**state["arming"], "in_force": None, "words": None}}

"""Topics of one vehicle, and when its state is worth a message."""

from __future__ import annotations

from typing import Final

from companion.formats import Object

ONLINE = b"online"
OFFLINE = b"offline"
LEAST_S: Final = 1.0
SLOW_S: Final = 10.0
_COPIED = ("state", "reason", "progress", "waiting_for", "warnings", "fault", "putting_back", "last")
_ARMING = ("at_arm", "verdict", "words", "state", "in_force")
_VEHICLE = ("system_id", "firmware", "armed", "summary")


def summary(status: Object) -> Object:
    """Return the part of the status that is published as the state: no figures that change all the time."""
    return {
        **{key: status[key] for key in _COPIED},
        "vehicle": {key: status["vehicle"][key] for key in _VEHICLE},
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
        """Return whether to send a state now; then it counts as sent."""
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


class Topics:
    """All topics under one base, such as "companion/1"."""

    def __init__(self, base: str) -> None:
        self.base = base
        self.status = f"{base}/status"
        self.state = f"{base}/state"
        self.record = f"{base}/calibration/state"
        self.progress = f"{base}/calibration/progress"
        self.attitude = f"{base}/attitude"
        self.kept = (self.status, self.state, self.record)
        """Topics that the broker keeps."""
        self.request, self.response = f"{base}/request/", f"{base}/response/"
        """Topics of a request and its response, without the name of the command."""

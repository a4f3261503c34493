"""States, events and transitions of a calibration, as a table; docs/calibration.md shows them as a diagram."""

from __future__ import annotations

import enum
from typing import Final

LONGEST_S: Final = 1e6
"""Time limits in a request, s, must be below this value."""


class What(enum.Enum):
    """Sensors whose biases a calibration estimates; the numbers are param1 of the MAVLink command MAV_CMD_USER_1."""

    BOTH = 0
    GYROS = 1
    ACCELEROMETERS = 2

    @property
    def gyros(self) -> bool:
        return self is not What.ACCELEROMETERS

    @property
    def accelerometers(self) -> bool:
        return self is not What.GYROS


class State(enum.Enum):
    """State of a calibration."""

    IDLE = "idle"
    WAITING = "waiting"
    COLLECTING = "collecting"
    SOLVING = "solving"
    WRITING = "writing"
    VERIFYING = "verifying"
    RESTARTING = "restarting"
    SETTLING = "settling"
    UNDOING = "undoing"
    DONE = "done"
    FAILED = "failed"
    CANCELLED = "cancelled"

    @property
    def busy(self) -> bool:
        return self not in RESTING

    @property
    def is_writing(self) -> bool:
        """True while offsets are being written and not yet verified."""
        return self in _WRITING

    @property
    def shown(self) -> str:
        """Coarser name for other programs: restarting and settling appear as verifying, undoing as writing."""
        return _SHOWN.get(self, self).value

    @property
    def word(self) -> str:
        return _WORDS.get(self, self.value)


class Event(enum.Enum):
    """Event that changes the state of a calibration."""

    REQUEST = "request"
    UNDO = "undo"
    STILL = "still long enough"
    MOVED = "moved, or without the expected effect"
    ENOUGH = "measured enough"
    WRITE = "biases to write"
    NOTHING_TO_WRITE = "nothing to write"
    WRITTEN = "read back"
    VERIFIED = "seen in the telemetry"
    REBOOT = "seen, reboot wanted"
    CONCLUDED = "in force"
    FAULT = "fault"
    CANCEL = "cancel"


RESTING: Final = (State.IDLE, State.DONE, State.FAILED, State.CANCELLED)
_SHOWN: Final = {
    State.RESTARTING: State.VERIFYING,
    State.SETTLING: State.VERIFYING,
    State.UNDOING: State.WRITING,
}
_WORDS: Final = {
    State.COLLECTING: "measuring",
    State.SOLVING: "measuring",
    State.VERIFYING: "checking",
    State.RESTARTING: "restarting autopilot",
    State.UNDOING: "restoring",
}
_WRITING: Final = {State.WRITING, State.VERIFYING, *_SHOWN}

TRANSITIONS: Final[dict[tuple[State, Event], State]] = {
    **{(state, Event.REQUEST): State.WAITING for state in RESTING},
    **{(state, Event.UNDO): State.UNDOING for state in RESTING},
    (State.WAITING, Event.STILL): State.COLLECTING,
    (State.COLLECTING, Event.MOVED): State.WAITING,
    (State.COLLECTING, Event.ENOUGH): State.SOLVING,
    # An offset changed during the measurement: the readings are stale, measure again.
    (State.SOLVING, Event.MOVED): State.WAITING,
    (State.SOLVING, Event.WRITE): State.WRITING,
    (State.SOLVING, Event.NOTHING_TO_WRITE): State.DONE,
    (State.WRITING, Event.WRITTEN): State.VERIFYING,
    # The offsets act on another IMU than assumed: they were restored, and the right IMU is known now.
    (State.WRITING, Event.MOVED): State.WAITING,
    (State.VERIFYING, Event.VERIFIED): State.SETTLING,
    (State.VERIFYING, Event.REBOOT): State.RESTARTING,
    (State.RESTARTING, Event.VERIFIED): State.SETTLING,
    (State.SETTLING, Event.CONCLUDED): State.DONE,
    (State.UNDOING, Event.CONCLUDED): State.DONE,
    **{(state, Event.FAULT): State.FAILED for state in State if state not in RESTING},
    **{(state, Event.CANCEL): State.CANCELLED for state in State if state not in RESTING},
}


class IllegalEventError(Exception):
    """Error for an event that the present state does not allow: a fault of the program, never of a device."""


class Machine:
    """State machine of one calibration."""

    def __init__(self) -> None:
        self.state = State.IDLE

    def on(self, event: Event) -> State:
        """Handle an event; return the new state.

        Raises:
            IllegalEventError: the table has no transition for it.
        """
        try:
            self.state = TRANSITIONS[self.state, event]
        except KeyError:
            raise IllegalEventError(f"{event.name} cannot happen while {self.state.value}") from None
        return self.state

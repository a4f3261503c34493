"""Interfaces that the MAVLink component needs from the daemon: the calibration service and the arm gate.

The service decides whether a calibration may start; the component carries requests in and verdicts out.
"""

from __future__ import annotations

import asyncio
from typing import Final, Literal, Protocol

import msgspec

from companion.estimation.machine import What

MEASURED_PERCENT: Final = 70.0
"""Progress at which measuring ends, and estimating and writing begin."""
WRITTEN_PERCENT: Final = 80.0
"""Progress at which writing ends, and the check of the telemetry and the autopilot's settling begin."""


class Refusal(msgspec.Struct, frozen=True):
    """Refusal of a request; `reason` is one line for people and does not begin with "refused"."""

    kind: Literal["armed", "unknown", "busy", "nothing_to_undo", "unsupported", "other"]
    reason: str


class JobResult(msgspec.Struct, frozen=True):
    """End of a job; `reason` is one line for people (the figures when done)."""

    outcome: Literal["done", "failed", "cancelled"]
    reason: str = ""


class AcceptedJob(Protocol):
    """A running calibration or undo."""

    progress_percent: int
    """0 to 100; never falls."""
    finished: asyncio.Future[JobResult]


class CalibrationService(Protocol):
    """The calibration service. Every method returns at once.

    The service itself reports (`StatusText.say`) the start, the waiting and the outcome of a job, as jobs are also
    requested through other interfaces than MAVLink. The component reports refusals.
    """

    def start_calibration(self, what: What, requester: str, *, reboot: bool = False) -> AcceptedJob | Refusal: ...

    def start_undo(self, requester: str) -> AcceptedJob | Refusal: ...

    def cancel(self, requester: str) -> bool:
        """Cancel the running job, whoever requested it; return False if there was none."""

    @property
    def progress_percent(self) -> int:
        """Progress of the running calibration or undo; 100: none runs."""

    @property
    def mav_state(self) -> int:
        """MAV_STATE_* for the heartbeat: CALIBRATING while busy, ACTIVE or STANDBY when idle, CRITICAL on a fault."""


class ArmAnswer(msgspec.Struct, frozen=True):
    """The arm gate's answer at this moment.

    "accept": the aircraft may arm. "wait": it may soon, by itself or once held still. "refuse": somebody has to act
    first. `words` give reason and remedy, in at most 41 characters where possible (the length that ArduPilot shows).
    """

    verdict: Literal["accept", "wait", "refuse"]
    words: str
    hold_still_s: int | None = None
    """Time to hold still, if nothing else is needed."""
    meanwhile: str = ""  # Activity while the aircraft is held still
    against: str = ""
    """Reason why the aircraft counts as uncalibrated; empty: `words` give another reason against arming."""

    @classmethod
    def hold_still(cls, seconds: float, meanwhile: str = "", against: str = "") -> ArmAnswer:
        whole_s = max(1, round(seconds))
        words = f"hold still {whole_s} s"
        return cls("wait", f"{words}: {meanwhile}" if meanwhile else words, whole_s, meanwhile, against)


class ArmGate(Protocol):
    """The arm gate. Every method returns at once."""

    @property
    def at_arm(self) -> Literal["gate", "warn", "off"]: ...
    @property
    def asks_script(self) -> bool:
        """Return whether a script on the autopilot (ArduPilot) waits for the answer."""

    def answer(self) -> ArmAnswer: ...

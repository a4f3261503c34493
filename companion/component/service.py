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
"""Progress from which on the telemetry is watched for the new values, and the autopilot settles."""


class Refusal(msgspec.Struct, frozen=True):
    """Refusal of a request; `reason` is one line for people, without a leading "refused"."""

    kind: Literal["armed", "unknown", "busy", "nothing_to_undo", "unsupported", "other"]
    reason: str


class JobResult(msgspec.Struct, frozen=True):
    """End of a job; `reason` is one line for people (the figures when done)."""

    outcome: Literal["done", "failed", "cancelled"]
    reason: str = ""


class AcceptedJob(Protocol):
    """A calibration or an undo under way."""

    progress_percent: int
    """0 to 100; never falls."""
    finished: asyncio.Future[JobResult]


class CalibrationService(Protocol):
    """The calibration service. Every method returns at once.

    The service itself says (`StatusText.say`) that a job starts, what it waits for and how it ended, as jobs are also
    requested by others than MAVLink. The component says refusals.
    """

    def start_calibration(self, what: What, requester: str, *, reboot: bool = False) -> AcceptedJob | Refusal: ...

    def start_undo(self, requester: str) -> AcceptedJob | Refusal: ...

    def cancel(self, requester: str) -> bool:
        """Cancel the running job, whoever requested it; False where there was none."""

    @property
    def progress_percent(self) -> int:
        """Progress of the calibration or undo under way; 100 where none is."""

    @property
    def mav_state(self) -> int:
        """MAV_STATE_* for the heartbeat: CALIBRATING while busy, ACTIVE or STANDBY when idle, CRITICAL on a fault."""


class ArmAnswer(msgspec.Struct, frozen=True):
    """The arm gate's answer at this moment.

    "accept": it may arm. "wait": soon, by itself or by holding still. "refuse": not until somebody acts. `words` give
    reason and remedy, in at most 41 characters where possible (the length that ArduPilot shows).
    """

    verdict: Literal["accept", "wait", "refuse"]
    words: str
    hold_still_s: int | None = None
    """Time to hold still, where nothing else is needed."""
    meanwhile: str = ""  # Activity while it is held still
    against: str = ""
    """Reason why it would arm uncalibrated; empty where the reason is another."""

    @classmethod
    def hold_still(cls, seconds: float, meanwhile: str = "", against: str = "") -> ArmAnswer:
        whole_s = max(1, round(seconds))
        words = f"hold still {whole_s} s"
        return cls("wait", f"{words}: {meanwhile}" if meanwhile else words, whole_s, meanwhile, against)


class ArmGate(Protocol):
    """The arm gate; it answers at once."""

    @property
    def at_arm(self) -> Literal["gate", "warn", "off"]: ...
    @property
    def asks_script(self) -> bool:
        """Return whether a script on the autopilot (ArduPilot) waits for the answer."""

    def answer(self) -> ArmAnswer: ...

"""What the component needs from the rest of the house: someone who calibrates, and who knows whether it may arm.

Whether the aircraft is armed, and everything else that decides if a calibration may start, is the service's to
know; the component carries requests in and verdicts out.
"""

from __future__ import annotations

import asyncio
from typing import Final, Literal, Protocol

import msgspec

from companion.estimation.request import What

MEASURED_PERCENT: Final = 70.0
"""Progress of a calibration: below this it measures, from here on it works out and writes."""
WRITTEN_PERCENT: Final = 80.0
"""From here on it watches the telemetry take the new values, and the autopilot settle."""


class Refusal(msgspec.Struct, frozen=True):
    """Why a request was not taken; `reason` is one line for people, without a leading "refused"."""

    kind: Literal["armed", "unknown", "busy", "nothing_to_undo", "other"]
    reason: str


class JobResult(msgspec.Struct, frozen=True):
    """How a job ended; `reason` is one line for people (the figures when done)."""

    outcome: Literal["done", "failed", "cancelled"]
    reason: str = ""


class AcceptedJob(Protocol):
    """A calibration or an undo under way."""

    @property
    def progress_percent(self) -> int:
        """0 to 100; never falls."""

    @property
    def finished(self) -> asyncio.Future[JobResult]:
        """Done once, with the result."""


class CalibrationService(Protocol):
    """Who calibrates. Every method returns at once: it neither waits nor computes for long.

    The service itself says (`StatusText.say`) that a job starts, what it waits for and how it ended, as jobs are
    asked for by others than MAVLink too. The component says refusals, which only it can tell.
    """

    def start_calibration(self, what: What, requester: str, *, reboot: bool = False) -> AcceptedJob | Refusal:
        """Start measuring, and restart the autopilot when the result is stored if asked to; or say why not."""

    def start_undo(self, requester: str) -> AcceptedJob | Refusal:
        """Start putting the previous values back, or say why not."""

    def cancel(self, requester: str) -> bool:
        """Cancel what runs, whoever asked for it; whether something was running."""

    @property
    def progress_percent(self) -> int:
        """Of the calibration or undo under way; 100 where none is."""

    @property
    def mav_state(self) -> int:
        """MAV_STATE_* for the heartbeat: CALIBRATING while busy, ACTIVE or STANDBY when idle, CRITICAL on a fault."""


class ArmAnswer(msgspec.Struct, frozen=True):
    """Whether the aircraft may arm at this moment.

    "accept": yes. "wait": not now, but soon, by itself or by holding still. "refuse": not without somebody doing
    something. `words` say why and what to do, in at most 41 characters where possible (what ArduPilot shows).
    """

    verdict: Literal["accept", "wait", "refuse"]
    words: str
    hold_still_s: int | None = None
    """How long to hold still, where nothing else is needed."""
    meanwhile: str = ""
    """What goes on while it is held still."""

    @classmethod
    def hold_still(cls, seconds: float, meanwhile: str = "") -> ArmAnswer:
        """That it may arm when it has stood still for so long."""
        whole_s = max(1, round(seconds))
        words = f"hold still {whole_s} s"
        return cls("wait", f"{words}: {meanwhile}" if meanwhile else words, whole_s, meanwhile)


class ArmGate(Protocol):
    """Who knows whether the aircraft may arm. Both return at once, whatever else goes on."""

    @property
    def at_arm(self) -> Literal["gate", "warn", "off"]:
        """What is to happen at arming."""

    @property
    def asks_script(self) -> bool:
        """Whether a script on the autopilot may be waiting for the answer, as on ArduPilot."""

    def answer(self) -> ArmAnswer:
        """The answer, ready made."""

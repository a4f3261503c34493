"""Interfaces that the MAVLink component needs from the daemon: the calibration service and the arm gate.

The service decides whether a calibration may start; the component receives requests and sends the decisions.
"""

from __future__ import annotations

import asyncio
from typing import Final, Literal, Protocol

import msgspec

from companion.estimation.machine import What

MEASURED_PERCENT: Final = 70.0
"""Progress of a calibration, in percent, at which the measurement ends, and estimating and writing begin."""
WRITTEN_PERCENT: Final = 80.0
"""Progress of a calibration, in percent, at which writing ends and the check of the autopilot's output begins."""


class Refusal(msgspec.Struct, frozen=True):
    """Refusal of a request; `reason` is one line for people, without the prefix "refused"."""

    kind: Literal["armed", "unknown", "busy", "nothing_to_undo", "unsupported", "other"]
    reason: str


class JobResult(msgspec.Struct, frozen=True):
    """Result of a calibration or undo; `reason` is one line for people (after success: the estimated figures)."""

    outcome: Literal["done", "failed", "cancelled"]
    reason: str = ""


class AcceptedJob(Protocol):
    """A calibration or undo that was accepted and now runs."""

    progress_percent: int
    """Progress of the job, from 0 to 100; it never decreases."""
    finished: asyncio.Future[JobResult]


class CalibrationService(Protocol):
    """Starts and cancels calibrations and undos. Every method returns at once, without waiting for the job.

    The service itself reports the start, the waiting and the outcome of a job (`StatusText.say`): jobs also come from
    other interfaces than MAVLink. The component reports refusals.
    """

    def start_calibration(self, what: What, requester: str, *, reboot: bool = False) -> AcceptedJob | Refusal: ...

    def start_undo(self, requester: str) -> AcceptedJob | Refusal: ...

    def cancel(self, requester: str) -> bool:
        """Cancel the running job, whoever requested it; return False if there was none."""

    @property
    def progress_percent(self) -> int:
        """Progress of the running calibration or undo in percent; 100 also if no job runs."""

    @property
    def mav_state(self) -> int:
        """MAV_STATE for our heartbeat: CALIBRATING during a job, ACTIVE or STANDBY when idle, CRITICAL on a fault."""


class ArmAnswer(msgspec.Struct, frozen=True):
    """Answer to the question whether the aircraft may arm now.

    "accept": the aircraft may arm. "wait": it may arm soon, perhaps after it was held motionless. "refuse":
    somebody has to act first. `words`: reason and remedy, if possible within the 41 characters that ArduPilot shows.
    """

    verdict: Literal["accept", "wait", "refuse"]
    words: str
    hold_still_s: int | None = None
    """Remaining seconds for which the aircraft must be held motionless; None: something else is needed."""
    meanwhile: str = ""  # Activity of the companion while the aircraft is held motionless
    against: str = ""
    """Reason why the aircraft counts as uncalibrated; empty if another reason, or none, prevents arming."""

    @classmethod
    def hold_still(cls, seconds: float, meanwhile: str = "", against: str = "") -> ArmAnswer:
        whole_s = max(1, round(seconds))
        words = f"hold still {whole_s} s"
        return cls("wait", f"{words}: {meanwhile}" if meanwhile else words, whole_s, meanwhile, against)


class ArmGate(Protocol):
    """Decides whether the aircraft may arm. Every method returns at once."""

    @property
    def at_arm(self) -> Literal["gate", "warn", "off"]: ...
    @property
    def asks_script(self) -> bool:
        """True if our arming script on the autopilot (ArduPilot) waits for the gate's answer."""

    def answer(self) -> ArmAnswer: ...

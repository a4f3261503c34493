"""Headline: the daemon's state in a word or two with its reason, shown first by the web page and the monitor."""

from __future__ import annotations

import asyncio
from typing import Final, Literal

from companion.autopilot.vehicle.vehicle import ArmState
from companion.component.service import ArmAnswer
from companion.daemon.arming.in_force import NOT_CONFIRMED
from companion.daemon.arming.readiness import BY_ITSELF, NEEDED
from companion.daemon.arming.subsystem import Arming
from companion.daemon.calibrating.manager import Precondition
from companion.daemon.calibrating.subsystem import Calibrating
from companion.daemon.core import Core
from companion.daemon.devices.subsystem import Devices
from companion.daemon.heading.subsystem import Heading
from companion.daemon.interfaces.diagnosis import Diagnosis
from companion.daemon.job import Job
from companion.daemon.offsets.effect import TELEMETRY
from companion.estimation.machine import State
from companion.formats import Object
from companion.messages import catalogue, explain, message

ARMED: Final = "ARMED"
GYROS_NOT_RESET: Final = "firmware_gyro_calibration_failed"  # Warning of a calibration, in the message catalogue
Tone = Literal["good", "wait", "busy", "bad"]
"""Tone: good (ready to fly), wait (be patient or hold still), busy (the companion works), bad (somebody must act)."""

Headline = tuple[str, str, Tone]  # One to three words, the reason in one line, and the tone


class Headlines:
    """Composes the headline that all interfaces show."""

    def __init__(
        self, core: Core, devices: Devices, calibrating: Calibrating, arming: Arming, heading: Heading,
        diagnosis: Diagnosis,
    ) -> None:  # fmt: skip
        self._vehicle, self._collector, self._manager = core.vehicle, core.collector, arming.manager
        self._readiness, self._automatic, self._armings = arming.readiness, arming.automatic, arming.armings
        self._devices, self._heading, self._warm_up = devices, heading, arming.warm_up
        self._alignment, self._diagnosis = calibrating.alignment, diagnosis

    def now(self) -> Object:
        word, reason, tone = self._now()
        remedy = None
        first = next((each for each in self._diagnosis.findings if each["remedy"]), None)
        # A reason against arming that passes by itself hides no other fault.
        if first is not None and (word == "READY" or (word in ("NOT CALIBRATED", "NOT READY") and not first["waits"])):
            word, reason, tone = "WILL NOT ARM", first["line"], "wait" if first["waits"] else "bad"
            remedy = first["remedy"]
        devices = self._devices
        contradicted = self._alignment.warning if self._alignment.contradicted else None
        concern = devices.watch.implausible() or contradicted or devices.signing.warning or self._heading.concern
        warnings = () if (record := self._readiness.in_force.calibration) is None else record.warnings
        concern = concern or next((one for one in warnings if (explain(one) or one)[0] == GYROS_NOT_RESET), None)
        if concern is not None and (tone == "good" or word == ARMED):
            reason, tone = f"{concern}; {reason}", "wait" if tone == "good" else tone
        if remedy is None and word == ARMED and tone != "good" and concern is None:
            remedy = catalogue()["armed_uncalibrated"].remedy
        elif remedy is None:
            explained = explain(reason) if tone in ("bad", "wait") and reason != BY_ITSELF else None
            remedy = "" if explained is None else explained[1].remedy
        if (left := self._warm_up.words()) is not None and word.startswith(("HOLD STILL", "NOT ", "WAIT")):
            reason = f"{reason}; {left}"
        return {"word": word, "reason": reason, "tone": tone, "remedy": remedy}

    def _now(self) -> Headline:
        now_s = asyncio.get_running_loop().time()
        manager, job = self._manager, self._manager.running
        unmet, reason = manager.blocking_reason() or (None, "")
        if unmet is Precondition.STORAGE:
            return "FAULT", reason, "bad"
        if unmet is Precondition.ONE_AUTOPILOT:
            return "TWO AUTOPILOTS", reason, "bad"
        if job is not None:
            return self._working(job, now_s)
        if unmet is Precondition.ARM_STATE_KNOWN:
            return self._no_autopilot()
        # Armed or not: with another companion at work, nothing is restored.
        if (first := manager.blocking_reason(NEEDED)) is not None and first[0] is Precondition.RESTORED:
            return "RESTORING", "an interrupted write is being restored", "busy"
        state, words = self._readiness.state(now_s)
        if unmet is Precondition.DISARMED:
            if state != "uncalibrated":
                return ARMED, words, "good"
            if not self._armings.seen_disarmed and self._readiness.in_force.earlier is not None:
                return ARMED, f"companion started in flight: {words}", "wait"
            return ARMED, words if words.startswith("not calibrated") else f"not calibrated: {words}", "bad"
        if unmet is not None:
            return "TWO COMPANIONS", reason, "bad"
        if self._readiness.at_arm == "gate":
            return self._by_answer(self._readiness.answer())
        if state != "uncalibrated":
            return "READY", words, "good"
        return self._uncalibrated(words, self._readiness.judge(now_s))

    def _no_autopilot(self) -> Headline:
        age_s = self._vehicle.heartbeat_age_s
        if age_s is None:
            return "NO AUTOPILOT", self._devices.not_heard, "bad"
        why = self._devices.signing.rejecting or "power? cable?"
        return "NO AUTOPILOT", message("no_heartbeat_for", seconds=f"{age_s:.0f}", remedy=why), "bad"

    def _working(self, job: Job, now_s: float) -> Headline:
        state = self._manager.state
        words = job.words or state.word
        if job.cancelled_by is not None:
            return "CANCELLING", words, "busy"
        if state is State.UNDOING:
            return state.word.upper(), "the old values are being written", "busy"
        moves = self._collector.glance(now_s).moves
        if state is State.VERIFYING and moves is not None and job.words != TELEMETRY:
            return "HOLD STILL", moves, "wait"
        if state is not State.WAITING:
            percent = f" {job.progress_percent} %" if job.act is None and state is not State.SETTLING else ""
            return f"{state.word.upper()}{percent}", words, "busy"
        if self._vehicle.arm_state is ArmState.UNKNOWN:
            return self._no_autopilot()
        if job.hold_still_s is not None:
            return _hold_still(job.hold_still_s)
        if job.act:
            return job.act, words, "wait"
        if self._collector.glance(now_s).moving:
            return "HOLD STILL", words, "wait"
        return "WAITING", words, "wait"

    def _by_answer(self, answer: ArmAnswer) -> Headline:
        if answer.verdict == "accept":
            return "READY", answer.words, "good"
        if answer.hold_still_s is not None:
            return _hold_still(answer.hold_still_s, answer.meanwhile)
        if answer.verdict == "wait":
            return "WAIT", answer.words.removeprefix("wait: "), "wait"
        return self._failed() or ("NOT READY", answer.words, "bad")

    def _uncalibrated(self, words: str, answer: ArmAnswer) -> Headline:
        if answer.verdict == "wait":
            return self._by_answer(answer)
        if words == self._readiness.owed.words:
            return "NOT READY", words, "bad"
        in_force, todo = self._readiness.in_force, self._automatic.why_not()
        if (in_force.held_back is None and todo is None) or (answer.verdict == "refuse" and not answer.against):
            return "NOT CALIBRATED", answer.words, "bad"
        if words == NOT_CONFIRMED and (kept_from := in_force.kept_from) is not None:
            words += f" (the autopilot has the offsets of {kept_from})"
        words = words if in_force.held_back is not None or todo == words else f"{words}: {todo}"
        return self._failed() or ("NOT CALIBRATED", words, "bad")

    def _failed(self) -> Headline | None:
        return ("FAILED", self._manager.reason, "bad") if self._manager.state is State.FAILED else None


def _hold_still(seconds: int, meanwhile: str = "") -> Headline:
    return f"HOLD STILL {seconds} s", meanwhile or "measuring begins then", "wait"

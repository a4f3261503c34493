"""The state as one big word with its reason: what the page and the monitor show first, readable from two steps away.

Worked out here once, so that everybody who looks sees the same word.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Final, Literal

import msgspec

from companion.autopilot.vehicle.vehicle import ArmState
from companion.daemon.arming.readiness import BY_ITSELF
from companion.daemon.arming.subsystem import Arming
from companion.daemon.calibrating.manager import CalibrationManager
from companion.daemon.calibrating.why_not import Rung
from companion.daemon.core import Core
from companion.daemon.devices.subsystem import Devices
from companion.daemon.job import Job
from companion.daemon.offsets.effect import TELEMETRY
from companion.estimation.machine import State

if TYPE_CHECKING:
    from companion.daemon.heading.attitude_service import AttitudeService

ARMED: Final = "ARMED"
Tone = Literal["good", "wait", "busy", "bad"]
"""good: may fly. wait: the pilot's patience. busy: the companion works. bad: somebody has to do something."""


class Headline(msgspec.Struct, frozen=True):
    """One word, or three at most; why, in one line; and how it looks."""

    word: str
    reason: str
    tone: Tone


class Headlines:
    """Works out the headline from those who know; computes little."""

    def __init__(
        self,
        core: Core,
        devices: Devices,
        manager: CalibrationManager,
        arming: Arming,
        attitude: AttitudeService | None,
    ) -> None:
        self._vehicle, self._collector, self._manager = core.vehicle, core.collector, manager
        self._readiness, self._automatic, self._armings = arming.readiness, arming.automatic, arming.armings
        self._devices, self._attitude = devices, attitude
        self._on_deck = core.config.vehicle.platform == "deck"

    def now(self) -> Headline:
        """The headline of this moment."""
        headline = self._now()
        good = headline.tone == "good"
        concern = self._concern() if good or headline.word == ARMED else None
        if concern is None:
            return headline
        return Headline(headline.word, f"{concern}; {headline.reason}", "wait" if good else headline.tone)

    def _concern(self) -> str | None:
        attitude = None if self._attitude is None else self._attitude.concern
        return self._devices.watch.implausible() or self._devices.signing.warning or attitude

    def _now(self) -> Headline:
        now_s = asyncio.get_running_loop().time()
        job, obstacle = self._manager.running, self._manager.why_not()
        rung = obstacle.rung if obstacle is not None else None
        if obstacle is not None and rung is Rung.FAULT:
            return Headline("FAULT", obstacle.words, "bad")
        if obstacle is not None and rung is Rung.CONFLICT:
            return Headline("TWO AUTOPILOTS", obstacle.words, "bad")
        if job is not None:
            return self._working(job, now_s)
        if rung is Rung.UNKNOWN:
            return self._no_autopilot()
        if self._manager.why_not((Rung.PENDING,)) is not None:
            return Headline("PUTTING BACK", "an interrupted write is being put back", "busy")
        state, words = self._readiness.state(now_s)
        if rung is Rung.ARMED:
            if state == "uncalibrated":
                if not self._armings.seen_disarmed and self._readiness.in_force.earlier is not None:
                    return Headline(ARMED, f"companion started in flight: {words}", "wait")
                return Headline(ARMED, f"not calibrated: {words}", "bad")
            return Headline(ARMED, words, "good")
        if (second := self._manager.why_not((Rung.SECOND,))) is not None:
            return Headline("TWO COMPANIONS", second.words, "bad")
        if self._readiness.at_arm == "gate":
            return self._gate()
        if state != "uncalibrated":
            return Headline("READY", words, "good")
        return self._uncalibrated(words, now_s)

    def _no_autopilot(self) -> Headline:
        age_s = self._vehicle.heartbeat_age_s
        if age_s is None:
            return Headline("NO AUTOPILOT", self._devices.not_heard, "bad")
        why = self._devices.signing.rejecting or "power? cable?"
        return Headline("NO AUTOPILOT", f"no heartbeat for {age_s:.0f} s: {why}", "bad")

    def _working(self, job: Job, now_s: float) -> Headline:
        state = self._manager.state
        words = job.words or state.word
        if job.cancelled:
            return Headline("CANCELLING", words, "busy")
        if state is State.UNDOING:
            return Headline(state.word.upper(), "the old values are being written", "busy")
        if state is State.SETTLING:
            return Headline(state.word.upper(), words, "busy")
        moves = self._collector.glance(now_s).moves
        if state is State.VERIFYING and moves is not None and job.words != TELEMETRY:
            return Headline("HOLD STILL", moves, "wait")
        if state is not State.WAITING:
            return Headline(f"{state.word.upper()} {job.progress_percent} %", words, "busy")
        if self._vehicle.arm_state is ArmState.UNKNOWN:
            return self._no_autopilot()
        if job.hold_still_s is not None:
            return _hold_still(job.hold_still_s)
        if self._collector.glance(now_s).moving:
            return Headline("HOLD STILL", words, "wait")
        return Headline("WAITING", words, "wait")

    def _gate(self) -> Headline:
        answer = self._readiness.answer()
        if answer.verdict == "accept":
            return Headline("READY", answer.words, "good")
        if answer.hold_still_s is not None:
            return _hold_still(answer.hold_still_s, answer.meanwhile)
        if answer.verdict == "wait":
            return Headline("WAIT", answer.words.removeprefix("wait: "), "wait")
        return self._failed() or Headline("NOT READY", answer.words, "bad")

    def _uncalibrated(self, words: str, now_s: float) -> Headline:
        if (reading := self._readiness.in_force.reading()) is not None:
            return Headline("WAIT", reading, "wait")
        if (looked_at := self._readiness.looked_at(now_s)) is not None and looked_at.hold_still_s is not None:
            return _hold_still(looked_at.hold_still_s, looked_at.meanwhile)
        if words == self._readiness.owed:
            return Headline("NOT READY", words, "bad")
        if self._readiness.in_force.held_back is not None:
            return self._failed() or Headline("NOT CALIBRATED", words, "bad")
        todo = self._automatic.why_not()
        if todo is not None:
            return self._failed() or Headline("NOT CALIBRATED", f"{words}: {todo}" if todo != words else words, "bad")
        glance = self._collector.glance(now_s)
        if glance.obstacle is not None and not glance.moving:
            # The sensor's own trouble says what to do; that nothing comes from it is only what follows.
            return Headline("NOT CALIBRATED", self._devices.watch.worst() or glance.obstacle.words, "bad")
        if glance.obstacle is not None:
            if (hold_s := glance.obstacle.hold_still_s) is not None:
                return _hold_still(hold_s)
            return Headline("HOLD STILL", glance.obstacle.words, "wait")
        if self._on_deck:
            return Headline("WAIT", f"{words}: {self._collector.status(now_s).measuring}", "wait")
        left_s = self._readiness.until_calibrated_s(now_s)
        return Headline(f"HOLD STILL {left_s:.0f} s", f"{words}: {BY_ITSELF}", "wait")

    def _failed(self) -> Headline | None:
        if self._manager.state is not State.FAILED:
            return None
        return Headline("FAILED", self._manager.reason, "bad")


def _hold_still(seconds: int, meanwhile: str = "") -> Headline:
    return Headline(f"HOLD STILL {seconds} s", meanwhile or "measuring begins then", "wait")

"""Answer to arming requests, with its reason, prepared four times a second.

PX4's commander thread stops until the answer arrives (docs/reference/autopilots.md section 5.2). Therefore a request
causes no computation, read or wait. `Readiness._reasons` lists the reasons against arming in the order in which they
are reported, with or without a gate.
"""

from __future__ import annotations

import asyncio
import logging
import math
from collections.abc import Iterator
from typing import Final, Literal

from companion.autopilot.vehicle.ekf import ADJUSTING
from companion.component.service import ArmAnswer
from companion.config.sections import AtArm
from companion.daemon.arming.automatic import Automatic
from companion.daemon.arming.in_force import ActiveCalibration
from companion.daemon.calibrating.manager import Precondition
from companion.daemon.core import Core
from companion.daemon.offsets.effect import LOOK_S
from companion.daemon.offsets.reboot import RequiredReboot
from companion.estimation.machine import State
from companion.estimation.records.record import sigma_texts
from companion.estimation.records.validity import Why
from companion.physics.units import DEG_H, MG
from companion.protocols.stream_health import SILENT_AFTER_S
from companion.samples import Triad

logger = logging.getLogger(__name__)

POLL_S: Final = 0.25
BY_ITSELF: Final = "calibrates by itself"
STEADY_S: Final = 2.0
"""Time for which the aircraft must be motionless after somebody has let go of it, before arming is allowed."""
COUNTDOWN_KEPT_S: Final = 2.0  # Age of a countdown beyond which the next one may be higher
OLDEST_ANSWER_S: Final = 1.5  # Age at which an answer that was not updated is void
_STEPS: Final[dict[State, str]] = {
    State.WRITING: "writing offsets",
    State.VERIFYING: "checking new offsets",
    State.RESTARTING: "restarting autopilot",
    State.SETTLING: ADJUSTING,
    State.UNDOING: "restoring old offsets",
}
_CHECKED_NEXT: Final[dict[Why, str]] = {Why.REBOOTED: "checking after restart", Why.UNSEEN: _STEPS[State.VERIFYING]}
"""Findings that the next window without motion can clear without a new calibration, with their messages."""
NEEDED: Final = tuple(one for one in Precondition if one not in (Precondition.IDLE, Precondition.DISARMED))
"""Preconditions without which the arm gate refuses, whatever calibration is active."""
_WAITS: Final = {
    Precondition.ARM_STATE_KNOWN: "no heartbeat from the autopilot",
    Precondition.RESTORED: f"{_STEPS[State.UNDOING]}: wait",
}
NO_FACES: Final = "accel not calibrated: companion align faces --write"
AGES_APART_S: Final = 180.0  # Difference of two ages beyond which both are shown
LATE_S: Final = 2.0
"""Longest delay before telemetry is checked: the check uses only complete one-second intervals."""

ArmedState = Literal["calibrated", "checked", "uncalibrated"]


class Readiness:
    """Arm gate: its answer to arming requests, with the reason; `run` updates it."""

    def __init__(self, core: Core, owed: RequiredReboot, in_force: ActiveCalibration, automatic: Automatic) -> None:
        self._vehicle, self._collector, self._manager = core.vehicle, core.collector, in_force.manager
        self._wanted, self._on_deck = core.wanted, core.config.vehicle.platform == "deck"
        by_autopilot = any(imu.source == "autopilot" for imu in core.config.imu)
        self._by_hand = core.config.gradienter is None and by_autopilot and not self._on_deck
        self._min_still_s = core.config.calibration.min_still_s
        self.in_force, self._automatic, self.owed = in_force, automatic, owed
        self._answer = ArmAnswer("wait", "companion is starting")
        self._began_s, self._answered_s = math.inf, -math.inf
        self._countdown = -math.inf, math.inf
        """Latest countdown to a calibration: event-loop time of its computation, and seconds left at that time."""
        self._has_gated = False
        self.turns = 0

    @property
    def at_arm(self) -> AtArm:
        return self._wanted.at_arm

    @property
    def asks_script(self) -> bool:
        """Return whether ArduPilot's gate script gets the answer: once the gate was on, even if it is off now."""
        self._has_gated |= self.at_arm == "gate"
        return self._has_gated and self._vehicle.kind.gate_is_script

    def answer(self) -> ArmAnswer:
        if asyncio.get_running_loop().time() - self._answered_s > OLDEST_ANSWER_S:
            return ArmAnswer("wait", "companion is busy: try again")
        if self._manager.state.is_writing and self._answer.verdict == "accept":
            return ArmAnswer("wait", f"{_STEPS[self._manager.state]}: wait")
        return self._answer

    async def run(self) -> None:
        loop = asyncio.get_running_loop()
        while True:
            try:
                self.update()
                await asyncio.sleep(0)  # answer a request that has arrived meanwhile
                # Readings made during a write do not show the effect of the new offsets.
                if not self._writing and await self._measured(loop.time()):
                    self.update()
                self.turns += 1
            except Exception:
                # Without an updated answer the gate closes by itself.
                logger.exception("looking whether it may arm failed")
            await asyncio.sleep(POLL_S)

    async def _measured(self, now_s: float) -> bool:
        """Run `ActiveCalibration.measure`, which takes seconds on a ship's deck; keep updating the answer meanwhile."""
        measuring = asyncio.ensure_future(self.in_force.measure(now_s))
        try:
            while not (await asyncio.wait((measuring,), timeout=POLL_S))[0]:
                self.update()
        finally:
            measuring.cancel()
        return measuring.result()

    def update(self) -> None:
        now_s = asyncio.get_running_loop().time()
        self._began_s = min(self._began_s, now_s)
        self.in_force.poll(writing=self._writing)
        if self.at_arm == "gate":
            self._answer = self.judge(now_s)
        else:
            # Without a gate the answer gives the state in which the aircraft would arm.
            state, words = self.state(now_s)
            self._answer = ArmAnswer("wait" if state == "uncalibrated" else "accept", words)
        self._answered_s = now_s

    @property
    def _writing(self) -> bool:
        return self._manager.blocking_reason((Precondition.IDLE, Precondition.RESTORED)) is not None

    def judge(self, now_s: float) -> ArmAnswer:
        """Return the answer that an arm gate gives at this moment, even if the gate is off."""
        answer = next(self._reasons(now_s), None) or ArmAnswer("accept", self.state(now_s)[1])
        if not self._on_deck or answer.hold_still_s is None:
            return answer
        # On a deck, "hold still" is no advice: nobody can hold a deck still.
        status, meanwhile = self._collector.status(now_s), "" if answer.meanwhile == BY_ITSELF else answer.meanwhile
        return ArmAnswer("wait", f"wait: {meanwhile or status.left or status.measuring}")

    def _reasons(self, now_s: float) -> Iterator[ArmAnswer]:
        """Yield the reasons against arming in the order in which they are reported; none: the aircraft may arm."""
        if (unmet := self._manager.blocking_reason(NEEDED)) is not None:
            wait = _WAITS.get(unmet[0])
            yield ArmAnswer("refuse", unmet[1]) if wait is None else ArmAnswer("wait", wait)
        if self.at_arm == "gate" and not self._wanted.push:
            yield ArmAnswer("refuse", "writing is off (CMP_PUSH): no gate")
        if self._manager.state.is_writing:
            yield self._during_write(now_s)
        glance = self._collector.glance(now_s)
        if (reading := self.in_force.reading()) is not None:  # meanwhile no sample of the IMU counts
            reading = f"{Why.UNDONE.value}; {reading}" if self.in_force.undone else reading
            yield ArmAnswer("wait", reading, against=reading)
        if glance.obstacle is not None and not glance.moving:
            is_starting = now_s < self._began_s + SILENT_AFTER_S
            yield ArmAnswer("wait" if is_starting else "refuse", glance.obstacle.words)
        if findings := self.in_force.findings(now_s):
            first, remedy = findings[0], self._automatic.why_not()
            if not self.in_force.measured and all(finding.why in _CHECKED_NEXT for finding in findings):
                left_s = self._wanted.settings.min_still_s + 1.0 - glance.still_s
                yield ArmAnswer.hold_still(left_s, _CHECKED_NEXT[first.why], first.words)
            elif remedy is None:
                yield ArmAnswer.hold_still(self._until_calibrated_s(now_s), BY_ITSELF, first.words)
            else:
                yield ArmAnswer("refuse", f"{first.words}: {remedy}", against=first.words)
        if self.owed.words is not None:
            yield ArmAnswer("refuse", self.owed.words, against=self.owed.words)
        if glance.moving or glance.steady_s < STEADY_S:
            yield ArmAnswer.hold_still(STEADY_S - glance.steady_s)

    def _until_calibrated_s(self, now_s: float) -> float:
        status, write_s = self._collector.status(now_s), math.ceil(self._vehicle.kind.write_s + self._check_s)
        if status.enough:
            return write_s
        # Until the noise is known, expect the longest duration.
        whole_s = status.still_s / status.progress if status.progress > 0.0 else self._wanted.settings.max_s
        left_s: float = max(1, math.ceil(whole_s - status.still_s)) + write_s
        named_at_s, named_s = self._countdown
        # Only a movement may raise the countdown.
        if self._collector.glance(now_s).moves is None and now_s - named_at_s < COUNTDOWN_KEPT_S:
            left_s = min(left_s, named_s)
        self._countdown = now_s, left_s
        return left_s

    @property
    def _check_s(self) -> float:
        """Expected time from a write of offsets until its effect is seen and the EKF has settled."""
        kind = self._vehicle.kind
        return kind.settle_s + min(self._min_still_s, LOOK_S) + LATE_S + kind.ekf_reset_s

    def _during_write(self, now_s: float) -> ArmAnswer:
        state, job = self._manager.state, self._manager.running
        words, left_s = _STEPS[state], 0.0 if job is None else math.ceil(job.left_s)
        if state is State.VERIFYING:
            return ArmAnswer.hold_still(self._check_s - self._collector.glance(now_s).still_s, words, words)
        return ArmAnswer("wait", f"{words}: {left_s} s at most" if left_s else f"{words}: wait", against=words)

    def state(self, now_s: float) -> tuple[ArmedState, str]:
        state, words = self._state(now_s)
        held_back = self.in_force.held_back
        if held_back is None or self._manager.state.is_writing:
            return state, words
        return state, "; ".join(filter(None, (words, held_back, "calibrate to write it")))

    def _state(self, now_s: float) -> tuple[ArmedState, str]:
        """Return the state of the offsets with its text, ignoring the gate's other reasons (motion, link ...)."""
        in_force = self.in_force
        if against := next((one.against for one in self._reasons(now_s) if one.against), None):
            return "uncalibrated", against
        if in_force.calibrated_s is not None:
            return "calibrated", self._figures(now_s, "calibrated", in_force.worst("gyro")[1] or in_force.calibrated_s)
        if in_force.confirmed_s is not None:
            return "checked", self._figures(now_s, "offsets checked", in_force.confirmed_s)
        return "uncalibrated", "not calibrated yet" if in_force.held_back is None else ""

    def _figures(self, now_s: float, words: str, since_s: float) -> str:
        """Format age and sigmas of the active calibration; the accelerometers' own age if it differs by minutes."""
        in_force = self.in_force
        (gyro, _), (accel, accel_s) = in_force.worst("gyro"), in_force.worst("accel")
        parts = [f"{words} {_ago(now_s - since_s)}", *sigma_texts(gyro, accel)]
        if accel_s is not None and abs(accel_s - since_s) > AGES_APART_S:
            parts[-2:] = [f"{parts[-2]}; accel {_ago(now_s - accel_s)}", parts[-1]]
        lacks = f"; {NO_FACES}" if accel is None and self._by_hand else ""
        return ", ".join(parts) + lacks

    def _quality(self, triad: Triad, unit: float) -> dict[str, object]:
        sigma, settings = self.in_force.sigma(triad), self._wanted.settings
        wanted = settings.target_gyro_sigma_rad_s if triad == "gyro" else settings.target_accel_sigma_m_s2
        return {
            "sigma": None if sigma is None else round(sigma / unit, 3),
            "wanted": round(wanted / unit, 4),
            "met": None if sigma is None else sigma <= wanted,
        }

    def status(self) -> dict[str, object]:
        now_s = asyncio.get_running_loop().time()
        state, words = self.state(now_s)
        answer = self.answer()
        return {
            "at_arm": self.at_arm,
            "verdict": answer.verdict,
            "words": answer.words,
            "state": state,
            "in_force": "; ".join(filter(None, (words, self.in_force.left_out))),
            "held_back": self.in_force.held_back,
            "quality": {"gyro": self._quality("gyro", DEG_H), "accel": self._quality("accel", MG)},
            "against": [finding.words for finding in self.in_force.findings(now_s)],
        }


def _ago(seconds: float) -> str:
    if math.isinf(seconds):
        return "before this start"
    return f"{seconds:.0f} s ago" if seconds < 99.5 else f"{seconds / 60:.0f} min ago"

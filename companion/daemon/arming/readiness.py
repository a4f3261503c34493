"""May it arm? The answer is always ready: worked out several times a second, given in microseconds.

PX4 waits for it with its commander thread stopped (autopilots 5.2), so that nothing may be computed, read or awaited
once the question is there.
"""

from __future__ import annotations

import asyncio
import logging
import math
from typing import Final, Literal

from companion.autopilot.firmware.firmwares import settle_s
from companion.autopilot.vehicle.ekf import ADJUSTING
from companion.component.service import ArmAnswer
from companion.config.sections import AtArm
from companion.daemon.arming.automatic import Automatic
from companion.daemon.arming.in_force import InForce
from companion.daemon.calibrating.manager import CalibrationManager
from companion.daemon.calibrating.why_not import Rung
from companion.daemon.core import Core
from companion.daemon.offsets.effect import LOOK_S
from companion.daemon.offsets.reboot import RebootOwed
from companion.estimation.machine import State
from companion.estimation.records.validity import Why
from companion.physics.units import DEG_H, MG
from companion.samples import Triad

logger = logging.getLogger(__name__)

POLL_S: Final = 0.25
BY_ITSELF: Final = "calibrates by itself"
STEADY_S: Final = 2.0
"""How long it must have been still when somebody arms: whoever arms has just let go of it."""
OLDEST_SAID_S: Final = 2.0
"""A countdown that was not asked for meanwhile begins anew."""
OLDEST_ANSWER_S: Final = 1.5
"""An answer that was not renewed for so long (the loop stood still) is none."""
_IN_THE_MIDDLE: Final[dict[State, str]] = {
    State.DITHERING: "dithering offsets",
    State.WRITING: "writing offsets",
    State.VERIFYING: "checking new offsets",
    State.RESTARTING: "restarting autopilot",
    State.SETTLING: ADJUSTING,
    State.UNDOING: "putting back old offsets",
}
_LOOKED_AT: Final[dict[Why, str]] = {
    Why.REBOOTED: "checking after restart",
    Why.UNSEEN: _IN_THE_MIDDLE[State.VERIFYING],
}
"""What the next look at the output tells, and nobody has to do anything about before."""
_CLOSED: Final = (Rung.FAULT, Rung.CONFLICT, Rung.SECOND, Rung.UNKNOWN, Rung.PENDING)
"""What keeps the gate closed whatever is in force; the other rungs have answers of their own."""
_WAITS: Final = {
    Rung.UNKNOWN: "no heartbeat from the autopilot",
    Rung.PENDING: f"{_IN_THE_MIDDLE[State.UNDOING]}: wait",
}
WRITE_S: Final = {"px4": 8.0}
"""Time to write the offsets, by firmware. PX4 takes one vector after another: 7 s for one IMU."""
OTHER_WRITE_S: Final = 5.0
"""Time to write the offsets elsewhere: 4 s with ArduPilot's own gyro calibration in between."""
LATE_S: Final = 2.0
"""Until the last second of telemetry is complete and judged."""
EKF_S: Final = {"ardupilot": 3.0}
"""What its EKF takes to show that it has settled, where the firmware's calibration has reset it."""
MOVED_S: Final = 4.0
"""An estimate that has slipped by so much is of a look that has begun again."""


class Forecast:
    """Of the write that the manager does."""

    def __init__(self, core: Core, manager: CalibrationManager) -> None:
        self._vehicle, self._collector, self._manager = core.vehicle, core.collector, manager
        self._min_still_s = core.config.calibration.min_still_s
        self._promised: tuple[object, float] | None = None
        """The state, and the time at which its end was promised."""

    @property
    def whole_s(self) -> float:
        """From the end of the measurement until the new offsets are known to be right, without a dither."""
        firmware = self._vehicle.firmware or ""
        return WRITE_S.get(firmware, OTHER_WRITE_S) + self._check_s + EKF_S.get(firmware, 0.0)

    @property
    def _check_s(self) -> float:
        return settle_s(self._vehicle.firmware) + min(self._min_still_s, LOOK_S) + LATE_S

    @property
    def _job_s(self) -> float:
        job = self._manager.running
        return 0.0 if job is None else job.left_s

    def answer(self, now_s: float) -> ArmAnswer:
        """What is going on and for how long yet, for somebody who may not arm because of it."""
        state = self._manager.state
        words = _IN_THE_MIDDLE[state]
        if state is State.SETTLING:
            left_s = self._left_s(state, self._job_s, now_s)
            return ArmAnswer("wait", f"{words}: {left_s:.0f} s at most")
        if state in (State.UNDOING, State.RESTARTING):
            return ArmAnswer("wait", f"{words}: wait")
        return ArmAnswer.hold_still(self._left_s(state, self._estimate_s(state, now_s), now_s), words)

    def _estimate_s(self, state: State, now_s: float) -> float:
        after_s = EKF_S.get(self._vehicle.firmware or "", 0.0)
        if state is State.VERIFYING:
            return self._check_s - self._collector.glance(now_s).still_s + after_s
        if state is State.DITHERING:
            return self._job_s + self.whole_s
        return self.whole_s

    def _left_s(self, state: State, estimate_s: float, now_s: float) -> float:
        end_s = now_s + estimate_s
        if self._promised is not None and self._promised[0] is state:
            promised_s = self._promised[1]
            # Only a movement makes the look at the telemetry start again.
            started_again = state is State.VERIFYING and end_s > promised_s + MOVED_S
            end_s = end_s if started_again else min(end_s, promised_s)
        self._promised = (state, end_s)
        return max(1.0, math.ceil(end_s - now_s))


class Readiness:
    """The arm gate's answer, and what goes with it: `run` keeps it fresh."""

    def __init__(
        self, core: Core, owed: RebootOwed, manager: CalibrationManager, in_force: InForce, automatic: Automatic
    ) -> None:
        self._vehicle, self._collector, self._manager = core.vehicle, core.collector, manager
        self._wanted, self._on_deck = core.wanted, core.config.vehicle.platform == "deck"
        self.in_force, self._automatic, self._owed = in_force, automatic, owed
        self._forecast = Forecast(core, manager)
        self._answer = ArmAnswer("wait", "companion is starting")
        self._answered_s = -math.inf
        self._said = -math.inf, math.inf
        """When it was said last how long to hold still until it is calibrated, and how long."""
        self._has_gated = False
        self.turns = 0
        """Looks that came to their end, so that it is seen to go on."""

    @property
    def at_arm(self) -> AtArm:
        """What is to happen at arming; may change at the flight line."""
        return self._wanted.at_arm

    @property
    def asks_script(self) -> bool:
        """Whether ArduPilot's script has to be told: while this gates, and to let go when it does no longer."""
        self._has_gated |= self.at_arm == "gate"
        return self._has_gated and self._vehicle.firmware == "ardupilot"

    def answer(self) -> ArmAnswer:
        """The answer as of the last fraction of a second; what can change at once is looked at again."""
        if asyncio.get_running_loop().time() - self._answered_s > OLDEST_ANSWER_S:
            return ArmAnswer("wait", "companion is busy: try again")
        if self._manager.state.is_writing and self._answer.verdict == "accept":
            return ArmAnswer("wait", f"{_IN_THE_MIDDLE[self._manager.state]}: wait")
        return self._answer

    async def run(self) -> None:
        """Keep the answer fresh until cancelled."""
        loop = asyncio.get_running_loop()
        while True:
            try:
                self.update()
                await asyncio.sleep(0)  # a question that has come meanwhile is answered in between
                # What a write under way makes of the output says nothing about what will be in force after it.
                if not self._writing and await self._measured(loop.time()):
                    self.update()
                self.turns += 1
            except Exception:
                # Without a renewed answer the gate closes by itself.
                logger.exception("looking whether it may arm failed")
            await asyncio.sleep(POLL_S)

    async def _measured(self, now_s: float) -> bool:
        """As `InForce.measure`, with the answer kept fresh while it takes its time: a deck may take seconds."""
        measuring = asyncio.ensure_future(self.in_force.measure(now_s))
        try:
            while not (await asyncio.wait((measuring,), timeout=POLL_S))[0]:
                self.update()
        finally:
            measuring.cancel()
        return measuring.result()

    def update(self) -> None:
        """Work out the answer anew."""
        now_s = asyncio.get_running_loop().time()
        self.in_force.poll(writing=self._writing)
        if self.at_arm == "gate":
            answer = self._judge(now_s)
            self._answer = self._swaying(answer, now_s) if self._on_deck else answer
        else:
            # Nothing is held back; what is said is the state that it would arm in.
            state, words = self.state(now_s)
            self._answer = ArmAnswer("wait" if state == "uncalibrated" else "accept", words)
        self._answered_s = now_s

    @property
    def _writing(self) -> bool:
        """Whether a job that may write runs, or one that was interrupted is being put in order."""
        return self._manager.why_not((Rung.BUSY, Rung.PENDING)) is not None

    def _judge(self, now_s: float) -> ArmAnswer:
        if (obstacle := self._manager.why_not(_CLOSED)) is not None:
            wait = _WAITS.get(obstacle.rung)
            return ArmAnswer("refuse", obstacle.words) if wait is None else ArmAnswer("wait", wait)
        if not self._wanted.push:
            return ArmAnswer("refuse", "writing is off (CMP_PUSH): no gate")
        glance = self._collector.glance(now_s)
        if self._manager.state.is_writing:
            return self._forecast.answer(now_s)
        if glance.obstacle is not None and not glance.moving:
            return ArmAnswer("refuse", glance.obstacle.words)
        if (reading := self.in_force.reading()) is not None:
            return ArmAnswer("wait", reading)
        if (looked_at := self.looked_at(now_s)) is not None:
            return looked_at
        if findings := self.in_force.findings(now_s):
            why_not = self._automatic.why_not()
            if why_not is None:
                return ArmAnswer.hold_still(self.until_calibrated_s(now_s), BY_ITSELF)
            return ArmAnswer("refuse", f"{findings[0].words}: {why_not}")
        if self.owed is not None:
            return ArmAnswer("refuse", self.owed)
        if glance.moving or glance.steady_s < STEADY_S:
            return ArmAnswer.hold_still(STEADY_S - glance.steady_s)
        return ArmAnswer("accept", self.state(now_s)[1])

    @property
    def owed(self) -> str | None:
        """What the pilot has to do to the autopilot before it flies; None when nothing."""
        return self._owed.words

    def looked_at(self, now_s: float) -> ArmAnswer | None:
        """For how long to hold still, where the next look at the output will tell; None where it is not waited for."""
        findings = self.in_force.findings(now_s)
        if not findings or self.in_force.measured or any(finding.why not in _LOOKED_AT for finding in findings):
            return None
        left_s = self._wanted.settings.min_still_s + 1.0 - self._collector.glance(now_s).still_s
        return ArmAnswer.hold_still(left_s, _LOOKED_AT[findings[0].why])

    def _swaying(self, answer: ArmAnswer, now_s: float) -> ArmAnswer:
        """The same on a deck, which nobody can hold still."""
        if answer.hold_still_s is None:
            return answer
        status = self._collector.status(now_s)
        meanwhile = "" if answer.meanwhile == BY_ITSELF else answer.meanwhile
        return ArmAnswer("wait", f"wait: {meanwhile or status.left or status.measuring}")

    def until_calibrated_s(self, now_s: float) -> float:
        """Seconds of holding still until a calibration by itself would be in force."""
        status = self._collector.status(now_s)
        if status.enough:
            return math.ceil(self._forecast.whole_s)
        # Before anything is known of the noise this is the longest there is: waiting may only get shorter.
        whole_s = status.still_s / status.progress if status.progress > 0.0 else self._wanted.settings.max_s
        left_s = max(1.0, math.ceil(whole_s - status.still_s)) + math.ceil(self._forecast.whole_s)
        asked_s, said_s = self._said
        # Only a movement makes it longer. Where PX4's readings come in floats from now on it stands still for a moment.
        if self._collector.glance(now_s).moves is None and now_s - asked_s < OLDEST_SAID_S:
            left_s = min(left_s, said_s)
        self._said = now_s, left_s
        return left_s

    # --- in words, for arming, status and history

    def state(self, now_s: float) -> tuple[Literal["calibrated", "checked", "uncalibrated"], str]:
        """In which state it would arm now, in a word and in one short line."""
        state, words = self._state(now_s)
        held_back = self.in_force.held_back
        if held_back is None or self._manager.state.is_writing:
            return state, words
        return state, f"{words}; {held_back}; calibrate to write it" if words else f"{held_back}; calibrate to write it"

    def _state(self, now_s: float) -> tuple[Literal["calibrated", "checked", "uncalibrated"], str]:
        if (middle := _IN_THE_MIDDLE.get(self._manager.state)) is not None:
            return "uncalibrated", middle
        if (reading := self.in_force.reading()) is not None:
            return "uncalibrated", reading
        findings = self.in_force.findings(now_s)
        if findings:
            return "uncalibrated", findings[0].words
        if self.owed is not None:
            return "uncalibrated", self.owed
        sigmas = ", ".join(self._sigmas())
        calibrated_s, confirmed_s = self.in_force.calibrated_s, self.in_force.confirmed_s
        if calibrated_s is not None:
            return "calibrated", f"calibrated {_ago(now_s - calibrated_s)} ago, {sigmas}"
        if confirmed_s is not None:
            return "checked", f"offsets checked {_ago(now_s - confirmed_s)} ago, {sigmas}"
        return "uncalibrated", "not calibrated yet" if self.in_force.held_back is None else ""

    def _sigmas(self) -> list[str]:
        gyro, accel = self.in_force.sigma("gyro"), self.in_force.sigma("accel")
        return [
            *([f"{gyro / DEG_H:.1f} deg/h"] if gyro is not None else []),
            *([f"{accel / MG:.2f} mg"] if accel is not None else []),
        ]

    def _quality(self, triad: Triad, unit: float) -> dict[str, object]:
        """The largest sigma in force and what is aimed at, in deg/h or mg."""
        sigma, settings = self.in_force.sigma(triad), self._wanted.settings
        wanted = settings.target_gyro_sigma_rad_s if triad == "gyro" else settings.target_accel_sigma_m_s2
        return {
            "sigma": None if sigma is None else round(sigma / unit, 3),
            "wanted": round(wanted / unit, 4),
            "met": None if sigma is None else sigma <= wanted,
        }

    def status(self) -> dict[str, object]:
        """For `companion status`."""
        now_s = asyncio.get_running_loop().time()
        state, words = self.state(now_s)
        answer = self.answer()
        return {
            "at_arm": self.at_arm,
            "verdict": answer.verdict,
            "words": answer.words,
            "state": state,
            "in_force": words,
            "held_back": self.in_force.held_back,
            "quality": {"gyro": self._quality("gyro", DEG_H), "accel": self._quality("accel", MG)},
            "against": [finding.words for finding in self.in_force.findings(now_s)],
        }


def _ago(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 99.5 else f"{seconds / 60:.0f} min"

"""What of a write is under way, and how long it will take yet: for the pilot who stands beside it and wants to arm.

Only an estimate, made from what such writes take on both firmwares; but within one state it never gets longer while
the aircraft is still, because nobody believes a countdown that counts up.
"""

from __future__ import annotations

import math
from typing import Final

from companion.autopilot.firmware.firmwares import settle_s
from companion.autopilot.vehicle.vehicle import Vehicle
from companion.calibration.collector.rolling import RollingCollector
from companion.calibration.machine import State
from companion.component.service import ArmAnswer
from companion.daemon.calibrating.conductor import Conductor
from companion.daemon.offsets.effect import LOOK_S

WRITE_S: Final = 5.0
"""A dozen parameters: with ArduPilot's own gyro calibration in between, or with PX4's far step, 4 s on either."""
LATE_S: Final = 2.0
"""Until the last second of telemetry is complete and judged."""
EKF_S: Final = {"ardupilot": 3.0}
"""What its EKF takes to show that it has settled, where the firmware's calibration has reset it."""
MOVED_S: Final = 4.0
"""An estimate that has slipped by so much is of a look that has begun again."""
_VERB: Final = {
    State.DITHERING: "dithering offsets",
    State.WRITING: "writing offsets",
    State.VERIFYING: "checking new offsets",
}


class Forecast:
    """Of the write that the conductor does."""

    def __init__(self, vehicle: Vehicle, collector: RollingCollector, conductor: Conductor) -> None:
        self._vehicle, self._collector, self._conductor = vehicle, collector, conductor
        self._promised: tuple[object, float] | None = None
        """The state, and the time at which its end was promised."""

    @property
    def whole_s(self) -> float:
        """From the end of the measurement until the new offsets are known to be right, without a dither."""
        return WRITE_S + self._check_s + EKF_S.get(self._vehicle.firmware or "", 0.0)

    @property
    def _check_s(self) -> float:
        return settle_s(self._vehicle.firmware) + min(self._conductor.settings.min_still_s, LOOK_S) + LATE_S

    @property
    def _job_s(self) -> float:
        job = self._conductor.running
        return 0.0 if job is None else job.left_s

    def answer(self, now_s: float) -> ArmAnswer:
        """What is going on and for how long yet, for somebody who may not arm because of it."""
        state = self._conductor.state
        if state is State.UNDOING:
            return ArmAnswer("wait", "old offsets are being put back: wait")
        if state is State.RESTARTING:
            return ArmAnswer("wait", "autopilot is being restarted: wait")
        if state is State.SETTLING:
            left_s = self._left_s(state, self._job_s, now_s)
            return ArmAnswer("wait", f"EKF settling: wait, {left_s:.0f} s at most")
        if state not in _VERB:
            return ArmAnswer("wait", "writing new offsets: wait")
        return ArmAnswer.hold_still(self._left_s(state, self._estimate_s(state, now_s), now_s), _VERB[state])

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

"""What calibration is in force in each IMU, since when, and what speaks against it.

Three things are watched: the calibrations that end, the offsets that the autopilot says it has (`offset_watch`), and
what the rolling window says of the present output.
"""

from __future__ import annotations

import asyncio
import logging
import math
from collections.abc import Mapping
from typing import Final

import msgspec
import numpy as np

from companion.autopilot.firmware.firmwares import outcomes_of
from companion.component.service import JobResult
from companion.config.sections import Config, Imu
from companion.configured import models
from companion.daemon.arming.held_back import HeldBack
from companion.daemon.arming.offset_watch import OffsetWatch
from companion.daemon.biases.memory import BiasMemory
from companion.daemon.calibrating.estimator import Estimator
from companion.daemon.calibrating.manager import CalibrationManager
from companion.daemon.calibrating.run import CalibrationRun, Key
from companion.daemon.core import Core
from companion.daemon.devices.autopilot_imu import AutopilotImu
from companion.daemon.job import Job
from companion.errors import CalibrationRefusedError
from companion.estimation.noise.allan import noise_profile
from companion.estimation.records.record import ImuRecord, Record
from companion.estimation.records.validity import (
    Finding,
    Held,
    Limits,
    Present,
    Seen,
    Why,
    held_of,
    judge,
    worst_axis,
    worth_writing,
)
from companion.estimation.request import What
from companion.estimation.solution.doubt import Doubt
from companion.estimation.solution.solve import Solution
from companion.physics.frames import vector
from companion.samples import TRIADS, Triad

logger = logging.getLogger(__name__)

_ZERO: Final = (0.0, 0.0, 0.0)
# Causes that a measurement settles. What the pilot undid and what somebody else chose is theirs until asked for, and
# what a boot replaced is pushed again.
_SETTLED_BY_MEASURING: Final = frozenset({Why.NEVER, Why.REBOOTED, Why.FAILED, Why.ALIGNED})
SETTLED_EVERY_S: Final = 5
"""How often the output is checked while nothing speaks against what is in force; otherwise every second."""


class InForce:
    """The calibration in force; `poll` often, `measure` whenever there may be a new window."""

    def __init__(
        self,
        core: Core,
        imus: Mapping[str, AutopilotImu],
        manager: CalibrationManager,
        estimator: Estimator,
        memory: BiasMemory,
    ) -> None:
        self._core, self._config, self._manager = core, core.config, manager
        config = core.config
        self._imus, self._estimator, self._memory = imus, estimator, memory
        wanted = config.calibration
        self._limits = Limits(
            max_age_s=60.0 * wanted.max_age_min, max_temperature_change_k=wanted.max_temperature_change_degc
        )
        settings = models.settings(config)
        self._floors: dict[Triad, float] = {
            "gyro": settings.target_gyro_sigma_rad_s,
            "accel": settings.target_accel_sigma_m_s2,
        }
        self._sources = {imu.name: imu for imu in _judged(config)}
        triads = TRIADS if config.gradienter is not None else TRIADS[:1]
        self._held: dict[Key, Held | Why] = {(name, triad): Why.NEVER for name in self._sources for triad in triads}
        self._left_out: set[Key] = set()
        """What no calibration can settle, and is not judged."""
        self._shelved: dict[Key, Held] = {}
        """What was in force before a restart that kept the offsets: it counts again once a window agrees."""
        self._held_back = HeldBack()
        self._present: dict[Key, Present] = {}
        self.temperatures_degc: dict[str, float] = {}
        """Of each IMU that tells one, when its output was last looked at."""
        self._measured_s = self._looked_s = -1.0
        self._worth_since_s: float | None = None
        self.offsets = OffsetWatch(core.vehicle, imus, self._lose)
        self.calibration: Record | None = None
        """The last finished calibration of this run, while at least one of its values is in force."""
        self.undone = False
        estimator.alignment.on_change.add(self._realigned)

    # --- what is known

    @property
    def what(self) -> What:
        """What a calibration by itself determines."""
        return What.BOTH if self._config.gradienter is not None else What.GYROS

    def findings(self, now_s: float) -> list[Finding]:
        """Everything that speaks against what is in force; empty while it is good. Computes little."""
        found: list[Finding] = []
        for (name, triad), held in self._held.items():
            if isinstance(held, Why):
                if not any(finding.why is held for finding in found):
                    since = held is Why.NEVER and self.earlier is not None
                    words = "not confirmed since start" if since else held.value
                    found += self._held_back.left_of((name, triad), [Finding(held, words)])
                continue
            profile = noise_profile(self._core.profiles.of(name))
            degc = self.temperatures_degc.get(name)
            seen = Seen(
                now_s=now_s,
                temperature_degc=degc,
                present=self._present.get((name, triad)),
                drift=self._memory.curves.drift(name, triad, held.temperature_degc, degc),
            )
            model = profile.of(triad)
            against = judge(triad, name, held, model, self._limits, seen)
            found += self._held_back.left_of((name, triad), against)
        return found

    @property
    def held_back(self) -> str | None:
        """What was measured and not written, and why, in one short line; None when nothing was."""
        return self._held_back.text

    @property
    def earlier(self) -> Record | None:
        """The last calibration, be it of before this start, if it was good and has not been undone."""
        return None if self.undone else self._manager.last_good

    @property
    def worth_writing_s(self) -> float:
        """For how many seconds in a row the window has said that better offsets are to be had than those in force.

        One look in a hundred says so by chance, and there is one every second.
        """
        return 0.0 if self._worth_since_s is None else self._measured_s - self._worth_since_s

    @property
    def measured(self) -> bool:
        """Whether a still window is there now."""
        return bool(self._present)

    @property
    def calibrated_s(self) -> float | None:
        """When the oldest part of what is in force was calibrated; None where it was only measured to be right."""
        times = [held.calibrated_s for held in self._held.values() if isinstance(held, Held)]
        known = [time_s for time_s in times if time_s is not None]
        return min(known) if times and len(known) == len(times) else None

    @property
    def confirmed_s(self) -> float | None:
        """When everything in force was last seen to be right; None while something was never."""
        times = [held.confirmed_s if isinstance(held, Held) else None for held in self._held.values()]
        known = [time_s for time_s in times if time_s is not None]
        return min(known) if known and len(known) == len(times) else None

    def sigma(self, triad: Triad) -> float | None:
        """The largest sigma_use of what is in force, rad/s or m/s^2; None where nothing is."""
        sigmas = [max(held.sigma_use) for (_, of), held in self._held.items() if of == triad and isinstance(held, Held)]
        return max(sigmas, default=None)

    def record_of(self, name: str) -> ImuRecord | None:
        """What the last calibration found in one IMU; None when nothing did, or something has replaced it."""
        keys: list[Key] = [(name, triad) for triad in TRIADS]
        if self.calibration is None or any(
            isinstance(self._held.get(key), Why) or key in self._held_back for key in keys
        ):
            return None
        return next((imu for imu in self.calibration.imus if imu.name == name), None)

    def reading(self) -> str | None:
        """An autopilot IMU whose offsets are not known at this moment, and why, in one line."""
        found = ((name, imu.obstacle) for name, imu in self._imus.items())
        return next((f"imu {name}: {obstacle}" for name, obstacle in found if obstacle is not None), None)

    # --- what happens

    def on_ended(self, job: Job, result: JobResult) -> None:
        """A calibration or an undo has come to its end: what the autopilot has now is of our doing."""
        self._forget()
        self.offsets.on_ended(job, result)
        done = result.outcome == "done"
        if job.kind == "undo":
            if done and job.undid_calibration:
                self.undone, self.calibration = True, None
                self._held_back.let_go()
                self._held = dict.fromkeys(self._held, Why.UNDONE)
            return
        if done and isinstance(job, CalibrationRun) and job.record is not None:
            self.undone = False
            self.calibration = job.record
            for imu in job.record.imus:
                if imu.name in self._sources:
                    self._take(imu, asyncio.get_running_loop().time(), job.held_back)

    def _from_record(self, key: Key, now_s: float) -> Held | None:
        """What the last calibration before this start has written, while the IMU has run ever since with just that."""
        (name, triad), record = key, self.earlier
        calibration = self._imus[name].calibration if name in self._imus else None
        imu = None if record is None else next((each for each in record.imus if each.name == name), None)
        if record is None or imu is None or calibration is None or record.system_id != self._core.vehicle.system_id:
            return None
        written = {parameter: one.after for parameter, one in imu.written.items()}
        if not outcomes_of(triad, imu.written) or triad in imu.held_back or calibration.contradicts(written):
            return None
        found = held_of(imu, triad, now_s, self._config.calibration.min_still_s, corrected=True, seen=False)
        if found is None or not self._memory.on_since(name, record.started_at):
            return None
        # No clock of now tells how long ago that was.
        return msgspec.structs.replace(found, calibrated_s=None)

    def _realigned(self) -> None:
        """The gradienter has another zero from now on: accelerometers calibrated with the old one must be seen anew."""
        for key, held in self._held.items():
            if key[1] == "accel" and isinstance(held, Held):
                self._held[key] = Why.ALIGNED
        self._held_back.let_go(triad="accel")
        self._forget()

    def _take(self, imu: ImuRecord, now_s: float, held_back: Mapping[Key, Doubt]) -> None:
        """Hold what a calibration has found in one IMU, save what it has not written for doubt."""
        corrected, averaged_s = imu.name in self._imus, self._config.calibration.min_still_s
        for triad, residual in zip(TRIADS, (imu.residual_gyro_rad_s, imu.residual_accel_m_s2), strict=True):
            # Of an IMU that is not in the autopilot's telemetry "stored" is all that can ever be known.
            key, seen = (imu.name, triad), outcomes_of(triad, imu.written) <= {"verified"} or not corrected
            found = held_of(imu, triad, now_s, averaged_s, corrected=corrected, seen=seen)
            if key not in self._held or found is None:
                continue
            doubt = held_back.get(key)
            if doubt is None:
                self._held[key] = found
                self._held_back.let_go(name=imu.name, triad=triad)
                continue
            expected = residual if corrected and residual is not None else found.expected
            self._held_back.hold(key, doubt, msgspec.structs.replace(found, expected=expected))

    def poll(self, *, writing: bool) -> None:
        """See whether anybody has changed the autopilot's offsets, unless we may be changing them just now."""
        if writing:
            self.offsets.let_go()
            self._forget()
        else:
            self.offsets.poll()

    def _lose(self, name: str, why: Why) -> None:
        if why is not Why.REBOOTED:  # which has kept them
            self._held_back.let_go(name=name)
        for key in [key for key in self._held if key[0] == name]:
            held = self._held[key]
            # What was never there, or was taken back on purpose, is not lost again by a restart.
            if isinstance(held, Held) or why in (Why.CHANGED, Why.FAILED):
                if isinstance(held, Held) and why is Why.REBOOTED:
                    self._shelved[key] = held
                self._held[key] = why
                self._present.pop(key, None)

    def _forget(self) -> None:
        """There is no window now."""
        self._present.clear()
        self._worth_since_s = None

    async def measure(self, now_s: float) -> bool:
        """Look at the present output when it is time to and the aircraft stands still; whether it was."""
        second = math.floor(now_s)  # the collector's seconds end with the clock's
        settled = not self.findings(now_s) and self._worth_since_s is None
        if second == self._looked_s or (settled and self._present and second - self._looked_s < SETTLED_EVERY_S):
            return False
        self._looked_s = second
        try:
            window = await self._core.window() if self.reading() is None else None
        except CalibrationRefusedError:
            window = None
        if window is None:
            self._forget()
            return True
        if window.end_s == self._measured_s:
            return False
        self._measured_s = window.end_s
        known = self.offsets.known()
        try:
            solution, _ = await self._estimator.solve(window, self.what)
        except CalibrationRefusedError:
            self._forget()
            return True
        if known == self.offsets.known():  # else the offsets have changed while it was worked out
            self._note(solution, window.end_s, window.end_s - window.start_s)
            await self._memory.look(solution)
        return True

    def _note(self, solution: Solution, end_s: float, averaged_s: float) -> None:
        worth = False
        for imu in solution.imus:
            if imu.temperature_degc is not None:
                self.temperatures_degc[imu.name] = imu.temperature_degc
            settled = np.sqrt(np.diag(imu.covariance))
            found = (
                (imu.gyro_rad_s, imu.gyro_sigma_use_rad_s, settled[:3]),
                (imu.accel_m_s2, imu.accel_sigma_use_m_s2, settled[3:]),
            )
            for triad, (residual, sigma, compared) in zip(TRIADS, found, strict=True):
                key = (imu.name, triad)
                if key in solution.unknown:
                    self._leave_out(key)
                    continue
                if residual is not None and key in self._left_out:
                    self._left_out.discard(key)
                    self._held[key] = Why.NEVER
                if residual is None or key not in self._held:
                    continue
                present = Present(residual=vector(residual), sigma_use=vector(sigma), sigma=vector(compared))
                self._present[key] = present
                self._confirm(key, present, imu.temperature_degc, end_s, averaged_s)
                held = self._held[key]
                if self._held_back.still(key, held, present, end_s, self._limits.max_age_s):
                    continue
                worth |= worth_writing(present, held if isinstance(held, Held) else None, self._floors[key[1]])
        if not worth:
            self._worth_since_s = None
        elif self._worth_since_s is None:
            self._worth_since_s = end_s

    def _leave_out(self, key: Key) -> None:
        """Integer readings that tell nothing, and may not be dithered: no calibration could ever settle them."""
        self._present.pop(key, None)
        if not self._config.push.dither and self._held.get(key) is Why.NEVER and len(self._held) > 1:
            logger.warning("%s %s cannot be known from its integer readings and is not judged", key[1], key[0])
            del self._held[key]
            self._left_out.add(key)

    def _confirm(
        self, key: Key, present: Present, temperature_degc: float | None, end_s: float, averaged_s: float
    ) -> None:
        """What the window agrees with counts as right from now on."""
        held = self._held[key]
        if held is Why.REBOOTED:
            held = self._shelved.get(key, held)
        if held is Why.NEVER and (kept := self._from_record(key, end_s)) is not None:
            held = held if worst_axis(kept, present) is not None else kept
        if isinstance(held, Why):
            right = key[0] in self._imus and not worth_writing(present, None, self._floors[key[1]])
            if right and held in _SETTLED_BY_MEASURING:
                self._held[key] = Held(
                    calibrated_s=None,
                    confirmed_s=end_s,
                    temperature_degc=temperature_degc,
                    sigma_use=present.sigma_use,
                    sigma=present.sigma,
                    expected=_ZERO,
                    seen=True,
                    averaged_s=averaged_s,
                )
        elif worst_axis(held, present) is None and (end_s > held.confirmed_s or not held.seen):
            # What is collected while offsets are in doubt was sent under the new ones: a write voids what was before.
            confirmed_s = max(end_s, held.confirmed_s)
            self._held[key] = msgspec.structs.replace(
                held, confirmed_s=confirmed_s, temperature_degc=temperature_degc, seen=True
            )


def _judged(config: Config) -> list[Imu]:
    """The IMUs that the autopilot flies with; where it has none of them, all."""
    flown = [imu for imu in config.imu if imu.source == "autopilot" or imu.autopilot_instance is not None]
    return flown or list(config.imu)

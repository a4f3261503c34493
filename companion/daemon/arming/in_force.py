"""The active calibration of each IMU, its age, and the findings against it.

The inputs are finished calibrations, the offsets that the autopilot reports (`OffsetWatch`), and the IMU output in the
rolling window. The result of an automatic calibration is held back if it contradicts earlier ones: the active
calibration and the gate stay as they are until somebody requests a calibration or the output changes again.
"""

from __future__ import annotations

import asyncio
import dataclasses
import logging
import math
from collections.abc import Mapping
from typing import Final

import msgspec
import numpy as np

from companion.autopilot.firmware.firmwares import outcomes_of
from companion.component.service import JobResult
from companion.configured import models
from companion.daemon.calibrating.run import CalibrationRun, Key, in_short
from companion.daemon.calibrating.subsystem import Calibrating
from companion.daemon.core import Core
from companion.daemon.devices.autopilot_imu import AutopilotImu, OffsetWatch
from companion.daemon.job import Job
from companion.errors import CalibrationRefusedError
from companion.estimation.machine import What
from companion.estimation.noise.allan import noise_profile
from companion.estimation.records.record import ImuRecord, Record
from companion.estimation.records.validity import (
    RETURNED_SIGMAS,
    Held,
    Objection,
    Present,
    Why,
    held_of,
    judge,
    worst_axis,
    worth_writing,
)
from companion.estimation.solution.doubt import Inconsistency
from companion.estimation.solution.solve import Solution
from companion.physics.frames import vector
from companion.samples import TRIADS, Triad, Vector, rows_of

logger = logging.getLogger(__name__)

# Reasons that a good window clears. The other reasons stay: offsets restored by the pilot or set by somebody else count
# until a request, and offsets replaced by a boot are written again.
_SETTLED_BY_MEASURING: Final = frozenset({Why.NEVER, Why.REBOOTED, Why.FAILED, Why.ALIGNED})
_NOT_IN_DOUBT: Final = frozenset({Why.UNDONE, Why.CHANGED, Why.UNSEEN})
"""Findings reported even while a result is held back: people's choices, and writes without a visible effect."""
NOT_CONFIRMED: Final = "not confirmed since start"
SETTLED_EVERY_S: Final = 5  # Interval between checks of the output while there is no finding; otherwise 1 s


@dataclasses.dataclass(slots=True)
class _TriadState:
    """State of the gyros or accelerometers of one IMU; `held`: the active calibration, or the reason for none."""

    held: Held | Why = Why.NEVER
    shelved: Held | None = None
    """Calibration from before an autopilot restart; active again once a window without motion agrees with it."""
    present: Present | None = None
    in_doubt: tuple[str, Held] | None = None
    """Automatic calibration that was held back: reason, and result; None once the result no longer fits the output."""
    judged: bool = True
    """False if integer readings are too coarse to show the bias; the check then leaves these sensors out."""


class ActiveCalibration:
    """Active calibration of all IMUs; call `poll` often, and `measure` when a new window without motion is possible."""

    def __init__(self, core: Core, imus: Mapping[str, AutopilotImu], calibrating: Calibrating) -> None:
        self._core, self._config, self._imus, config = core, core.config, imus, core.config
        self.manager, self._memory = calibrating.manager, calibrating.memory
        self._estimator = calibrating.estimator
        goal = models.settings(config)
        self._floors = dict(zip(TRIADS, (goal.target_gyro_sigma_rad_s, goal.target_accel_sigma_m_s2), strict=True))
        # IMUs used by the autopilot; if it uses none of the configured ones, all of them.
        flown = [imu.name for imu in config.imu if imu.is_flown]
        names = flown or [imu.name for imu in config.imu]
        self.what = What.BOTH if config.gradienter is not None else What.GYROS
        """Biases that an automatic calibration estimates: of gyros, and with a gradienter also of accelerometers."""
        triads = TRIADS if config.gradienter is not None else TRIADS[:1]
        self._triads: dict[Key, _TriadState] = {(name, triad): _TriadState() for name in names for triad in triads}
        self._names, self.faces = names, calibrating.faces
        self.temperatures_degc: dict[str, float] = {}  # Temperatures of the IMUs at the last check of their output
        self._measured_s = self._looked_s = -1.0
        self._worth_since_s: float | None = None
        self.offsets = OffsetWatch(core.vehicle, imus, self._lose)
        self.calibration: Record | None = None
        """Record of the last calibration that this run of the daemon has finished; None after an undo."""
        self.undone = False
        calibrating.alignment.on_change.add(self._realigned)

    # --- state

    def findings(self, now_s: float) -> list[Objection]:
        found: list[Objection] = []
        for (name, triad), state in self._triads.items():
            held = state.held
            if not state.judged:
                continue
            if isinstance(held, Why):
                if any(finding.why is held for finding in found):
                    continue
                since = held is Why.NEVER and self.earlier is not None
                against = [Objection(held, NOT_CONFIRMED if since else held.value)]
            else:
                model = noise_profile(self._core.profiles.of(name)).of(triad)
                degc = self.temperatures_degc.get(name)
                drift = self._memory.drift(name, triad, held.temperature_degc, degc)
                against = judge(
                    (name, triad), held, model, self._config.calibration,
                    now_s=now_s, temperature_degc=degc, present=state.present, drift=drift,
                )  # fmt: skip
            found += [one for one in against if state.in_doubt is None or one.why in _NOT_IN_DOUBT]
        return found

    @property
    def held_back(self) -> str | None:
        kept = {key: state.in_doubt[0] for key, state in self._triads.items() if state.in_doubt is not None}
        return f"held back: {in_short(kept)} ({', '.join(dict.fromkeys(kept.values()))})" if kept else None

    @property
    def left_out(self) -> str:
        out = [key for key, state in self._triads.items() if not state.judged]
        return f"{in_short(out)} left out (telemetry too coarse)" if out else ""

    @property
    def earlier(self) -> Record | None:
        """Last good calibration, from this run of the daemon or an earlier one; None if it was undone."""
        return None if self.undone else self.manager.last_good

    @property
    def kept_from(self) -> str | None:
        """Return the time of the last good calibration if the autopilot still has its offsets; otherwise None."""
        record, known = self.earlier, [imu.calibration for imu in self._imus.values()]
        written = {} if record is None else record.written
        if record is None or not (known and written) or any(one is None or one.contradicts(written) for one in known):
            return None
        return f"{record.started_at[:16].replace('T', ' ')} UTC"

    @property
    def worth_writing_s(self) -> float:
        """Seconds during which each window predicted better offsets; one window in a hundred does so by chance."""
        return 0.0 if self._worth_since_s is None else self._measured_s - self._worth_since_s

    @property
    def measured(self) -> bool:
        return any(state.present is not None for state in self._triads.values())

    @property
    def _judged(self) -> list[Held | Why]:
        return [state.held for state in self._triads.values() if state.judged]

    @property
    def calibrated_s(self) -> float | None:
        """Event-loop time of the oldest active calibration; None if some offsets were confirmed, not calibrated."""
        times = [held.calibrated_s for held in self._judged if isinstance(held, Held)]
        known = [time_s for time_s in times if time_s is not None]
        return min(known) if times and len(known) == len(times) else None

    @property
    def confirmed_s(self) -> float | None:
        """Event-loop time of the oldest confirmation of all IMUs' offsets; None while some were never confirmed."""
        known = [held.confirmed_s for held in self._judged if isinstance(held, Held)]
        return min(known) if known and len(known) == len(self._judged) else None

    def active(self, name: str, triad: Triad) -> tuple[Vector, float | None] | None:
        """Return sigma and event-loop time (None: only checked) of the calibration or faces alignment of one triad.

        Accelerometers count with the one that has the smaller sigma, rad/s or m/s^2. None: neither is active.
        """
        held = state.held if (state := self._triads.get((name, triad))) is not None else None
        by_faces = self.faces.sigma_m_s2(name, self.temperatures_degc.get(name)) if triad == "accel" else None
        if by_faces is not None and (not isinstance(held, Held) or by_faces < max(held.sigma_use)):
            return (by_faces,) * 3, self.faces.measured_s(name)
        return (held.sigma_use, held.calibrated_s) if isinstance(held, Held) else None

    def worst(self, triad: Triad) -> tuple[float | None, float | None]:
        """Return the largest sigma of the active gyro or accel calibrations, and the time of the oldest one."""
        found = [one for name in self._names if (one := self.active(name, triad)) is not None]
        times = [time_s for _, time_s in found if time_s is not None]
        return max((max(sigma) for sigma, _ in found), default=None), min(times, default=None)

    def sigma(self, triad: Triad) -> float | None:
        return self.worst(triad)[0]

    def record_of(self, name: str) -> ImuRecord | None:
        states = [state for key, state in self._triads.items() if key[0] == name and state.judged]
        if self.calibration is None or any(isinstance(one.held, Why) or one.in_doubt for one in states):
            return None
        return next((imu for imu in self.calibration.imus if imu.name == name), None)

    def reading(self) -> str | None:
        found = ((name, imu.obstacle) for name, imu in self._imus.items())
        return next((f"imu {name}: {obstacle}" for name, obstacle in found if obstacle is not None), None)

    # --- events

    def on_ended(self, job: Job, result: JobResult) -> None:
        self._forget_window()
        self.offsets.on_ended(job, result)
        if result.outcome != "done":
            return
        if job.undid_calibration:
            self.undone, self.calibration = True, None
            for state in self._triads.values():
                state.held, state.in_doubt = Why.UNDONE, None
        elif isinstance(job, CalibrationRun) and job.record is not None:
            self.undone, self.calibration = False, job.record
            for state in self._triads.values():
                state.held = Why.NEVER if state.held is Why.UNDONE else state.held
            for imu in job.record.imus:
                self._take(imu, asyncio.get_running_loop().time(), job.held_back)
            for key in job.solution.unknown if job.solution is not None else ():
                if (coarse := self._triads.get(key)) is not None:
                    self._leave_out(coarse)

    def _take(self, imu: ImuRecord, now_s: float, held_back: Mapping[Key, Inconsistency]) -> None:
        corrected, averaged_s = imu.name in self._imus, self._config.calibration.min_still_s
        # For an IMU without telemetry "stored" is the best possible outcome, so it counts as seen.
        for triad in TRIADS:
            seen = outcomes_of(triad, imu.written) <= {"verified"} or not corrected
            found = held_of(imu, triad, now_s, averaged_s, corrected=corrected, seen=seen)
            state = self._triads.get((imu.name, triad))
            if state is None or not state.judged or found is None:
                continue
            if (doubt := held_back.get((imu.name, triad))) is None:
                state.held, state.in_doubt = found, None
                continue
            residual = imu.of(triad).residual
            expected = residual if corrected and residual is not None else found.expected
            state.in_doubt = doubt.in_short, msgspec.structs.replace(found, expected=expected)

    def _realigned(self) -> None:
        for (_, triad), state in self._triads.items():
            if triad == "accel":
                state.held = Why.ALIGNED if isinstance(state.held, Held) else state.held
                state.in_doubt = None
        self._forget_window()

    def poll(self, *, writing: bool) -> None:
        if writing:
            self.offsets.let_go()
            self._forget_window()
        else:
            self.offsets.poll()

    def _lose(self, name: str, why: Why) -> None:
        if why is Why.REBOOTED and self.calibration is not None:  # the EKF has started afresh
            self.calibration = msgspec.structs.replace(self.calibration, warnings=())
        for state in (state for key, state in self._triads.items() if key[0] == name and state.judged):
            if why is not Why.REBOOTED:  # a reboot changes no offsets: a result held back stays so
                state.in_doubt = None
            # A restart changes nothing where there was no active calibration, or the offsets were restored on purpose.
            if isinstance(state.held, Held) or why in (Why.CHANGED, Why.FAILED):
                if isinstance(state.held, Held) and why is Why.REBOOTED:
                    state.shelved = state.held
                state.held, state.present = why, None

    def _forget_window(self) -> None:
        self._worth_since_s = None
        for state in self._triads.values():
            state.present = None

    async def measure(self, now_s: float) -> bool:
        """Check the active calibration against the present window, if due; return whether a check was made."""
        second = math.floor(now_s)  # the collector's seconds end on whole seconds of the clock
        settled = self.measured and self._worth_since_s is None and not self.findings(now_s)
        if second == self._looked_s or (settled and second - self._looked_s < SETTLED_EVERY_S):
            return False
        self._looked_s = second
        if self.reading() is not None:
            self._forget_window()
            return True
        try:
            window = await self._core.window()
            if window.end_s == self._measured_s:
                return False
            self._measured_s = window.end_s
            known = self.offsets.known()
            solution, *_ = await self._estimator.solve(window, self.what)
        except CalibrationRefusedError:
            self._forget_window()
            return True
        if known == self.offsets.known():  # otherwise the offsets have changed during the estimate
            self._note(solution, window.end_s, window.end_s - window.start_s)
            await self._memory.look(solution)
        return True

    def _note(self, solution: Solution, end_s: float, averaged_s: float) -> None:
        worth = False
        for imu in solution.imus:
            if imu.temperature_degc is not None:
                self.temperatures_degc[imu.name] = imu.temperature_degc
            use, settled = np.sqrt(np.diag(imu.use_covariance)), np.sqrt(np.diag(imu.covariance))
            for triad, residual in zip(TRIADS, imu.biases, strict=True):
                key, rows = (imu.name, triad), rows_of(triad)
                if (state := self._triads.get(key)) is None:
                    continue
                if key in solution.unknown:
                    self._leave_out(state)
                    continue
                if residual is None:
                    continue
                state.judged = True
                present = Present(residual=vector(residual), sigma_use=vector(use[rows]), sigma=vector(settled[rows]))
                was, before = state.held, state.present
                if isinstance(was, Held) and before is not None and worst_axis(was, before) is not None:
                    present = msgspec.structs.replace(present, limit_sigmas=RETURNED_SIGMAS)
                state.present = present
                self._confirm(key, state, present, imu.temperature_degc, end_s, averaged_s)
                if not self._stays_in_doubt(state, present, end_s):
                    held = state.held if isinstance(state.held, Held) else None
                    worth |= worth_writing(present, held, self._floors[triad])
        if not worth:
            self._worth_since_s = None
        elif self._worth_since_s is None:
            self._worth_since_s = end_s

    def _leave_out(self, state: _TriadState) -> None:
        state.present = None
        if state.held in (Why.NEVER, Why.UNDONE) and state.judged and len(self._judged) > 1:
            state.judged = False
            logger.warning("%s", self.left_out)

    def _stays_in_doubt(self, state: _TriadState, present: Present, end_s: float) -> bool:
        """Return True if a held-back result is recent and fits the output, and the active calibration does not fit."""
        if state.in_doubt is None:
            return False
        measured = state.in_doubt[1]
        is_right = isinstance(state.held, Held) and worst_axis(state.held, present) is None
        is_long_ago = end_s - measured.confirmed_s > 60.0 * self._config.calibration.max_age_min
        if is_right or is_long_ago or worst_axis(measured, present) is not None:
            state.in_doubt = None
        return state.in_doubt is not None

    def _confirm(
        self, key: Key, state: _TriadState, present: Present, degc: float | None, end_s: float, averaged_s: float
    ) -> None:
        held = state.held
        if held is Why.REBOOTED:
            held = state.shelved or held
        if held is Why.NEVER and (kept := self._from_record(key, end_s)) is not None:
            held = held if worst_axis(kept, present) is not None else kept
        if isinstance(held, Why):
            right = key[0] in self._imus and not worth_writing(present, None, self._floors[key[1]])
            if right and held in _SETTLED_BY_MEASURING:
                state.held = Held(
                    calibrated_s=None, confirmed_s=end_s, temperature_degc=degc, sigma_use=present.sigma_use,
                    sigma=present.sigma, expected=(0.0, 0.0, 0.0), seen=True, averaged_s=averaged_s,
                )  # fmt: skip
        elif worst_axis(held, present) is None and (end_s > held.confirmed_s or not held.seen):
            # A write voids earlier telemetry, so this window was sent under the new offsets.
            confirmed_s = max(end_s, held.confirmed_s)
            state.held = msgspec.structs.replace(held, confirmed_s=confirmed_s, temperature_degc=degc, seen=True)

    def _from_record(self, key: Key, now_s: float) -> Held | None:
        """Return the calibration from before the daemon's start, if the IMU has run with its offsets ever since."""
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
        # Its age is unknown: the present clock began after it.
        return msgspec.structs.replace(found, calibrated_s=None)

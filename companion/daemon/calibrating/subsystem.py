"""Commands and status of calibrations and alignments."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Mapping, Sequence
from functools import partial
from typing import Final, Literal

import msgspec
import numpy as np

from companion.autopilot.firmware.imu_calibration import Thermal
from companion.autopilot.parameters.change import same_float32
from companion.autopilot.telemetry.compass_fields import CompassFields
from companion.autopilot.vehicle.ekf import OwnAttitude
from companion.commands import Align, Calibrate, Cancel, Temperature, Undo
from companion.component.service import MEASURED_PERCENT, Refusal
from companion.daemon.biases import LOOK_K, BiasMemory
from companion.daemon.calibrating.manager import CalibrationManager, Precondition
from companion.daemon.calibrating.run import CalibrationParts
from companion.daemon.core import Core, Handler, Subsystem, Task
from companion.daemon.devices.subsystem import Devices
from companion.daemon.job import ALIGNMENT, COMPASS, FACES, TEMPERATURE, TURN, Job
from companion.daemon.offsets.plan import ImuPlan, Plan, WriteLog
from companion.daemon.offsets.subsystem import Offsets
from companion.daemon.poses.alignment import ActiveAlignment, ActiveSixPosition, ByHand
from companion.daemon.poses.compass_status import CompassStatus
from companion.daemon.poses.compass_task import CompassTask
from companion.daemon.poses.measuring import Estimator, Measuring
from companion.daemon.poses.session import PoseSession, PoseTask
from companion.daemon.poses.tasks import SixPositionTask, TurnTask, ZeroTask
from companion.daemon.poses.writes import AlignmentWrites
from companion.errors import CalibrationRefusedError, RequestRefusedError
from companion.estimation.alignment.faces import SIDES
from companion.estimation.alignment.poses import HEADINGS, AlignmentRequest
from companion.estimation.machine import Event, What
from companion.estimation.means.windows import Window
from companion.estimation.solution.curve import Curve, Polynomial, of_curve
from companion.formats import Object
from companion.links.system.events import comes
from companion.storage.changes import BY_TEMPERATURE
from companion.storage.records import RecordStore

PROGRESS_EVERY_S: Final = 0.2
HEARD_WITHIN_S: Final = 5.0
"""Longest time that an undo waits for the first heartbeat of the autopilot."""
ALIGN_TIMEOUT_S: Final = 900.0
"""Default time limit of each pose of an alignment: one that nobody finishes must not block calibrations for ever."""
_KINDS: Final[dict[Literal["zero", "tilts", "turn", "faces", "compass"], str]] = {
    "zero": ALIGNMENT,
    "tilts": ALIGNMENT,
    "turn": TURN,
    "faces": FACES,
    "compass": COMPASS,
}


class Calibrating(Subsystem):
    """Connects the parts that calibrate and align, and answers their commands."""

    def __init__(self, core: Core, devices: Devices, offsets: Offsets) -> None:
        config, imus = core.config, devices.imus
        self._core, self._offsets, self._imus = core, offsets, imus
        self.store = RecordStore(config.storage.path)
        self.alignment = ActiveAlignment(config, core.offload)
        self.memory = BiasMemory(core, devices, self.alignment)
        self.measuring = measuring = Measuring(core, imus)
        self.faces = ActiveSixPosition(core, imus)
        own = OwnAttitude(core.vehicle, wanted=config.compass is None)
        self.estimator = Estimator(core, self.alignment, self.faces, own)
        self.stands = PoseSession(core, imus, measuring, AlignmentWrites(core, imus, offsets, own))
        self.by_hand = ByHand(core, imus)
        self._fields = CompassFields(core.link, core.vehicle)
        parts = CalibrationParts(core, imus, measuring, self.estimator, self.memory, offsets)
        self.manager = CalibrationManager(parts, self.store, self.by_hand)
        self.compasses = CompassStatus(core, self.by_hand)
        self.manager.on_ended.add(lambda _job, _result: self.compasses.reading.again())

    def load(self) -> None:
        for part in (self.alignment, self.faces, self.by_hand, self.memory, self.manager):
            part.load()

    def tasks(self) -> Sequence[Task]:
        return [("compass-values", self.compasses.reading.run), ("compasses", self.compasses.run)]

    def commands(self) -> Mapping[str, Handler]:
        """Return the handlers; they raise RequestRefusedError, or another CompanionError after the start of a job."""
        return {
            "calibrate": self._calibrate,
            "align": self._align,
            "cancel": self._cancel,
            "undo": self._undo,
            "temperature": self._temperature,
        }

    def status(self) -> Object:
        manager, running, job, last = self.manager, self.manager.running, self.manager.job, self.manager.last
        stands, still = self.stands.state, self._core.collector.status(asyncio.get_running_loop().time())
        words = manager.reason if running is None else running.words
        return {
            "state": manager.state.shown,
            "reason": words,
            "progress": None if running is None else manager.progress_percent,
            "still_s": round(still.still_s, 1),
            "waiting_for": still.waiting_for,
            "alignment": self.alignment.status(),
            "by_hand": self.by_hand.latest(),
            "compasses": self.compasses.rows,
            "warnings": [*filter(None, [self.alignment.warning]), *self.compasses.warnings],
            "stands": None if stands is None or stands.job is not manager.asked else stands.shown(),
            "last": None
            if last is None
            else {
                **{key: getattr(last, key) for key in ("state", "undone_at", "started_at", "reason")},
                "magnetic": msgspec.to_builtins(last.magnetic),
                "when_warm": [words for imu in last.imus if imu.when_warm is not None for words in imu.when_warm.words],
            },
            "job": None
            if job is None
            else {
                "kind": job.kind, "what": job.what.name.lower(), "requester": job.requester,
                "state": manager.state.shown, "percent": manager.progress_percent, "text": words,
            },
        }  # fmt: skip

    async def _calibrate(self, asked: Calibrate, face: str) -> AsyncIterator[Object]:
        job = accepted(
            self.manager.start_calibration(asked.biases, f"{face} calibrate", asked.timeout_s, reboot=asked.reboot)
        )
        if not asked.wait:
            yield {"kind": "result", "state": self.manager.state.shown, "reason": "calibration started"}
            return
        async for reply in self._progress(job):
            yield reply
        yield {"kind": "result", "record": msgspec.to_builtins(job.record)}

    async def _temperature(self, asked: Temperature, face: str) -> AsyncIterator[Object]:
        if asked.action == "undo":
            await self._hear()
            if (why := self._why_no_curve_undo()) is not None:
                raise RequestRefusedError("nothing_to_undo", why)
            async for reply in self._undo(Undo(), face):
                yield reply
        elif asked.action == "write":
            missing = self._why_not_written(write=True) or self._core.vehicle.kind.why_no_thermal_write
            job = Job(TEMPERATURE, What.GYROS, f"{face} temperature", ALIGN_TIMEOUT_S)
            started = self.manager.start_job(job, partial(self._write_curves, overwrite=asked.overwrite), missing)
            async for reply in self.to_end(accepted(started), "written"):
                yield reply
        else:
            yield {"kind": "result", "imus": await self._core.offload(self.memory.temperature)}

    async def _cancel(self, _asked: Cancel, face: str) -> AsyncIterator[Object]:
        running = self.manager.cancel(f"{face} cancel" if face == "companion" else face.removesuffix("'s"))
        if running and self.manager.job is not None:
            await asyncio.shield(self.manager.job.finished)
        reason = self.manager.reason if running else "nothing was running"
        yield {"kind": "result", "state": self.manager.state.shown, "reason": reason}

    async def _undo(self, asked: Undo, face: str) -> AsyncIterator[Object]:
        await self._hear()
        job = accepted(self.manager.start_undo(f"{face} undo", force=asked.force))
        result = await asyncio.shield(job.finished)
        yield {
            "kind": "result",
            "state": result.outcome,
            "reason": result.reason,
            **(job.product if isinstance(job.product, dict) else {"written": {}, "undone": None}),
            "undoable": self._offsets.undoable(),
        }

    async def _hear(self) -> None:
        vehicle = self._core.vehicle
        if vehicle.heartbeat_age_s is None:  # the daemon may have only just started
            await comes(vehicle.found, HEARD_WITHIN_S)

    async def _align(self, asked: Align, face: str) -> AsyncIterator[Object]:
        if asked.action == "show":
            yield {"kind": "result", **self._shown()}
        elif asked.action == "forget":
            if (busy := self.manager.blocking_reason((Precondition.IDLE,))) is not None:
                raise CalibrationRefusedError(busy[1])
            if (record := self.alignment.record) is not None:
                await self.by_hand.undone(record.measured_at)
            was = await self.alignment.forget()
            words = "the configuration's zero and sigma are active" if was else "there was no zero to forget"
            if self.faces.record is not None:
                words += "; the faces alignment stays: companion align faces replaces it"
            yield {"kind": "result", "state": "done", "reason": words}
        else:
            job = accepted(self.start_alignment(asked, f"{face} align"))
            if not asked.wait:
                yield {"kind": "result", "state": self.manager.state.shown, "reason": f"{job.kind} started"}
                return
            async for reply in self.to_end(job, "alignment"):
                yield reply

    def _shown(self) -> Object:
        alignment, sides = self.alignment, self.faces.status()
        if alignment.used is not None or (sides and alignment.settings() is None):
            known = [self.faces.sigma_m_s2(one["name"], one["temperature_degc"]) for one in sides]
            here = alignment.settings() is not None or None not in known
            state, reason = ("active", "") if here else ("not used", "the autopilot's offsets are others")
        elif alignment.unused is not None:
            state, reason = "not used", alignment.unused
        else:
            state, reason = "none", "no alignment is kept: companion align zero measures one"
        found = {"alignment": msgspec.to_builtins(alignment.record), "accelerometers": sides}
        return {"state": state, "reason": reason, **found}

    def start_alignment(self, asked: Align, by: str) -> Job | Refusal:
        """Start an alignment, or return a refusal; raise CalibrationRefusedError if the request names no known kind."""
        action = next((each for each in _KINDS if each == asked.action), None)
        if action is None:
            allowed = Align.fields()["action"].allowed
            raise CalibrationRefusedError(f"align: 'action': found nothing; allowed: {allowed}")
        on_turn, sides = action == "turn", asked.sides and action == "compass"
        request = AlignmentRequest(
            action,
            len(SIDES) if sides else asked.headings or (HEADINGS if action in ("turn", "compass") else 2),
            write=asked.write and action in ("turn", "faces", "compass"),
            level=asked.level and on_turn,
            heading_deg=asked.heading if action == "compass" and not sides else None,
            sides=sides,
        )
        if action != "compass" and request.headings not in (2, HEADINGS):
            return Refusal("other", f"headings: found {request.headings}; allowed for {action}: 2 or 4")
        if request.headings == 1 and asked.heading is None and self._core.config.compass is None:
            return Refusal("other", "headings: found 1; allowed without --heading or a compass: 2, 3, 4, 6, 8")
        if self._core.config.vehicle.platform == "deck":
            return Refusal("other", "nothing is aligned on a deck that moves: align ashore")
        biases = What.BOTH if _KINDS[action] == ALIGNMENT else What.ACCELEROMETERS
        job = Job(_KINDS[action], biases, by, asked.timeout_s or ALIGN_TIMEOUT_S)
        return self.manager.start_job(job, partial(self._align_by, request), self._why_not_aligned(request))

    async def _align_by(self, request: AlignmentRequest, job: Job) -> str:
        task: PoseTask
        if request.action == "faces":
            task = SixPositionTask(request, self._imus, self.faces)
        elif request.action == "compass":
            task = CompassTask(self._core, request, self.estimator, self._fields)
        elif request.action == "turn":
            task = TurnTask(self._core, request, self._imus, self.faces)
        else:
            task = ZeroTask(self._core, request, self.alignment)
        if isinstance(task, CompassTask):
            await task.prepare()
            async with self._fields.asked():
                return await self.stands.run(job, task)
        result = await self.stands.run(job, task)
        if request.write and request.action == "faces":
            self.memory.forgotten()  # the new scales end them; a calibration need not warn of that
            await self.memory.keep({})
        return result

    def _why_not_aligned(self, request: AlignmentRequest) -> str | None:
        if _KINDS[request.action] == ALIGNMENT:
            has_one = self._core.config.gradienter is not None
            return None if has_one else "there is no gradienter to align: none is configured"
        if request.level and request.write:
            return "either --write (offsets) or --level (the board's tilt): what is in one is not in the other"
        if request.level and self.faces.record is None:
            return "the board's tilt needs a faces alignment: companion align faces --write first"
        return self._why_not_written(write=request.write or request.level)

    def _why_not_written(self, *, write: bool) -> str | None:
        if not self._imus:
            return "there is no IMU of the autopilot: none is configured"
        if write and not self._core.wanted.push:
            return "nothing is written while push.parameters is false"
        return None

    async def to_end(self, job: Job, product: str) -> AsyncIterator[Object]:
        async for reply in self._progress(job):
            yield reply
        result, made = job.finished.result(), msgspec.to_builtins(job.product)
        yield {"kind": "result", "state": result.outcome, "reason": result.reason, product: made}

    async def _progress(self, job: Job) -> AsyncIterator[Object]:
        while job.is_running:
            yield {
                "kind": "progress",
                "state": self.manager.state.shown,
                "word": self.manager.state.word,
                "percent": self.manager.progress_percent,
                "text": job.words,
            }
            await asyncio.wait([job.finished], timeout=PROGRESS_EVERY_S)

    def _why_no_curve_undo(self) -> str | None:
        steps = self._offsets.journal.steps(self._core.vehicle.system_id)
        after = [step.origin.what or "a write" for step in steps]
        if BY_TEMPERATURE not in after:
            return "no curve was written that could be undone"
        later = after[: after.index(BY_TEMPERATURE)]
        return None if not later else f"written since: {', '.join(later)}; companion undo restores that first"

    async def _write_curves(self, job: Job, *, overwrite: bool) -> str:
        """Write bias curves over temperature to the autopilot; verify that the IMU output stays; return a summary.

        The curves of all IMUs are written, or none. `overwrite`: replace even a temperature calibration by somebody
        else. After an error or a cancel, old parameter values are restored; the error names any that are not.
        """
        log = WriteLog()
        await self._core.offload(self.memory.follow)
        self.measuring.begin()
        window = await self.measuring.measure(job)
        if not await self._offsets.offsets_still_hold():
            raise CalibrationRefusedError("the autopilot's values were changed in between: try again")
        job.progress(MEASURED_PERCENT, "reading the autopilot's temperature calibration")
        targets, words, left = await self._curve_targets(window, overwrite=overwrite)
        if not targets:
            raise CalibrationRefusedError("; ".join(left or ["no IMU of the autopilot was measured"]))
        log.warnings += left
        if not any(target.all for target in targets):
            self._core.machine.on(Event.NOTHING_TO_WRITE)
            return "already active"
        plan = await self._offsets.write(job, Plan(tuple(targets), self._core.vehicle.boots), window, log)
        await self._offsets.settle(job, plan, window, log)
        job.product = {"imus": log.written, "warnings": log.all_warnings}
        return f"written: {'; '.join(words)}"

    async def _curve_targets(self, window: Window, *, overwrite: bool) -> tuple[list[ImuPlan], list[str], list[str]]:
        exchanged = self.memory.forgotten()  # the curve of a replaced IMU must not be written
        targets: list[ImuPlan] = []
        words: list[str] = []
        left: list[str] = []
        for means in (means for means in window.imus if means.name in self._imus):
            name, degc = means.name, means.temperature_degc
            curve, calibration = self.memory.curve(name, "gyro"), self._imus[name].in_force
            enabled_by = calibration.thermal.enabled_by
            if curve is None:
                left.append(exchanged.get(name) or f"imu {name}: no curve yet (companion autopilot temperature)")
            elif degc is None:
                left.append(f"imu {name}: it sends no temperature now")
            elif enabled_by and not overwrite and not self._wrote_curve(calibration.thermal):
                left.append(
                    f"imu {name}: {enabled_by} is on, set by another writer: its curve stays"
                    " (companion autopilot temperature --overwrite replaces it)"
                )
            else:
                gyro, accel = of_curve(curve, calibration.orientation), self._accelerometer_curve(name, curve)
                kind, parameters = self._core.vehicle.kind, self._core.parameters
                changes = await kind.thermal_changes(parameters, calibration, gyro, accel, degc)
                named = {change.parameter for target in targets for change in target.unseen}
                unseen = tuple(change for change in changes if change.parameter not in named)
                targets.append(ImuPlan(name, calibration, (), (np.zeros(3), np.zeros(3)), watched=True, unseen=unseen))
                low, high = curve.span_degc
                words.append(f"{name}, {low:.0f} to {high:.0f} degC")
        return targets, words, left

    def _accelerometer_curve(self, name: str, gyro: Curve) -> Polynomial | None:
        """Return the accelerometers' curve if it spans the gyros' temperatures (an autopilot has one span for both)."""
        curve, calibration = self.memory.curve(name, "accel"), self._imus[name].in_force
        if curve is None or not np.allclose(curve.span_degc, gyro.span_degc, rtol=0.0, atol=LOOK_K):
            return None
        return of_curve(curve, calibration.orientation, calibration.accel_scale)

    def _wrote_curve(self, thermal: Thermal) -> bool:
        ours: dict[str, float | None] = {}
        for step in reversed(self._offsets.journal.steps(self._core.vehicle.system_id)):
            if step.origin.what == BY_TEMPERATURE:
                ours |= {one.parameter: one.after for one in step.changes}
        found = [(ours[name], value) for name, value in thermal.values.items() if name in ours]
        return bool(found) and all(after is not None and same_float32(after, now) for after, now in found)


def accepted(answer: Job | Refusal) -> Job:
    if isinstance(answer, Refusal):
        raise RequestRefusedError(answer.kind, answer.reason)
    return answer

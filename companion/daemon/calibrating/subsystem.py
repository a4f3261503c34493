"""Calibrations and alignments as the daemon's interfaces see them: commands and status."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Mapping
from functools import partial
from typing import Final

import msgspec

from companion.autopilot.vehicle.ekf import OwnAttitude
from companion.commands import Align
from companion.component.service import Refusal
from companion.daemon.biases.into_autopilot import IntoAutopilot
from companion.daemon.biases.memory import BiasMemory
from companion.daemon.calibrating.estimator import Estimator, EstimatorInputs
from companion.daemon.calibrating.manager import CalibrationManager
from companion.daemon.calibrating.run import CalibrationParts
from companion.daemon.calibrating.why_not import Rung
from companion.daemon.core import Core, Handler, Subsystem
from companion.daemon.devices.subsystem import Devices
from companion.daemon.job import ALIGNMENT, TEMPERATURE, Job
from companion.daemon.offsets.dither import Ditherer
from companion.daemon.offsets.subsystem import Offsets
from companion.daemon.stands.alignment import AlignmentInForce, ByHand, FacesInForce
from companion.daemon.stands.alignments import KINDS, Alignments
from companion.daemon.stands.measuring import Measuring
from companion.errors import CalibrationRefusedError, RequestRefusedError
from companion.estimation.means.windows import Window
from companion.estimation.records.record import Record
from companion.estimation.request import What
from companion.estimation.solution.prior import Expectation
from companion.formats import Object
from companion.links.system.listeners import Listeners
from companion.links.system.waiting import comes
from companion.storage.records import RecordStore

PROGRESS_EVERY_S: Final = 0.2
HEARD_WITHIN_S: Final = 5.0
"""Longest wait of an undo for an autopilot not heard since the start."""
ALIGN_TIMEOUT_S: Final = 900.0
"""An alignment that nobody ends must not keep calibrations from starting for ever."""


class Calibrating(Subsystem):
    """Wires calibrations and alignments, and answers their commands."""

    def __init__(self, core: Core, devices: Devices, offsets: Offsets) -> None:
        config, imus = core.config, devices.imus
        self._core, self._offsets = core, offsets
        self.store = RecordStore(config.storage.path)
        self.alignment = AlignmentInForce(config, core.offload)
        self.memory = BiasMemory(core, imus, devices.sensors, self.alignment)
        self.measuring = measuring = Measuring(core, imus)
        self.faces = FacesInForce(core, imus)
        own = OwnAttitude(core.vehicle, wanted=config.compass is None)
        self.estimator = Estimator(core, self.alignment, self.faces, own)
        self.on_solved: Listeners[Window, Window, EstimatorInputs, What, Expectation] = Listeners()
        ditherer = Ditherer(core, imus, offsets.writer, offsets.ledger)
        self.stands = Alignments(core, imus, measuring, offsets, own, self.alignment, self.faces)
        self.by_hand = ByHand(core, imus)
        self._into_autopilot = IntoAutopilot(core, imus, measuring, self.memory, offsets)
        parts = CalibrationParts(core, imus, measuring, ditherer, self.estimator, self.memory, offsets, self.on_solved)
        self.manager = CalibrationManager(parts, self.store, self.by_hand)

    def load(self) -> None:  # noqa: D102 - as in the base class
        self.alignment.load()
        self.faces.load()
        self.by_hand.load()
        self.memory.load()
        self.manager.load()

    def commands(self) -> Mapping[str, Handler]:
        """Return the handlers; each raises `RequestRefusedError`, or another `CompanionError` once it has started."""
        return {
            "calibrate": self._calibrate,
            "align": self._align,
            "cancel": self._cancel,
            "undo": self._undo,
            "temperature": self._temperature,
        }

    def status(self) -> Object:  # noqa: D102
        manager, job = self.manager, self.manager.running
        still = self._core.collector.status(asyncio.get_running_loop().time())
        return {
            "state": manager.state.shown,
            "reason": job.words if job is not None else manager.reason,
            "progress": manager.progress_percent if job is not None else None,
            "still_s": round(still.still_s, 1),
            "waiting_for": still.waiting_for,
            "alignment": self.alignment.status(),
            "by_hand": self.by_hand.latest(),
            "stands": msgspec.to_builtins(self.stands.shown),
            "last": _summary(manager.last),
            "job": self._job(),
        }

    def _job(self) -> Object | None:
        """Progress of the latest job; None before the first."""
        manager, job = self.manager, self.manager.job
        if job is None:
            return None
        return {
            "kind": job.kind,
            "what": job.what.name.lower(),
            "requester": job.requester,
            "state": manager.state.shown,
            "percent": manager.progress_percent,
            "text": job.words if manager.running is not None else manager.reason,
        }

    async def _calibrate(self, request: Object, face: str) -> AsyncIterator[Object]:
        what, timeout_s, reboot = What[request["what"].upper()], request["timeout_s"], request["reboot"]
        job = _accepted(self.manager.start_calibration(what, f"{face} calibrate", timeout_s, reboot=reboot))
        if not request["wait"]:
            yield {"kind": "result", "state": self.manager.state.shown, "reason": "calibration started"}
            return
        async for reply in self._progress(job):
            yield reply
        yield {"kind": "result", "record": msgspec.to_builtins(job.record)}

    async def _temperature(self, request: Object, face: str) -> AsyncIterator[Object]:
        """Show the curves, write them, or undo their write."""
        action, into = request.get("action"), self._into_autopilot
        if action == "undo":
            await self._hear()
            if (why := into.why_no_undo()) is not None:
                raise RequestRefusedError("nothing_to_undo", why)
            async for reply in self._undo(request, face):
                yield reply
        elif action == "write":
            job = _accepted(
                self.manager.start_job(
                    TEMPERATURE,
                    What.GYROS,
                    f"{face} temperature",
                    ALIGN_TIMEOUT_S,
                    into.why_not(),
                    lambda job: into.run(job, overwrite=request.get("overwrite") is True),
                )
            )
            async for reply in self._to_end(job, "written"):
                yield reply
        else:
            yield {"kind": "result", "imus": await self._core.offload(self.memory.temperature)}

    async def _cancel(self, _request: Object, face: str) -> AsyncIterator[Object]:
        running = self.manager.cancel(f"{face} cancel")
        if running and self.manager.job is not None:
            await asyncio.shield(self.manager.job.finished)
        reason = self.manager.reason if running else "nothing was running"
        yield {"kind": "result", "state": self.manager.state.shown, "reason": reason}

    async def _undo(self, request: Object, face: str) -> AsyncIterator[Object]:
        await self._hear()
        job = _accepted(self.manager.start_undo(f"{face} undo", force=request.get("force") is True))
        result = await asyncio.shield(job.finished)
        yield {
            "kind": "result",
            "state": result.outcome,
            "reason": result.reason,
            "written": {} if job.undone is None else msgspec.to_builtins(job.undone.written),
            "undone": None if job.undone is None else job.undone.step.shown(),
            "undoable": self._offsets.undoable(),
        }

    async def _hear(self) -> None:
        vehicle = self._core.vehicle
        if vehicle.heartbeat_age_s is None:  # the daemon may have started just now
            await comes(vehicle.found, HEARD_WITHIN_S)

    async def _align(self, request: Object, face: str) -> AsyncIterator[Object]:
        """Show, forget or measure the alignment."""
        action = request.get("action")
        if action == "show":
            yield {"kind": "result", **self._shown()}
        elif action == "forget":
            if (busy := self.manager.why_not((Rung.BUSY,))) is not None:
                raise CalibrationRefusedError(busy.words)
            was = await self.alignment.forget()
            words = "the configuration's zero and sigma are in force" if was else "there was no alignment to forget"
            yield {"kind": "result", "state": "done", "reason": words}
        else:
            job = _accepted(self.start_alignment(request, f"{face} align"))
            if request.get("wait") is False:
                yield {"kind": "result", "state": self.manager.state.shown, "reason": f"{job.kind} started"}
                return
            async for reply in self._to_end(job, "alignment"):
                yield reply

    def _shown(self) -> Object:
        alignment, sides = self.alignment, self.faces.status()
        if alignment.used is not None or (sides and alignment.settings() is None):
            state, reason = "in force", ""
        elif alignment.unused is not None:
            state, reason = "not used", alignment.unused
        else:
            state, reason = "none", "no alignment is kept: companion align zero measures one"
        found = {"alignment": msgspec.to_builtins(alignment.record), "accelerometers": sides}
        return {"state": state, "reason": reason, **found}

    def start_alignment(self, request: Object, by: str) -> Job | Refusal:
        """Start an alignment, or refuse.

        Raises:
            CalibrationRefusedError: the request is not understood.
        """
        timeout_s = request.get("timeout_s") or ALIGN_TIMEOUT_S
        asked = self.stands.parse(request)
        if asked is None:
            allowed = Align.fields()["action"].allowed
            raise CalibrationRefusedError(f"align: 'action': found nothing; allowed: {allowed}")
        kind, what = KINDS[asked.action]
        if self._core.config.vehicle.platform == "deck":
            if kind == ALIGNMENT:
                return Refusal("other", "a zero is not measured on a deck that moves: align ashore")
            return Refusal("other", "accelerometers are not measured on a deck that moves: align ashore")
        missing, run = self.stands.blocking_reason(asked), partial(self.stands.run, request=asked)
        return self.manager.start_job(kind, what, by, timeout_s, missing, run)

    async def _to_end(self, job: Job, product: str) -> AsyncIterator[Object]:
        """Yield progress, then the result with the job's product under this key."""
        async for reply in self._progress(job):
            yield reply
        result = job.finished.result()
        yield {
            "kind": "result",
            "state": result.outcome,
            "reason": result.reason,
            product: msgspec.to_builtins(job.product),
        }

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


def _accepted(answer: Job | Refusal) -> Job:
    if isinstance(answer, Refusal):
        raise RequestRefusedError(answer.kind, answer.reason)
    return answer


def _summary(record: Record | None) -> Object | None:
    if record is None:
        return None
    return {
        "state": record.state,
        "started_at": record.started_at,
        "reason": record.reason,
        "magnetic": msgspec.to_builtins(record.magnetic),
        "when_warm": [words for imu in record.imus if imu.when_warm is not None for words in imu.when_warm.words],
    }

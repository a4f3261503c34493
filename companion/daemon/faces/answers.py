"""What the control socket answers: commands of `companion`, and the daemon's status."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
from typing import Any, Final, Protocol

import msgspec

from companion.autopilot.vehicle.vehicle import Vehicle
from companion.calibration.collector.rolling import RollingCollector
from companion.calibration.request import What, is_time_limit
from companion.calibration.solution.record import Record
from companion.component.permission import Permission
from companion.component.service import Refusal
from companion.daemon.arming.armings import Armings, with_armings
from companion.daemon.arming.automatic import Automatic
from companion.daemon.arming.gate_setup import GateSetup
from companion.daemon.arming.readiness import Readiness
from companion.daemon.calibrating.alignment import AlignmentInForce
from companion.daemon.calibrating.conductor import Conductor
from companion.daemon.devices.reach import Reach
from companion.daemon.devices.signing import LinkSigning
from companion.daemon.faces.align_answers import answer_align
from companion.daemon.faces.headline import Headlines
from companion.daemon.faces.shown_calibration import shown_calibration
from companion.daemon.heading.pose_now import PoseNow
from companion.daemon.job import Job
from companion.daemon.offload import Offload
from companion.daemon.offsets.recovery import Recovery
from companion.daemon.offsets.rivalry import Rivalry
from companion.daemon.recorder.recorder import Recorder
from companion.errors import CalibrationRefusedError
from companion.links.mavlink.link import MavlinkLink
from companion.links.system.request import Object
from companion.storage.records import RecordStore

MONITOR_EVERY_S: Final = 0.5
PROGRESS_EVERY_S: Final = 0.2


class RequestRefusedError(CalibrationRefusedError):
    """A request was not taken; `kind` as in `Refusal`."""

    def __init__(self, refusal: Refusal) -> None:
        super().__init__(refusal.reason)
        self.kind = refusal.kind


class Device(Protocol):
    """What has a line in `companion status`."""

    def status(self) -> Object:
        """How it does."""
        ...


class Carried(Protocol):
    """Who carries the attitude."""

    @property
    def warnings(self) -> list[str]:
        """For people."""
        ...

    @property
    def concern(self) -> str | None:
        """What the pilot of an armed aircraft should know at once."""
        ...

    def view(self) -> Object:
        """Everything, as JSON can hold it."""
        ...


class Answers:
    """Turns requests of the control socket into what the daemon does, and what it does into JSON."""

    def __init__(
        self,
        conductor: Conductor,
        vehicle: Vehicle,
        collector: RollingCollector,
        devices: Sequence[Device],
        store: RecordStore,
        offload: Offload,
        *,
        mavlink_url: str,
        rivalry: Rivalry,
        reach: Reach,
        recovery: Recovery,
        readiness: Readiness,
        armings: Armings,
        gate_setup: GateSetup,
        automatic: Automatic,
        recorder: Recorder,
        link: MavlinkLink,
        pose: PoseNow,
        trouble: Callable[[], str | None],
        implausible: Callable[[], str | None],
        alignment: AlignmentInForce,
    ) -> None:
        self._conductor, self._vehicle, self._collector, self._devices = conductor, vehicle, collector, devices
        self._store, self._offload, self._mavlink_url = store, offload, mavlink_url
        self._rivalry, self._reach, self._recovery, self._readiness = rivalry, reach, recovery, readiness
        self._armings, self._gate_setup, self._automatic = armings, gate_setup, automatic
        self._recorder, self._link, self._pose, self._alignment = recorder, link, pose, alignment
        self._headlines = Headlines(vehicle, collector, conductor, readiness, automatic, mavlink_url, trouble)
        self._concerns: list[Callable[[], str | None]] = [implausible]
        self._headlines.concern = lambda: next(filter(None, (concern() for concern in self._concerns)), None)
        self._carried: Carried | None = None
        self._signing: LinkSigning | None = None
        self._permission = Permission()
        self.page: Callable[[], Object | None] = lambda: None
        """What is to be said of the page; None where none is configured."""
        self.profiles: list[Object] = []
        """Whose noise figures the sigmas of each IMU are made of."""
        self.setup: Callable[[Object], Awaitable[Object]] | None = None
        """Sets the autopilot up for our heading."""
        self.unusable: Callable[[], Sequence[str]] = tuple
        """Files with old values that could not be used, each in a line."""
        self.mqtt: Callable[[], Object] = dict
        """How the broker is reached; empty where none is configured."""

    def watch_access(self, signing: LinkSigning, permission: Permission) -> None:
        """Tell of who is not believed and who was refused, too."""
        self._signing, self._permission = signing, permission
        self._headlines.rejecting = lambda: signing.rejecting
        self._concerns.append(lambda: signing.warning)

    def carry(self, attitude: Carried | None) -> None:
        """Tell of the attitude that is carried, too."""
        self._carried = attitude
        if attitude is not None:
            self._concerns.append(lambda: attitude.concern)

    async def answer(self, request: Object, face: str = "companion") -> AsyncIterator[Object]:
        """Answer one request of the control socket, or of another face that speaks its words.

        Raises:
            RequestRefusedError: it is not taken, and why.
            CompanionError: it could not be carried out.
        """
        command = request.get("command")
        if command == "status":
            yield {"kind": "result", "status": await self.look()}
        elif command == "calibrate":
            async for reply in self._answer_calibrate(request, face):
                yield reply
        elif command == "align":
            async for reply in answer_align(self._conductor, self._alignment, request, face):
                yield reply
        elif command == "cancel":
            running = self._conductor.cancel(f"{face} cancel")
            if running and self._conductor.job is not None:
                await asyncio.shield(self._conductor.job.finished)
            reason = self._conductor.reason if running else "nothing was running"
            yield {"kind": "result", "state": self._conductor.state.shown, "reason": reason}
        elif command == "undo":
            job = _accepted(self._conductor.start_undo(f"{face} undo", force=request.get("force") is True))
            result = await asyncio.shield(job.finished)
            written = {name: _plain(what) for name, what in job.written.items()}
            yield {"kind": "result", "state": result.outcome, "reason": result.reason, "written": written}
        elif command == "history":
            limit = request.get("limit")
            number = limit if isinstance(limit, int) and limit > 0 else None
            # A thousand records take longer to read than a ground station waits for an answer.
            numbers, records, armings = await self._offload(self._history, number)
            yield {"kind": "result", "numbers": numbers, "records": records, "armings": armings}
        elif command == "record":
            async for reply in self._recorder.answer(request):
                yield reply
        elif command == "autopilot-setup" and self.setup is not None:
            yield await self.setup(request)
        elif command == "monitor":
            while True:
                yield {"kind": "progress", "status": await self.look()}
                await asyncio.sleep(MONITOR_EVERY_S)
        else:
            yield {"kind": "error", "reason": f"unknown command {command!r}"}

    def _history(self, limit: int | None) -> tuple[list[int], list[Object], list[Object]]:
        armings = self._armings.history()
        found = self._store.numbered(limit)
        records = with_armings(list(found.values()), armings)
        return list(found), [_plain(record) for record in records], [_plain(arming) for arming in armings[:limit]]

    async def _answer_calibrate(self, request: Object, face: str) -> AsyncIterator[Object]:
        try:
            what = What[str(request.get("what", "both")).upper()]
        except KeyError as error:
            raise CalibrationRefusedError(f"calibrate: {error} is not understood") from None
        timeout_s = request.get("timeout_s")
        if timeout_s is not None and not is_time_limit(timeout_s):
            raise CalibrationRefusedError(
                f"calibrate: 'timeout_s': found {timeout_s!r}; allowed: a number of seconds above 0"
            )
        reboot = request.get("reboot") is True
        job = _accepted(self._conductor.start_calibration(what, f"{face} calibrate", timeout_s, reboot=reboot))
        if not request.get("wait"):
            yield {"kind": "result", "state": self._conductor.state.shown, "reason": "calibration started"}
            return
        while job.is_running:
            yield {
                "kind": "progress",
                "state": self._conductor.state.shown,
                "percent": self._conductor.progress_percent,
                "text": job.words,
            }
            await asyncio.wait([job.finished], timeout=PROGRESS_EVERY_S)
        yield {"kind": "result", "record": _plain(job.record)}

    async def look(self) -> Object:
        """`status`, with the declination of the place looked up when it is time to."""
        await self._pose.look()
        return self.status()

    def status(self) -> Object:
        """What the daemon is doing, as JSON can hold it."""
        conductor, job = self._conductor, self._conductor.running
        now_s = asyncio.get_running_loop().time()
        still = self._collector.status(now_s)
        age_s = self._vehicle.heartbeat_age_s
        received = self._link.received
        devices = [device.status() for device in self._devices]
        counts = {source.name: {"lost": source.lost, "dropped": source.dropped} for source in still.sources}
        return {
            "headline": _plain(self._headlines.now()),
            "state": conductor.state.shown,
            "reason": job.words if job is not None else conductor.reason,
            "progress": conductor.progress_percent if job is not None else None,
            "still_s": round(still.still_s, 1),
            "waiting_for": still.waiting_for,
            "vehicle": {
                "system_id": self._vehicle.system_id,
                "firmware": self._vehicle.firmware,
                "armed": self._vehicle.arm_state.value,
                "summary": f"{self._vehicle.name}, {self._vehicle.arm_state.value}"
                if self._vehicle.system_id is not None
                else f"not heard yet on {self._mavlink_url}{self._headlines.why_rejecting()}",
                "heartbeat_age_s": None if age_s is None else round(age_s, 1),
                "messages": received.total() - received["bad"],
                "bad": received["bad"],
                "not_sent": self._link.dropped,
                "signing": None if self._signing is None else self._signing.status(),
                "refused": {f"{system}/{one}": count for (system, one), count in self._permission.refused.items()},
            },
            "pose": self._pose.now(),
            "readings": self._pose.readings(),
            "alignment": self._alignment.status(),
            "warnings": [
                *self.unusable(),
                *self._rivalry.warnings,
                *(self._carried.warnings if self._carried is not None else ()),
            ],
            "attitude": None if self._carried is None else self._carried.view(),
            "ground_stations": dict(zip(("good", "summary"), self._reach.words(), strict=True)),
            "fault": self._recovery.fault,
            "putting_back": self._recovery.pending,
            "why_no_undo": self._recovery.why_no_undo(),
            "devices": [device | counts.get(str(device["name"]), {}) for device in devices],
            "arming": {
                **self._readiness.status(),
                "setup": self._gate_setup.status(),
                "last": _plain(self._armings.last),
            },
            "automatic": self._automatic.status(),
            "recording": self._recorder.status(),
            "mqtt": self.mqtt() or None,
            "profiles": self.profiles,
            "calibration": shown_calibration(self._readiness.in_force, conductor.last, now_s),
            "last": _summary(conductor.last),
            "page": self.page(),
        }


def _accepted(answer: Job | Refusal) -> Job:
    if isinstance(answer, Refusal):
        raise RequestRefusedError(answer)
    return answer


def _plain(value: object) -> Any:
    return msgspec.to_builtins(value)


def _summary(record: Record | None) -> Object | None:
    if record is None:
        return None
    return {
        "state": record.state,
        "started_at": record.started_at,
        "reason": record.reason,
        "magnetic": _plain(record.magnetic),
    }

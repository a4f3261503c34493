"""The daemon: everything wired together, running until a signal."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import signal
from collections.abc import AsyncIterator, Iterator
from typing import Any, Final

import msgspec

from companion.autopilot.imu_stream import StreamKind
from companion.autopilot.parameters import ParameterClient
from companion.autopilot.vehicle import Vehicle
from companion.autopilot.writer import ParameterWriter
from companion.calibration.record import Record
from companion.calibration.request import What
from companion.calibration.rolling import RollingCollector
from companion.component.component import Component
from companion.component.service import Refusal
from companion.config import Config, Imu
from companion.daemon import models
from companion.daemon.autopilot_imu import AutopilotImu
from companion.daemon.conductor import Conductor
from companion.daemon.control import ControlServer, Object
from companion.daemon.flight_line import define_parameters
from companion.daemon.job import Job
from companion.daemon.ledger import Ledger, Offload
from companion.daemon.mend import Mender
from companion.daemon.push import Pusher
from companion.daemon.sensors import SerialSensor
from companion.errors import CalibrationRefusedError, CompanionError
from companion.links.mavlink import MavlinkLink
from companion.links.mavlink_transport import run_transport
from companion.samples import CompassSample, ImuSample, Sample, TiltSample
from companion.storage.changes import ChangeLog
from companion.storage.records import RecordStore

logger = logging.getLogger(__name__)

MONITOR_EVERY_S: Final = 0.5
PROGRESS_EVERY_S: Final = 0.2


class Service:
    """All parts of the daemon on one event loop.

    Args:
        config: what to run.
        link: the MAVLink connection; a test may have put it on a wire of its own.
        offload: runs a blocking call elsewhere.
        imu_rate_hz: asked of the autopilot for each IMU; it may grant less.
    """

    def __init__(
        self,
        config: Config,
        *,
        link: MavlinkLink | None = None,
        offload: Offload = asyncio.to_thread,
        imu_rate_hz: float = 100.0,
    ) -> None:
        self.config = config
        self.link = link or MavlinkLink(
            system_id=config.vehicle.system_id or 1, component_id=config.mavlink.component_id
        )
        self.vehicle = Vehicle(self.link, system_id=config.vehicle.system_id)
        self.parameters = ParameterClient(self.link, self.vehicle)
        self.collector = RollingCollector(
            models.settings(config),
            [models.imu_input(imu, None) for imu in config.imu],
            gradienter=config.gradienter is not None,
            compass=config.compass is not None,
        )
        self._imu_rate_hz, self._offload = imu_rate_hz, offload
        self.imus = {imu.name: self._autopilot_imu(imu) for imu in config.imu if imu.source == "autopilot"}
        self.sensors = self._serial_sensors()
        self.store = RecordStore(config.storage.path)
        self.ledger = Ledger(ChangeLog(config.storage.path), offload)
        writer = ParameterWriter(self.parameters, self.vehicle)
        pusher = Pusher(config, self.vehicle, self.parameters, self.imus, self.collector, writer, self.ledger)
        self.mender = Mender(self.vehicle, self.parameters, writer, self.ledger, self._say, self._changing)
        self.conductor = Conductor(
            config, self.vehicle, self.collector, self.imus, pusher, self.mender, self.store, self._say, offload
        )
        self.component = Component(self.link, self.vehicle, self.conductor)
        define_parameters(self.component.parameters, config, self.conductor)

    def _say(self, *what: Any) -> object:
        return self.component.say(*what)

    @contextlib.contextmanager
    def _changing(self) -> Iterator[None]:
        with contextlib.ExitStack() as stack:
            for imu in self.imus.values():
                stack.enter_context(imu.changing())
            yield

    def _autopilot_imu(self, imu: Imu) -> AutopilotImu:
        def kind_changed(kind: StreamKind | None) -> None:
            self.collector.set_imu(models.imu_input(imu, kind))

        def take(sample: ImuSample) -> None:
            self.collector.add_imu(imu.name, sample)

        def void(why: str) -> None:
            self.collector.reset(why, imu.name)

        return AutopilotImu(
            imu.name,
            imu.instance or 1,
            self.link,
            self.vehicle,
            self.parameters,
            take=take,
            void=void,
            kind_changed=kind_changed,
            rate_hz=self._imu_rate_hz,
        )

    def _serial_sensors(self) -> list[SerialSensor]:
        sensors = []
        for imu in self.config.imu:
            if imu.source == "serial" and imu.port is not None and imu.protocol is not None:
                sensors.append(
                    SerialSensor(
                        imu.name,
                        "imu",
                        port=imu.port,
                        protocol=imu.protocol,
                        baud=imu.baud,
                        parity=None,
                        take=self._take_imu(imu.name),
                    )
                )
        for kind in ("gradienter", "compass"):
            device = getattr(self.config, kind)
            if device is not None:
                sensors.append(
                    SerialSensor(
                        kind,
                        kind,
                        port=device.port,
                        protocol=device.protocol,
                        baud=device.baud,
                        parity=device.parity,
                        take=self._take,
                    )
                )
        return sensors

    def _take_imu(self, name: str) -> Any:
        def take(sample: Sample) -> None:
            if isinstance(sample, ImuSample):
                self.collector.add_imu(name, sample)

        return take

    def _take(self, sample: Sample) -> None:
        if isinstance(sample, TiltSample):
            self.collector.add_tilt(sample)
        elif isinstance(sample, CompassSample):
            self.collector.add_compass(sample)

    async def run(self) -> None:
        """Run until cancelled, reachable on the control socket.

        Raises:
            CompanionError: it cannot start (another daemon runs, the storage cannot be read).
        """
        for words in models.not_in_this_version(self.config):
            logger.warning("%s", words)
        async with ControlServer(self.config.control.path, self.answer):
            logger.info("ready: %s", self.config.control.path)
            await self.serve()

    async def serve(self, *, mavlink: bool = True, ports: bool = True) -> None:
        """Do the work until cancelled, then leave the autopilot in order.

        Args:
            mavlink: open the configured MAVLink connection (else the link has been put on a wire already).
            ports: open the serial ports (else somebody hands their bytes to `sensors`).
        """
        self.ledger.load()
        if self.ledger.fault is not None:
            # Stay and say so: a daemon that is gone is harder to understand from the field.
            logger.error("%s", self.ledger.fault)
        else:
            self.conductor.last = next(iter(self.store.history(limit=1)), None)
        try:
            async with asyncio.TaskGroup() as group:
                try:
                    group.create_task(self.component.run(), name="component")
                    if mavlink:
                        group.create_task(run_transport(self.link, self.config.mavlink.url), name="mavlink")
                    group.create_task(self.mender.run(), name="mender")
                    for imu in self.imus.values():
                        group.create_task(imu.run(), name=imu.name)
                    for sensor in self.sensors if ports else ():
                        group.create_task(sensor.run(), name=sensor.name)
                    await asyncio.get_running_loop().create_future()
                finally:
                    # Before the links go: a write under way needs them to come to its end.
                    await self.conductor.close()
        finally:
            self.vehicle.close()

    async def listen(self, seconds: float) -> Object:
        """Open everything, listen, and tell what `status` would; for `companion check`, writes nothing."""
        self.conductor.only_listening = "only a check is running: start companion run"
        running = [self.component.run(), run_transport(self.link, self.config.mavlink.url)]
        running += [imu.run() for imu in self.imus.values()]
        running += [sensor.run() for sensor in self.sensors]
        tasks = [asyncio.get_running_loop().create_task(one) for one in running]
        try:
            await asyncio.sleep(seconds)
            return self.status()
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

    # --- the control socket

    async def answer(self, request: Object) -> AsyncIterator[Object]:
        """Answer one request of the control socket."""
        command = request.get("command")
        if command == "status":
            yield {"kind": "result", "status": self.status()}
        elif command == "calibrate":
            async for reply in self._answer_calibrate(request):
                yield reply
        elif command == "cancel":
            running = self.conductor.cancel("companion cancel")
            if running and self.conductor.job is not None:
                await asyncio.shield(self.conductor.job.finished)
            reason = self.conductor.reason if running else "nothing was running"
            yield {"kind": "result", "state": self.conductor.state.value, "reason": reason}
        elif command == "undo":
            job = _accepted(self.conductor.start_undo("companion undo"))
            result = await asyncio.shield(job.finished)
            written = {name: _plain(what) for name, what in job.written.items()}
            yield {"kind": "result", "state": result.outcome, "reason": result.reason, "written": written}
        elif command == "history":
            limit = request.get("limit")
            number = limit if isinstance(limit, int) and limit > 0 else None
            # A thousand records take longer to read than a ground station waits for an answer.
            yield {"kind": "result", "records": await self._offload(self._history, number)}
        elif command == "monitor":
            while True:
                yield {"kind": "progress", "status": self.status()}
                await asyncio.sleep(MONITOR_EVERY_S)
        else:
            yield {"kind": "error", "reason": f"unknown command {command!r}"}

    def _history(self, limit: int | None) -> list[Object]:
        return [_plain(record) for record in self.store.history(limit)]

    async def _answer_calibrate(self, request: Object) -> AsyncIterator[Object]:
        try:
            what = What[str(request.get("what", "both")).upper()]
            timeout_s = request.get("timeout_s")
            timeout_s = None if timeout_s is None else float(timeout_s)
        except (KeyError, TypeError, ValueError) as error:
            raise CalibrationRefusedError(f"calibrate: {error} is not understood") from None
        job = _accepted(self.conductor.start_calibration(what, "companion calibrate", timeout_s))
        if not request.get("wait"):
            yield {"kind": "result", "state": self.conductor.state.value, "reason": "calibration started"}
            return
        while not job.finished.done():
            yield {
                "kind": "progress",
                "state": self.conductor.state.value,
                "percent": job.progress_percent,
                "text": job.words,
            }
            await asyncio.wait([job.finished], timeout=PROGRESS_EVERY_S)
        yield {"kind": "result", "record": _plain(job.record)}

    def status(self) -> Object:
        """What the daemon is doing, as JSON can hold it."""
        conductor, job = self.conductor, self.conductor.job
        busy = job is not None and not job.finished.done()
        now_s = asyncio.get_running_loop().time()
        still = self.collector.status(now_s)
        return {
            "state": conductor.state.value,
            "reason": job.words if busy and job is not None else conductor.reason,
            "progress": job.progress_percent if busy and job is not None else None,
            "still_s": round(still.still_s, 1),
            "waiting_for": still.waiting_for,
            "vehicle": {
                "system_id": self.vehicle.system_id,
                "firmware": self.vehicle.firmware,
                "armed": self.vehicle.arm_state.value,
                "summary": f"{self.vehicle.name}, {self.vehicle.arm_state.value}"
                if self.vehicle.system_id is not None
                else f"not heard yet on {self.config.mavlink.url}",
            },
            "fault": self.mender.fault,
            "putting_back": self.mender.pending,
            "devices": [
                *(imu.status() for imu in self.imus.values()),
                *(sensor.status() for sensor in self.sensors),
            ],
            "last": _summary(conductor.last),
        }


def _accepted(answer: Job | Refusal) -> Job:
    if isinstance(answer, Refusal):
        raise CalibrationRefusedError(answer.reason)
    return answer


def _plain(value: object) -> Any:
    return msgspec.to_builtins(value)


def _summary(record: Record | None) -> Object | None:
    if record is None:
        return None
    return {"state": record.state, "started_at": record.started_at, "reason": record.reason}


async def run(config: Config) -> None:
    """Run the daemon until SIGTERM or SIGINT.

    Raises:
        CompanionError: it cannot start.
    """
    service = Service(config)
    loop = asyncio.get_running_loop()
    task = asyncio.current_task()
    stopped = False

    def stop() -> None:
        nonlocal stopped
        stopped = True
        if task is not None:
            task.cancel()

    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, stop)
    try:
        await service.run()
    except asyncio.CancelledError:
        if not stopped:
            raise
        logger.info("stopped")
    except BaseExceptionGroup as group:
        known = group.subgroup(CompanionError)
        if known is None:
            raise
        raise CompanionError("; ".join(str(error) for error in _leaves(known))) from group


def _leaves(group: BaseExceptionGroup[Any]) -> Iterator[BaseException]:
    for error in group.exceptions:
        if isinstance(error, BaseExceptionGroup):
            yield from _leaves(error)
        else:
            yield error

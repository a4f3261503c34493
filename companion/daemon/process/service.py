"""The daemon: everything wired together, running until a signal."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

from companion.autopilot.firmware.imu_calibration import accel_taken_off
from companion.autopilot.firmware.px4_slots import SlotMemory
from companion.autopilot.parameters.client import ParameterClient
from companion.autopilot.parameters.writer import ParameterWriter
from companion.autopilot.telemetry.imu_stream import StreamKind
from companion.autopilot.vehicle.ekf import EkfWatch
from companion.autopilot.vehicle.vehicle import ArmState, Vehicle
from companion.calibration.machine import Machine
from companion.component.component import Component
from companion.component.service import JobResult
from companion.config import Config, Imu
from companion.config.senders import Senders
from companion.configured import models
from companion.configured.devices import Role, collect, serial_devices
from companion.daemon.arming.armings import Armings
from companion.daemon.arming.automatic import Automatic
from companion.daemon.arming.gate_setup import GateSetup
from companion.daemon.arming.in_force import InForce
from companion.daemon.arming.readiness import Readiness
from companion.daemon.calibrating.aligner import Aligner
from companion.daemon.calibrating.alignment import AlignmentInForce
from companion.daemon.calibrating.bias_memory import BiasMemory
from companion.daemon.calibrating.conductor import Conductor
from companion.daemon.calibrating.course import Course
from companion.daemon.calibrating.results import Results
from companion.daemon.devices.autopilot_imu import AutopilotImu
from companion.daemon.devices.reach import Reach
from companion.daemon.devices.sensor_watch import UNTOUCHED, Corrected, SensorWatch
from companion.daemon.devices.sensors import SerialSensor
from companion.daemon.devices.signing import LinkSigning
from companion.daemon.faces.answers import Answers
from companion.daemon.faces.control import ControlServer
from companion.daemon.faces.flight_line import define_parameters
from companion.daemon.heading.heading_setup import HeadingSetup
from companion.daemon.heading.pose_now import PoseNow
from companion.daemon.job import ALIGNMENT, Job
from companion.daemon.offload import Offload, keep_ticking
from companion.daemon.offsets.dither import Ditherer
from companion.daemon.offsets.far_step import FarStepWatch
from companion.daemon.offsets.firmware_calibration import FirmwareCalibration
from companion.daemon.offsets.ledger import Ledger
from companion.daemon.offsets.plan import Planner
from companion.daemon.offsets.push import Pusher
from companion.daemon.offsets.px4_writes import Px4Writes
from companion.daemon.offsets.reboot import Reboot
from companion.daemon.offsets.recovery import Recovery
from companion.daemon.offsets.rivalry import Rivalry
from companion.daemon.recorder.recorder import Recorder
from companion.links.mavlink.link import MavlinkLink
from companion.links.mavlink.transport import run_transport
from companion.links.system.request import Object
from companion.protocols.roles import Part
from companion.recording.collector import RecordedCollector
from companion.samples import ImuSample
from companion.storage.changes import ChangeLog
from companion.storage.lock import only_daemon
from companion.storage.records import RecordStore

if TYPE_CHECKING:
    from companion.daemon.faces.mqtt.face import MqttFace
    from companion.daemon.heading.attitude_service import AttitudeService
    from companion.web.server import Page

logger = logging.getLogger(__name__)


class Service:
    """All parts of the daemon on one event loop.

    Args:
        config: what to run.
        link: the MAVLink connection; a test may have put it on a wire of its own.
        offload: runs a blocking call elsewhere.
        imu_rate_hz: asked of the autopilot for each IMU, which may grant less; None: what the connection can carry.
    """

    def __init__(
        self,
        config: Config,
        *,
        link: MavlinkLink | None = None,
        offload: Offload = asyncio.to_thread,
        imu_rate_hz: float | None = None,
    ) -> None:
        self.config = config
        self.on_ready: Callable[[], None] = lambda: None
        """Called when it can be talked to."""
        self.link = link or MavlinkLink(
            system_id=config.vehicle.system_id or 1, component_id=config.mavlink.component_id
        )
        self.vehicle = Vehicle(self.link, system_id=config.vehicle.system_id, is_carried=self._is_carried)
        self.parameters = ParameterClient(self.link, self.vehicle)
        self.collector = RecordedCollector(
            models.settings(config),
            [models.imu_input(imu, None) for imu in config.imu],
            gradienter=config.gradienter is not None,
            compass=config.compass is not None,
            gradienter_lag=models.lag("gradienter", config.gradienter),
            compass_lag=models.lag("compass", config.compass),
            field_by=models.field_by(config),
            message_of=self._message_of,
        )
        self.slots = SlotMemory()
        self._imu_rate_hz = models.imu_rate_hz(config) if imu_rate_hz is None else imu_rate_hz
        self.imus = {imu.name: self._autopilot_imu(imu) for imu in config.imu if imu.source == "autopilot"}
        self.sensors = [
            SerialSensor(device, self._take, offload, self.link.together) for device in serial_devices(config)
        ]
        self.sensor_watch = SensorWatch(self.sensors, self.collector, self._corrected, self._say)
        self.recorder = Recorder(
            config, self.collector, self.link, self.vehicle, self.imus.values(), self.sensors, offload
        )
        self.store = RecordStore(config.storage.path)
        self.alignment = AlignmentInForce(config, offload)
        self.memory = BiasMemory(config, self.vehicle, self.imus, self.sensors, self.alignment, offload)
        self.ledger = Ledger(ChangeLog(config.storage.path), offload)
        writer = ParameterWriter(self.parameters, self.vehicle)
        far = FarStepWatch(self.link, self.vehicle, self.slots)
        px4 = Px4Writes(self.vehicle, writer, self.ledger, far, self.slots, self._say)
        self.rivalry = Rivalry(self.vehicle, self.imus, self._say, stop_rivals=config.push.stop_rivals)
        ekf = EkfWatch(self.link, self.vehicle)
        pusher = Pusher(
            config,
            self.vehicle,
            self.parameters,
            self.imus,
            self.collector,
            writer,
            self.ledger,
            px4,
            Planner(config, self.vehicle, self.parameters, self.imus, self.slots, self.rivalry),
            FirmwareCalibration(self.vehicle, self.parameters, writer, self.ledger, ekf),
            offload,
        )
        self.recovery = Recovery(self.vehicle, self.parameters, writer, self.ledger, self._say, self._changing)
        reboot = Reboot(self.vehicle, self.parameters, pusher, self._say)
        machine = Machine()
        course = Course(
            config,
            machine,
            self.vehicle,
            self.collector,
            self.imus,
            pusher,
            self._say,
            offload,
            reboot,
            Ditherer(config, self.vehicle, self.parameters, self.imus, self.collector, writer, self.ledger, machine),
            self.alignment,
            self.memory,
        )
        aligner = Aligner(config, self.vehicle, self.collector, self.imus, machine, self.alignment, self._say, offload)
        self.results = Results(self.store, self.collector, self.memory, self._say, offload)
        self.conductor = Conductor(
            config, self.vehicle, self.collector, course, aligner, self.recovery, self.results, self._say
        )
        course.on_solved = self.recorder.on_solved
        self.recorder.alignment = lambda: self.alignment.used
        self.recorder.is_busy = lambda: self.conductor.state.busy
        self.reach = Reach(self.link, self.vehicle, self.parameters)
        self.in_force = InForce(config, self.vehicle, self.collector, self.imus, offload)
        self.in_force.gradienter = self.alignment.model
        self.alignment.on_change = self.in_force.realigned
        self.readiness = Readiness(self.vehicle, self.collector, self.conductor, self.in_force)
        self.readiness.reboot_owed = lambda: reboot.owed
        self.automatic = Automatic(
            self.vehicle,
            self.collector,
            self.conductor,
            self.imus,
            self.in_force,
            config.storage.path,
            self._say,
            offload,
        )
        self.conductor.watch(self._on_ended)
        self.readiness.why_not_by_itself = self.automatic.why_not
        self.armings = Armings(self.vehicle, self.readiness, config.storage.path, self._say, offload)
        self.gate_setup = GateSetup(self.vehicle, self.parameters, self.readiness, self._say)
        self.component = Component(self.link, self.vehicle, self.conductor, self.readiness)
        self.component.permission.senders = Senders(config.mavlink.allow)
        self.signing = LinkSigning(config, self.link, self.vehicle, self._say, offload)
        define_parameters(self.component.parameters, config, self.conductor)
        self.pose = PoseNow(config, self.vehicle, self.collector, offload)
        self.pose.gradienter = self.alignment.model
        self.attitude = self._attitude_service(offload)
        self.setup = HeadingSetup(config, self.vehicle, self.parameters, writer, self.conductor, self._say, offload)
        carried = [self.attitude] if self.attitude is not None else []
        self.answers = Answers(
            self.conductor,
            self.vehicle,
            self.collector,
            [*self.imus.values(), *(role for sensor in self.sensors for role in sensor.roles), *carried],
            self.store,
            offload,
            mavlink_url=config.mavlink.url,
            rivalry=self.rivalry,
            reach=self.reach,
            recovery=self.recovery,
            readiness=self.readiness,
            armings=self.armings,
            gate_setup=self.gate_setup,
            automatic=self.automatic,
            recorder=self.recorder,
            link=self.link,
            pose=self.pose,
            trouble=self.sensor_watch.worst,
            implausible=self.sensor_watch.implausible,
            alignment=self.alignment,
        )
        self.answers.carry(self.attitude)
        self.answers.setup = self.setup.answer
        self.answers.profiles = models.profiles(config)
        self.answers.unusable = lambda: (*self.ledger.unusable, *self.setup.ledger.unusable)
        self.answers.watch_access(self.signing, self.component.permission)
        self.mqtt = self._mqtt_face(offload)
        self.page = self._page(offload)

    def _attitude_service(self, offload: Offload) -> AttitudeService | None:
        if self.config.push.attitude == "off":
            return None
        from companion.daemon.heading.attitude_service import AttitudeService

        attitude = AttitudeService(
            self.config,
            self.link,
            self.vehicle,
            self.collector,
            self.in_force,
            self.imus,
            self.sensors,
            self._say,
            offload,
        )
        attitude.carrier.gradienter = self.alignment.model
        self.pose.carried = attitude.pose
        return attitude

    def _mqtt_face(self, offload: Offload) -> MqttFace | None:
        if self.config.mqtt is None:
            return None
        # What nobody asked for costs the start nothing.
        from companion.daemon.faces.mqtt.face import MqttFace

        wanted = self.config.vehicle.system_id
        face = MqttFace(
            self.config.mqtt, self.answers, self.conductor, self.vehicle, self.pose.look, offload, system_id=wanted
        )
        self.answers.mqtt = face.status
        return face

    def _page(self, offload: Offload) -> Page | None:
        if self.config.web is None:
            return None
        from companion.web.server import Page

        page = Page(self.config.web.bind, self.config.storage.path, self.answers.answer, self.answers.look, offload)
        self.answers.page = page.status
        return page

    def _on_ended(self, job: Job, result: JobResult) -> None:
        self.in_force.on_ended(job, result)
        if job.kind != ALIGNMENT:
            self.automatic.on_ended(job, result)
        if job.record is not None and job.record.is_worth_keeping:
            self.recorder.on_record(job.record)

    def _message_of(self, name: str) -> str | None:
        imu = self.imus.get(name)
        return imu.stream.kind.message if imu is not None and imu.stream.kind is not None else None

    def _is_carried(self) -> bool:
        if self.vehicle.arm_state is ArmState.ARMED:
            return True
        return self.collector.glance(asyncio.get_running_loop().time()).moving

    def _corrected(self, name: str) -> Corrected | None:
        imu = self.imus.get(name)
        if imu is None:
            return UNTOUCHED
        known = imu.calibration
        return None if known is None else Corrected(known.orientation.T, accel_taken_off(known))

    def _say(self, *what: Any) -> object:
        return self.component.say(*what)

    @contextlib.contextmanager
    def _changing(self) -> Iterator[None]:
        with contextlib.ExitStack() as stack:
            for imu in self.imus.values():
                stack.enter_context(imu.changing())
            yield

    def _autopilot_imu(self, imu: Imu) -> AutopilotImu:
        def kind_changed(kind: StreamKind | None, grid: tuple[float, float]) -> None:
            self.collector.set_imu(models.imu_input(imu, kind, grid))

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
            memory=self.slots,
        )

    def _take(self, role: Role, part: Part) -> None:
        reading = collect(self.collector, role, part)
        if reading is not None:
            self.pose.take(reading)

    async def run(self) -> None:
        """Run until cancelled, reachable on the control socket.

        Raises:
            CompanionError: it cannot start (another daemon runs, or works with the same storage).
        """
        for words in (*models.cannot_work(self.config), *models.doubtful(self.config)):
            logger.warning("%s", words)
        control = self.config.control
        async with ControlServer(control.path, self.answers.answer, group=control.group_name):
            with only_daemon(self.config.storage.path):
                logger.info("ready: %s", control.path)
                self.on_ready()
                await self.serve()

    async def serve(self, *, mavlink: bool = True, ports: bool = True) -> None:
        """Do the work until cancelled, then leave the autopilot in order.

        Args:
            mavlink: open the configured MAVLink connection (else the link has been put on a wire already).
            ports: open the serial ports (else somebody hands their bytes to `sensors`).
        """
        self.ledger.load()
        self.alignment.load()
        self.memory.load()
        self.signing.load()
        if self.ledger.fault is not None:
            # Stay and say so: a daemon that is gone is harder to understand from the field.
            logger.error("%s", self.ledger.fault)
        self.results.load()
        try:
            async with asyncio.TaskGroup() as group:
                try:
                    group.create_task(self.component.run(), name="component")
                    group.create_task(self.signing.run(), name="signing")
                    if mavlink:
                        group.create_task(run_transport(self.link, self.config.mavlink.url), name="mavlink")
                    group.create_task(keep_ticking(self.collector), name="collector")
                    group.create_task(self.recovery.run(), name="recovery")
                    group.create_task(self.setup.run(), name="setup")
                    group.create_task(self.reach.run(), name="reach")
                    group.create_task(self.readiness.run(), name="readiness")
                    group.create_task(self.armings.run(), name="armings")
                    group.create_task(self.automatic.run(), name="automatic")
                    group.create_task(self.gate_setup.run(), name="gate setup")
                    group.create_task(self.recorder.run(), name="recorder")
                    if self.attitude is not None:
                        group.create_task(self.attitude.run(), name="attitude")
                    if self.page is not None:
                        group.create_task(self.page.run(), name="page")
                    if self.mqtt is not None:
                        group.create_task(self.mqtt.run(), name="mqtt")
                    for imu in self.imus.values():
                        group.create_task(imu.run(), name=imu.name)
                    for sensor in self.sensors if ports else ():
                        group.create_task(sensor.run(), name=sensor.name)
                    if ports:
                        group.create_task(self.sensor_watch.run(), name="sensor watch")
                    await asyncio.get_running_loop().create_future()
                finally:
                    # Before the links go: a write under way needs them to come to its end.
                    await self.conductor.close()
        finally:
            self.rivalry.close()
            self.vehicle.close()

    async def listen(self, seconds: float) -> Object:
        """Open everything, listen, and tell what `status` would; for `companion check`, writes nothing."""
        self.conductor.only_listening = "only a check is running: start companion run"
        self.signing.load()
        running = [self.component.run(), run_transport(self.link, self.config.mavlink.url)]
        running += [
            self.signing.run(),
            keep_ticking(self.collector),
            self.reach.run(),
            self.gate_setup.run(),
            *(imu.run() for imu in self.imus.values()),
        ]
        running += [*(sensor.run() for sensor in self.sensors), self.sensor_watch.run()]
        if self.mqtt is not None:
            self.mqtt.only_listening = True
            running.append(self.mqtt.run())
        tasks = [asyncio.get_running_loop().create_task(one) for one in running]
        try:
            await asyncio.sleep(seconds)
            return self.status()
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

    def status(self) -> Object:
        """What the daemon is doing, as JSON can hold it."""
        return self.answers.status()

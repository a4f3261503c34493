"""Devices: the autopilot's IMUs, the companion's sensors, and the check whether ground stations reach the companion.

Both firmwares forward a command for component 191 (the companion) only to a link on which they receive heartbeats of
component 191. PX4 forwards only between links with MAV_n_FORWARD = 1 at its start; no message shows which MAV_n the
companion's link is (docs/reference/autopilots.md section 5.4).
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Sequence
from typing import Final

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.autopilot.firmware.base import SlotMemory
from companion.autopilot.firmware.firmwares import port_needs
from companion.autopilot.telemetry.imu_stream import ask_script
from companion.autopilot.telemetry.px4_console import EkfBias, ImuStatus, Px4Console
from companion.autopilot.vehicle.parameter_client import ParameterClient
from companion.autopilot.vehicle.vehicle import Vehicle
from companion.configured import models
from companion.configured.models import Role, baud_of, collect, serial_devices
from companion.daemon.core import Core, RepeatedRead, Subsystem, Task
from companion.daemon.devices.autopilot_imu import AutopilotImu
from companion.daemon.devices.sensor_watch import NO_OFFSETS, SensorWatch
from companion.daemon.devices.sensors import SensorRole, SerialSensor
from companion.daemon.devices.signing import LinkSigning
from companion.estimation.means.pose import up_in_vehicle
from companion.estimation.solution.site import IN_CONFIGURATION
from companion.estimation.stillness.plausible import misplaced
from companion.formats import Object
from companion.links.mavlink.link import MavlinkLink
from companion.links.system.events import Listeners
from companion.messages import message
from companion.physics.units import G
from companion.samples import ImuSample, Sample

SILENT_S: Final = 5.0
RETRY_S: Final = 10.0


class Reach:
    """Checks whether a ground station reaches the companion: by received heartbeats, and by forwarding parameters."""

    def __init__(self, link: MavlinkLink, vehicle: Vehicle, parameters: ParameterClient, url: str) -> None:
        self._vehicle, self._parameters, self._url = vehicle, parameters, url
        self._heard_s = -math.inf
        self._closed: list[str] = []
        self.reading = RepeatedRead(vehicle, self._read, RETRY_S)
        link.subscribe(mavlink.MAVLink_heartbeat_message, self._on_heartbeat)

    def text(self) -> tuple[bool, str]:
        if not self._vehicle.alive:
            return True, message("autopilot_not_heard", url=self._url)
        answers = (word for word, count in self._vehicle.commands.results.items() if count)
        if not self._parameters.answering and set(answers) <= {"no answer", "dropped"}:
            baud = baud_of(self._url)
            needs = "" if baud is None else f"; {port_needs(self._vehicle.firmware, baud)}"
            return False, message("autopilot_does_not_answer", needs=f"{needs}{self._vehicle.why_silent}")
        if asyncio.get_running_loop().time() - self._heard_s < SILENT_S:
            return True, message("ground_station_heard")
        return self._vehicle.kind.forwarding_words(self._closed)

    async def _read(self) -> None:
        self._closed = await self._vehicle.kind.read_closed_links(self._parameters)

    def _on_heartbeat(self, message: mavlink.MAVLink_heartbeat_message, t_s: float) -> None:
        if message.type == mavlink.MAV_TYPE_GCS:
            self._heard_s = t_s


class Devices(Subsystem):
    """Sources of samples; without `imu_rate_hz` each autopilot IMU sends at the rate that the link can carry."""

    def __init__(self, core: Core, imu_rate_hz: float | None) -> None:
        self._core = core
        self.slots = SlotMemory()
        rate_hz = models.imu_rate_hz(core.config) if imu_rate_hz is None else imu_rate_hz
        imus = [imu for imu in core.config.imu if imu.source == "autopilot"]
        console = Px4Console(core.link, core.vehicle)
        self.ekf_bias = EkfBias(console, core.vehicle)
        # Not on a deck with a slow line: motion dithers the integers there, and console answers would delay readings.
        self._asks = bool(imus) and (rate_hz >= models.IMU_RATE_HZ or core.config.vehicle.platform == "ground")
        if not self._asks:
            self.ekf_bias.settled.set()
        self.imus = {imu.name: AutopilotImu(core, imu, self.slots, self.ekf_bias, rate_hz) for imu in imus}
        self._status = ImuStatus(
            console, self.ekf_bias, self._wants_raw, self._take_raw, slow=rate_hz < models.IMU_RATE_HZ
        )
        self.sensors = [SerialSensor(device, self._take, core.offload) for device in serial_devices(core.config)]
        self.watch = SensorWatch(self.sensors, core.collector, self._offsets_of, core.say)
        self.signing = LinkSigning(core.config, core.link, core.vehicle, core.say, core.offload)
        self.reach = Reach(core.link, core.vehicle, core.parameters, core.config.mavlink.url)
        self.on_pose: Listeners[Sample] = Listeners()

    @property
    def not_heard(self) -> str:
        words = self._core.link.fault or message("autopilot_not_heard", url=self._core.config.mavlink.url)
        return ": ".join(filter(None, (words, self.signing.rejecting)))

    def load(self) -> None:
        self.signing.load()

    def status(self) -> Object:
        sources = self._core.collector.status(asyncio.get_running_loop().time()).sources
        counts = {source.name: {"lost": source.lost, "dropped": source.dropped} for source in sources}
        roles = [role for sensor in self.sensors for role in sensor.roles]
        found: list[AutopilotImu | SensorRole] = [*self.imus.values(), *roles]
        devices, thermometers = [], self._core.collector.thermometers
        for device in found:
            said = device.status() | counts.get(device.name, {})
            if (words := self._misplaced(device.name)) is not None:
                said |= {"good": False, "summary": f"{said['summary']}; {words}"}
            elif thermometers[device.name].none:
                said |= {"summary": f"{said['summary']}, without a temperature"}
            devices.append(said)
        return {
            "devices": devices,
            "warnings": [
                f"imu {imu.name}: {wrong}" for imu in self._core.config.imu if (wrong := thermometers[imu.name].wrong)
            ],
            "profiles": self._core.profiles.status(),
            "ground_stations": dict(zip(("good", "summary"), self.reach.text(), strict=True)),
        }

    def _misplaced(self, name: str) -> str | None:
        """Return a warning if an IMU and the gradienter measured "down" along different axes in the last second."""
        config, collector = self._core.config, self._core.collector
        tilt, model = collector.tilt_second(), models.gradienter_model(config.gradienter)
        imu, batch = next((imu for imu in config.imu if imu.name == name), None), collector.imu_seconds().get(name)
        if tilt is None or model is None or imu is None or batch is None or config.calibration.any_bias:
            return None
        try:
            up = up_in_vehicle(model, *tilt.mean.tolist())
        except ValueError:
            return None
        rotation = models.imu_input(imu, None).rotation
        return misplaced(name, rotation @ batch.mean[3:], G * up, rotation, IN_CONFIGURATION.mounting)

    def tasks(self, *, ports: bool = True) -> Sequence[Task]:
        return [
            ("collector", self._core.keep_ticking),
            ("signing", self.signing.run),
            ("reach", self.reach.reading.run),
            *([("ekf-bias", self.ekf_bias.run), ("imu-status", self._status.run)] if self._asks else []),
            ("script-floats", lambda: ask_script(self._core.link, [imu.stream for imu in self.imus.values()])),
            *((f"{imu.name} telemetry", imu.stream.run) for imu in self.imus.values()),
            *((f"{imu.name} offsets", imu.reading.run) for imu in self.imus.values()),
            *(((sensor.name, sensor.run) for sensor in self.sensors) if ports else ()),
            *([("sensor-watch", self.watch.run)] if ports else []),
        ]

    def _wants_raw(self) -> list[int]:
        return [imu.instance for imu in self.imus.values() if imu.wants_raw]

    def _take_raw(self, instance: int, gyro_id: int, accel_id: int, raw: ImuSample) -> None:
        for imu in self.imus.values():
            if imu.instance == instance:
                imu.take_raw(gyro_id, accel_id, raw)

    def _take(self, role: Role, part: Sample) -> None:
        reading = collect(self._core.collector, role, part)
        if reading is not None:
            self.on_pose.tell(reading)

    def _offsets_of(self, name: str) -> object:
        imu = self.imus.get(name)
        return NO_OFFSETS if imu is None else imu.calibration

"""The whole daemon on a virtual aircraft, on virtual time: minutes of flight line in a fraction of a second.

Real are the daemon's parts from decoder to record and the MAVLink bytes; in memory are only wires and ports.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any, Literal

from companion.config import parse
from companion.daemon.core import Offload
from companion.daemon.interfaces.child import StartChild
from companion.daemon.process.service import Service
from companion.links.mavlink.link import MavlinkLink
from sim.aircraft import Pose, Site, VirtualAircraft
from sim.ardupilot.double import ArduPilotDouble
from sim.devices import HMR3300, Gradienter, Law, SerialDevice, VectorNavBinary
from sim.firmware.double import AutopilotDouble
from sim.flight import MovingAircraft, Route
from sim.imu_model import DEG_H, MG, ImuModel
from sim.px4.double import PX4Double
from sim.scenario import site_at
from sim.thermal import Curve
from tests.support.children import in_process
from tests.support.component import Ground
from tests.support.wire import Wire

POSE = Pose(pitch_deg=5.0, roll_deg=-3.0, heading_deg=40.0)
GYRO_BIAS_DEG_H = (162.234, 169.563, -98.289)
THERMOMETER_OFF_K = 0.13
"""Makes its last digits show: a thermometer in whole kelvins tells little of how steady they are."""
ACCEL_BIAS_MG = (2.4125, -2.1596, 0.89809)

CONFIG = """
[mavlink]
url = "udpout:127.0.0.1:9"
[[imu]]
name = "fc"
source = "autopilot"
profile = "{part}"
{own}
[gradienter]
port = "/nowhere/gradienter"
protocol = "inclinometer_xy"
law = "{law}"
sigma_deg = 0.005
[compass]
port = "/nowhere/compass"
protocol = "hmr3300"
sigma_deg = 1.0
[calibration]
min_still_s = {min_still_s}
max_s = {max_s}
at_arm = "{at_arm}"
[storage]
directory = "{folder}"
recordings_mb = {recordings_mb}
{more}
"""
OWN = """
[[imu]]
name = "own"
source = "serial"
port = "/nowhere/imu"
protocol = "vectornav"
profile = "adis16470"
"""


# What every rig sets: no gyro calibration at boot; a companion that the ground station can reach.
_FIRMWARES: dict[str, tuple[Callable[..., AutopilotDouble], dict[str, float]]] = {
    "ardupilot": (ArduPilotDouble, {"INS_GYR_CAL": 0.0}),
    "px4": (PX4Double, {"MAV_1_FORWARD": 1.0}),
}


async def inline(function: Callable[..., Any], *arguments: Any) -> Any:
    """Runs a blocking call on the spot: there are no threads on virtual time."""
    return function(*arguments)


class Rig:
    """One aircraft, its autopilot, its devices, the daemon, and a ground station behind the autopilot.

    Nothing calibrates by itself unless `at_arm` says so: most tests ask for what they look at. Its IMUs are slower than
    most: what hangs on a rate says so itself, and every other test is as good at a quarter of the work. `curve` is of
    the autopilot's first IMU.
    """

    def __init__(
        self,
        folder: Path,
        *,
        seed: int = 0,
        pose: Pose = POSE,
        law: Law = "slope",
        part: str = "icm42688p",
        own_imu: bool = False,
        vehicle: str = "copter",
        firmware: Literal["ardupilot", "px4"] = "ardupilot",
        min_still_s: float = 10.0,
        max_s: float = 30.0,
        parameters: dict[str, float] | None = None,
        imus: int = 2,
        mounting_deg: tuple[float, float, float] = (0.0, 0.0, 0.0),
        accel_scale: tuple[float, float, float] = (0.0, 0.0, 0.0),
        at_arm: str = "off",
        more: str = "",
        mavlink: str = "",
        loss: float = 0.0,
        duplicate: float = 0.0,
        baud: int | None = None,
        imu_rate_hz: float = 25.0,
        device_rate_hz: float | None = None,
        feed_s: float = 0.1,
        recordings_mb: int = 0,
        route: Route | None = None,
        site: Site | None = None,
        temperature_degc: float | Callable[[float], float] = 25.0,
        curve: Curve | None = None,
        **autopilot: Any,
    ) -> None:
        self.imu_rate_hz, self.feed_s = imu_rate_hz if baud is None else None, feed_s
        self.site: Site = site or site_at(40.0, 116.0, 50.0)
        self.aircraft = (
            VirtualAircraft(pose, self.site, temperature_degc=temperature_degc)
            if route is None
            else MovingAircraft(route, pose, self.site)
        )
        self.model = ImuModel(
            self.aircraft,
            part,
            seed=seed,
            gyro_bias_rad_s=[value * DEG_H for value in GYRO_BIAS_DEG_H],
            accel_bias_m_s2=[value * MG for value in ACCEL_BIAS_MG],
            mounting_deg=mounting_deg,
            thermometer_off_k=THERMOMETER_OFF_K,
            accel_scale=accel_scale,
            curve=curve,
        )
        if firmware == "px4":
            # Nobody looks at them, and half of the time goes there; but they are what a serial line has to carry.
            autopilot.setdefault("default_streams", baud is not None)
        others = [
            ImuModel(
                self.aircraft,
                part,
                seed=seed + 10 + k,
                mounting_deg=mounting_deg,
                thermometer_off_k=THERMOMETER_OFF_K,
            )
            for k in range(imus - 1)
        ]
        self.models = models = [self.model, *others]
        """The autopilot's IMUs."""
        kind, usual = _FIRMWARES[firmware]
        self.autopilot = kind(
            self.aircraft, models, vehicle=vehicle, parameters={**usual, **(parameters or {})}, seed=seed, **autopilot
        )
        """The double, whichever it is; `double` and `px4` are the same by its own type."""
        text = CONFIG.format(
            part=part,
            own=OWN if own_imu else "",
            law=law,
            min_still_s=min_still_s,
            max_s=max_s,
            at_arm=at_arm,
            folder=folder,
            recordings_mb=recordings_mb,
            more=more,
        )
        text = text.replace("[[imu]]", f"{mavlink}\n[[imu]]", 1)
        if baud is not None:
            text = text.replace("udpout:127.0.0.1:9", f"serial:/nowhere/autopilot:{baud}")
        self.text = text
        self.config = parse(text, "rig.toml")
        self.link = MavlinkLink()
        self.devices: dict[str, SerialDevice] = {
            "gradienter": Gradienter(self.aircraft, seed=seed, law=law, rate_hz=device_rate_hz),
            "compass": HMR3300(self.aircraft, seed=seed, rate_hz=device_rate_hz),
        }
        if own_imu:
            self.own_model = ImuModel(
                self.aircraft,
                "adis16470",
                seed=seed + 5,
                gyro_bias_rad_s=[60.294 * DEG_H, -124.657 * DEG_H, 108.289 * DEG_H],
                accel_bias_m_s2=[0.21593 * MG, -2.2118 * MG, 1.2953 * MG],
                thermometer_off_k=THERMOMETER_OFF_K,
            )
            self.devices["own"] = VectorNavBinary(self.own_model)
        self.ground = Ground()
        self.wire = Wire(self.link, self.autopilot, seed=seed, loss=loss, duplicate=duplicate)
        if baud is not None:
            self.wire.bytes_per_s = baud / 10.0
        self.radio = Wire(self.ground, self.autopilot.ground, seed=seed + 1)
        self.offload: Offload = inline
        self.unplugged: set[str] = set()
        """Devices that say nothing."""
        self.service: Service
        self.start_child: StartChild = in_process(lambda: self.service)

    @property
    def double(self) -> ArduPilotDouble:
        assert isinstance(self.autopilot, ArduPilotDouble)
        return self.autopilot

    @property
    def px4(self) -> PX4Double:
        assert isinstance(self.autopilot, PX4Double)
        return self.autopilot

    @property
    def now_s(self) -> float:
        return asyncio.get_running_loop().time()

    @contextlib.asynccontextmanager
    async def running(self) -> AsyncIterator[Rig]:
        """Run everything; the daemon is stopped in order at the end."""
        self._start()
        tasks = [
            asyncio.create_task(coroutine)
            for coroutine in (self.autopilot.run(), self._feed(), self._ground_heartbeat())
        ]
        await asyncio.sleep(0.01)
        try:
            yield self
        finally:
            await self._stop(self._serving)
            for task in tasks:
                await self._stop(task)
            self.wire.unplug()
            self.radio.unplug()

    def _start(self) -> None:
        self.service = Service(
            self.config,
            link=self.link,
            offload=self.offload,
            imu_rate_hz=self.imu_rate_hz,
            child=self.start_child,
        )
        self._serving = asyncio.create_task(self.service.serve(mavlink=False, ports=False))

    async def restart(self) -> None:
        """Kill the daemon and start it anew, from what is on disk, with `config`: what it would do at an orderly end
        reaches nobody."""
        self.wire.unplug()
        await self._stop(self._serving)
        self.link = MavlinkLink()
        self.wire = Wire(self.link, self.autopilot, seed=1)
        self._start()

    @staticmethod
    async def _stop(task: asyncio.Task[None]) -> None:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task

    async def until(self, condition: Callable[[], bool], within_s: float) -> None:
        """Wait for something to become true; fails when it does not."""
        deadline_s = self.now_s + within_s
        while not condition():
            assert self.now_s < deadline_s, f"not within {within_s} s; status: {self.service.status()}"
            await asyncio.sleep(0.05)

    async def ready(self) -> Rig:
        """Wait until the daemon knows the autopilot and its offsets."""
        imu = self.service.devices.imus["fc"]
        await self.until(lambda: imu.calibration is not None and imu.stream.samples > 0, 15.0)
        return self

    async def _feed(self) -> None:
        for device in self.devices.values():
            device.power_on(self.aircraft.time_at(self.now_s))
        while True:
            await asyncio.sleep(self.feed_s)
            t_s = self.aircraft.time_at(self.now_s)
            sensors = {sensor.name: sensor for sensor in self.service.devices.sensors}
            for name, device in self.devices.items():
                data = b"".join(frame.data for frame in device.frames_until(t_s))
                if data and name not in self.unplugged:
                    sensors[name].receive(data, self.now_s)

    async def _ground_heartbeat(self) -> None:
        from pymavlink.dialects.v20 import ardupilotmega as mavlink

        while True:
            self.ground.send(
                mavlink.MAVLink_heartbeat_message(
                    mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, mavlink.MAV_STATE_ACTIVE, 3
                )
            )
            await asyncio.sleep(1.0)

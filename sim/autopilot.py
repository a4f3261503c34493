"""An ArduPilot that fits in a test: parameters, telemetry and manners of the real one, on any event loop.

What is modelled follows what was read in ArduPilot's sources and seen in runs of the real firmware (the "autopilots"
reference of this project, sections 1, 2, 3, 5.4, 7.5, 9.1 and 9.3.1); the class says what is not.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Literal

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.aircraft import VirtualAircraft
from sim.ardupilot.calibrations import Calibrations
from sim.ardupilot.channel import Channel, Message
from sim.ardupilot.commands import CommandServer, command_of
from sim.ardupilot.estimator import CoarseEstimator
from sim.ardupilot.faults import Faults
from sim.ardupilot.inertial import InertialPath
from sim.ardupilot.messages import BUILDERS
from sim.ardupilot.parameter_server import ParameterServer, Write
from sim.ardupilot.parameters import ParameterStore, Version, default_parameters, device_id, float32, offset_names
from sim.ardupilot.routing import Router
from sim.earth import Array
from sim.imu_model import Bias, ImuModel

__all__ = ["ArduPilotDouble", "Faults", "Write", "float32", "offset_names"]

HEARTBEAT = mavlink.MAVLINK_MSG_ID_HEARTBEAT
FIELD_MILLIGAUSS = (280.0, 450.0)
"""Horizontal and vertical part of the magnetic field."""
LOOP_RATE_HZ = {"copter": 400.0, "plane": 50.0}


class ArduPilotDouble:
    """An autopilot with up to three IMUs on a virtual aircraft.

    It is an `End` (attach, receive) on which the companion is plugged in; `ground` is a second one for a ground
    station. `run` sends what is due; answers need only the running loop. Time is the loop's clock.

    Not modelled: flight, notches, temperature calibration (INS_TCALn_* can be read and written, nothing more), MAVFTP,
    missions, logs, signing, 6-position calibration, the 10 s that consistency checks must pass before arming.

    Args:
        aircraft: the truth.
        imus: one to three models; the first is IMU 1. Their `mounting_deg` is how the board is really turned, which
            AHRS_ORIENTATION (default none) is meant to undo.
        version: "4.8": PARAM_ERROR, too fast rates DENIED, HIGHRES_IMU. "4.5": silence for unknown parameters, too fast
            rates silently capped, no HIGHRES_IMU, SYSID_THISMAV instead of MAV_SYSID.
        vehicle: "copter" (loop 400 Hz) or "plane" (50 Hz: nothing above 40 Hz).
        parameters: values that differ from the defaults, such as {"INS_GYR_CAL": 0}; set before the first boot.
        up_s: how long it has been running when the simulation begins.
        has_position: whether it has a GNSS fix, and so a position and a date.
        clock_ppm: how much faster its clock runs.
    """

    def __init__(
        self,
        aircraft: VirtualAircraft,
        imus: Sequence[ImuModel],
        *,
        system_id: int = 1,
        version: Version = "4.8",
        vehicle: Literal["copter", "plane"] = "copter",
        parameters: Mapping[str, float] | None = None,
        up_s: float = 30.0,
        has_position: bool = True,
        clock_ppm: float = 0.0,
        seed: int = 0,
    ) -> None:
        if not 1 <= len(imus) <= 3:
            raise ValueError(f"imus: found {len(imus)}; allowed: 1 to 3")
        self.aircraft, self.imus = aircraft, tuple(imus)
        self.system_id, self.version, self.vehicle = system_id, version, vehicle
        self.has_position, self.clock_ppm = has_position, clock_ppm
        self.faults = Faults()
        self.armed = False
        self.calibrating = False
        self.boots = 0
        declination = math.radians(aircraft.site.declination_deg)
        north, down = FIELD_MILLIGAUSS
        self.field_ned = np.array([north * math.cos(declination), north * math.sin(declination), down])
        """Magnetic field at the site in milligauss."""
        self.parameters = self._new_store(parameters or {})
        self.estimator = CoarseEstimator()
        self.ground = Channel(system_id, self._handle)
        """The second port."""
        self._port = Channel(system_id, self._handle)
        self.channels = (self._port, self.ground)
        self._router = Router(system_id, self.channels)
        self._random = np.random.default_rng([seed, 4])
        self._paths = [InertialPath(model, number + 1, self.parameters, seed=seed) for number, model in enumerate(imus)]
        self.calibrations = Calibrations(self._paths, self.parameters, self._random)
        self._parameter_server = ParameterServer(self)
        self._commands = CommandServer(self)
        self._frozen: dict[int, Array] = {}
        self._up_s = up_s
        self._booted_s: float | None = None
        self._down = False
        self._generation = 0
        self._last_later_s = 0.0
        self._failed: asyncio.Future[None] | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._boot_gyros(0.0)

    # The outside: two ends, and the loop.

    def attach(self, transmit: Callable[[bytes], None] | None) -> None:
        """Plug the companion's wire in (None: out)."""
        self._port.attach(transmit)

    def receive(self, data: bytes, t_s: float) -> None:
        """Bytes from the companion's wire; never raises."""
        self._port.receive(data, t_s)

    async def run(self) -> None:
        """Send heartbeats and streams until cancelled."""
        loop = asyncio.get_running_loop()
        self._failed = loop.create_future()
        self._begin(loop.time())
        self._tick()
        try:
            await self._failed
        finally:
            self._failed = None
            if self._timer is not None:
                self._timer.cancel()

    # What tests and people do to it.

    @property
    def writes(self) -> list[Write]:
        """Every PARAM_SET that arrived, obeyed or not, in order."""
        return self._parameter_server.writes

    def parameter(self, name: str) -> float:
        """What is stored; KeyError if there is none of that name."""
        return self.parameters.values[name]

    def set_parameter(self, name: str, value: float) -> None:
        """Set without telling anyone, as if it had always been so."""
        self.parameters.set(name, value)

    def write_as_another_station(self, name: str, value: float) -> None:
        """Another ground station sets a parameter: stored, and announced on every port."""
        self.update_estimator(self.now_s())
        self.parameters.set(name, value)
        for member in self.parameters.family(name):
            self._parameter_server.announce(member)

    def arm(self) -> None:
        """The pilot arms."""
        if not self.armed:
            self.armed = True
            self.say(mavlink.MAV_SEVERITY_INFO, "Arming motors")

    def disarm(self) -> None:
        """The pilot disarms."""
        if self.armed:
            self.armed = False
            self.say(mavlink.MAV_SEVERITY_INFO, "Disarming motors")

    def reboot(self, down_s: float = 1.5) -> None:
        """Restart: silence for `down_s`, then time from zero, streams and routes forgotten, parameters kept."""
        self._down = True
        self._generation += 1
        generation = self._generation
        self.armed = self.calibrating = False
        loop = asyncio.get_running_loop()
        loop.call_later(down_s, lambda: self._boot(loop.time()) if generation == self._generation else None)

    def residual(self, instance: int, loop_s: float) -> Bias:
        """What is left in the output of IMU `instance` (1..3) after offsets and scales: output minus truth, FRD."""
        t_s = self.aircraft.time_at(loop_s)
        output, truth = self._paths[instance - 1].corrected(t_s, armed=self.armed), self.aircraft.truth_at(t_s)
        return Bias(output[:3] - truth.rate_rad_s, output[3:] - truth.force_m_s2)

    def hears(self, component_id: int) -> bool:
        """Whether that component of our system was heard since the last boot; else its messages end here."""
        return self._router.knows(component_id)

    def prearm_failures(self, loop_s: float) -> list[str]:
        """Why it would not arm, in the firmware's words without the prefix."""
        failures = []
        values = self.parameters.values
        outputs = [path.corrected(self.aircraft.time_at(loop_s)) for path in self._paths]
        for path in self._paths:
            number = "" if path.instance == 1 else str(path.instance)
            if values[f"INS_GYR{number}_ID"] != device_id(path.instance):
                failures.append("Gyros not calibrated")
            offsets = [values[name] for name in offset_names(path.instance, "accel")]
            if values[f"INS_ACC{number}_ID"] != device_id(path.instance) or not any(offsets):
                failures.append("3D Accel calibration needed")
            if values[f"INS_TCAL{path.instance}_ENABLE"] == 2:
                failures.append("temperature cal running")
        for output in outputs[1:]:
            if np.linalg.norm(output[3:] - outputs[0][3:]) > values["ARMING_ACCTHRESH"]:
                failures.append("Accels inconsistent")
            if np.linalg.norm(output[:3] - outputs[0][:3]) > np.radians(5.0):
                failures.append("Gyros inconsistent")
        return failures

    # What its parts use.

    @property
    def has_highres_imu(self) -> bool:
        """4.6 and later, on boards with more than 1 MB of flash."""
        return self.version != "4.5" and not self.faults.int_only

    @property
    def fastest_interval_ms(self) -> int:
        """Whole milliseconds of 1.25 loop periods."""
        return int(1.25 * 1000.0 / LOOP_RATE_HZ[self.vehicle])

    def boot_us(self, loop_s: float) -> int:
        """Microseconds since boot on its own clock."""
        assert self._booted_s is not None
        return int((loop_s - self._booted_s) * (1.0 + self.clock_ppm * 1e-6) * 1e6)

    def boot_ms(self, loop_s: float) -> int:
        """Milliseconds since boot."""
        return self.boot_us(loop_s) // 1000

    def unix_s(self, loop_s: float) -> float:
        """The date it knows."""
        return self.aircraft.unix_s + self.aircraft.time_at(loop_s)

    def imu_output(self, index: int, loop_s: float) -> Array:
        """Filtered rates and specific forces (6) of IMU index 0..2 in vehicle FRD."""
        if self.faults.frozen_imu and index in self._frozen:
            return self._frozen[index]
        output = self._paths[index].output(self.aircraft.time_at(loop_s), armed=self.armed)
        self._frozen[index] = output
        return output

    def update_estimator(self, loop_s: float) -> None:
        """Bring the estimator to this time; to be called before anything changes the output."""
        error = self.residual(1, loop_s)
        self.estimator.update(self.aircraft.time_at(loop_s), error.gyro_rad_s, error.accel_m_s2)

    def estimated_angles_rad(self, loop_s: float) -> tuple[float, float, float]:
        """Roll, pitch, yaw of ATTITUDE: truth, the estimator's tilt error, less AHRS_TRIM; yaw in (-pi, pi]."""
        self.update_estimator(loop_s)
        roll, pitch, yaw = self.aircraft.angles_rad(self.aircraft.time_at(loop_s))
        roll_error, pitch_error = map(float, self.estimator.tilt_error_rad)
        trim = self.parameters.effective
        yaw = (yaw + np.pi) % (2.0 * np.pi) - np.pi
        return roll + roll_error - trim["AHRS_TRIM_X"], pitch + pitch_error - trim["AHRS_TRIM_Y"], float(yaw)

    def now_s(self) -> float:
        """The loop's clock."""
        return asyncio.get_running_loop().time()

    def answer_delay_s(self) -> float:
        """Time to a PARAM_VALUE: 2 to 6 ms, on Plane 17 to 23 ms."""
        low, high = (0.002, 0.006) if self.vehicle == "copter" else (0.017, 0.023)
        return float(self._random.uniform(low, high))

    def later(self, delay_s: float, action: Callable[[], None]) -> None:
        """Do something after a delay, unless a reboot comes first; short delays keep their order."""
        loop = asyncio.get_running_loop()
        at_s = loop.time() + delay_s
        if delay_s < 0.1:
            at_s = max(at_s, self._last_later_s + 1e-6)
            self._last_later_s = at_s
        generation = self._generation
        loop.call_at(at_s, lambda: action() if generation == self._generation else None)

    def answer(self, channel: Channel, message: Message) -> None:
        """Send an answer, unless it answers nothing."""
        if not self._down and not self.faults.silent:
            channel.send(message)

    def say(self, severity: int, text: str) -> None:
        """STATUSTEXT on every port, cut at 50 characters a chunk."""
        data = text.encode()
        chunks = [data[start : start + 50] for start in range(0, len(data), 50)]
        text_id = int(self._random.integers(1, 65536)) if len(chunks) > 1 else 0
        for channel in self.channels:
            for number, chunk in enumerate(chunks):
                self.answer(channel, mavlink.MAVLink_statustext_message(severity, chunk, text_id, number))

    def wake(self) -> None:
        """Tell `run` that something is due earlier than it thought."""
        if self._failed is not None:
            asyncio.get_running_loop().call_soon(self._tick)

    def erase_parameters(self) -> None:
        """PREFLIGHT_STORAGE 2 or 4: everything is gone, at the next boot the defaults are there."""
        for name, (value, _) in default_parameters(self.version, len(self.imus)).items():
            self.parameters.set(name, value, takes_effect=False)

    # The inside.

    def _new_store(self, overrides: Mapping[str, float]) -> ParameterStore:
        table = default_parameters(self.version, len(self.imus))
        own = "SYSID_THISMAV" if self.version == "4.5" else "MAV_SYSID"
        table[own] = (float(self.system_id), table[own][1])
        table["SCHED_LOOP_RATE"] = (LOOP_RATE_HZ[self.vehicle], table["SCHED_LOOP_RATE"][1])
        store = ParameterStore(table)
        for name, value in overrides.items():
            store.set(name, value)
        return store

    def _begin(self, loop_s: float) -> None:
        """The first instant on a loop: it has been up for a while."""
        if self._booted_s is None:
            self.aircraft.begin(loop_s)
            self._booted_s = loop_s - self._up_s
            self.boots = 1
            self.estimator.reset(self.aircraft.time_at(loop_s) - self._up_s)
            self._start_heartbeats(loop_s)

    def _boot(self, loop_s: float) -> None:
        self._down = False
        self._booted_s = loop_s
        self.boots += 1
        self.parameters.set("STAT_BOOTCNT", self.parameters.values["STAT_BOOTCNT"] + 1)
        self.parameters.reload()
        self._router.forget()
        self._frozen.clear()
        self._boot_gyros(self.aircraft.time_at(loop_s))
        for path in self._paths:
            path.reset()
        self.estimator.reset(self.aircraft.time_at(loop_s))
        for channel in self.channels:
            channel.streams.clear()
            channel.listing = False
        self._start_heartbeats(loop_s)
        self.wake()

    def _boot_gyros(self, t_s: float) -> None:
        """INS_GYR_CAL = 1: every boot measures the gyro offsets anew and throws the stored ones away."""
        if self.parameters.values["INS_GYR_CAL"] == 1:
            self.calibrations.gyros(t_s)

    def _start_heartbeats(self, loop_s: float) -> None:
        for channel in self.channels:
            channel.set_stream(HEARTBEAT, 1.0, loop_s)
            channel.streams[HEARTBEAT].next_s = loop_s

    def _tick(self) -> None:
        """Send what is due and come back for what is next: plain callbacks, cheaper than a task."""
        if self._failed is None or self._failed.done():
            return
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        loop = asyncio.get_running_loop()
        try:
            self._send_due(loop.time())
        except Exception as error:  # noqa: BLE001 - handed to whoever awaits run()
            self._failed.set_exception(error)
            return
        due = [at for channel in self.channels if (at := channel.next_due_s()) is not None]
        if due and not self._down:
            self._timer = loop.call_at(min(due), self._tick)

    def _send_due(self, loop_s: float) -> None:
        if self._down:
            return
        for channel in self.channels:
            for message_id in channel.due(loop_s):
                if message_id == HEARTBEAT:
                    if self.faults.heartbeat_off:
                        continue
                elif self.faults.telemetry_off or self.calibrating:
                    continue  # while it calibrates, the real one's delay loop sends heartbeats and parameters only
                if channel.attached:
                    channel.send(BUILDERS[message_id](self, loop_s))

    def _handle(self, channel: Channel, message: Message, loop_s: float) -> None:
        if self._down:
            return
        self._begin(loop_s)
        if not self._router.route(channel, message):
            return
        if isinstance(message, mavlink.MAVLink_param_set_message):
            self._parameter_server.set(channel, message, loop_s)
        elif isinstance(message, mavlink.MAVLink_param_request_read_message):
            self._parameter_server.read(channel, message)
        elif isinstance(message, mavlink.MAVLink_param_request_list_message):
            self._parameter_server.list_all(channel)
        elif isinstance(message, mavlink.MAVLink_command_long_message | mavlink.MAVLink_command_int_message):
            self._commands.handle(command_of(channel, message, loop_s))
        elif isinstance(message, mavlink.MAVLink_request_data_stream_message):
            self._commands.data_stream(channel, message, loop_s)
        elif isinstance(message, mavlink.MAVLink_timesync_message) and message.tc1 == 0:
            self.answer(channel, mavlink.MAVLink_timesync_message(self.boot_us(loop_s) * 1000, message.ts1))

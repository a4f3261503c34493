"""An ArduPilot that fits in a test: parameters, telemetry and manners of the real one, on any event loop.

What is modelled follows what was read in ArduPilot's sources and seen in runs of the real firmware (the "autopilots"
reference of this project, sections 1, 2, 3, 5.4, 7.5, 9.1 and 9.3.1); the class says what is not.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Literal

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.aircraft import VirtualAircraft
from sim.ardupilot.calibrations import Calibrations
from sim.ardupilot.channel import ArduPilotChannel
from sim.ardupilot.commands import CommandServer
from sim.ardupilot.estimator import CoarseEstimator
from sim.ardupilot.external_nav import ExternalNav
from sim.ardupilot.inertial import InertialPath
from sim.ardupilot.messages import BUILDERS
from sim.ardupilot.parameter_server import ParameterServer
from sim.ardupilot.parameters import ParameterStore, default_parameters, device_id, offset_names
from sim.ardupilot.routing import Router
from sim.ardupilot.versions import NEWEST, Version, since
from sim.earth import Array
from sim.firmware.channel import Channel, Message
from sim.firmware.command import command_of
from sim.firmware.double import HEARTBEAT, AutopilotDouble
from sim.firmware.faults import Faults
from sim.firmware.numbers import float32
from sim.firmware.writes import Write
from sim.imu_model import Bias, ImuModel

__all__ = ["ArduPilotDouble", "Faults", "Write", "float32", "offset_names"]

LOOP_RATE_HZ = {"copter": 400.0, "plane": 50.0}


class ArduPilotDouble(AutopilotDouble):
    """An autopilot with up to three IMUs on a virtual aircraft.

    It is an `End` (attach, receive) on which the companion is plugged in; `ground` is a second one for a ground
    station. `run` sends what is due; answers need only the running loop. Time is the loop's clock.

    Not modelled: flight, notches, temperature calibration (INS_TCALn_* can be read and written, nothing more), MAVFTP,
    missions, logs, SETUP_SIGNING (`require_signatures` stands for it), 6-position calibration, the 10 s that
    consistency checks must pass before arming.

    Args:
        aircraft: the truth.
        imus: one to three models; the first is IMU 1. Their `mounting_deg` is how the board is really turned, which
            AHRS_ORIENTATION (default none) is meant to undo.
        version: "4.3" to "4.8"; `sim.ardupilot.versions` says how they differ.
        vehicle: "copter" (loop 400 Hz) or "plane" (50 Hz: nothing above 40 Hz).
        parameters: values that differ from the defaults, such as {"INS_GYR_CAL": 0}; set before the first boot.
        up_s: how long it has been running when the simulation begins.
        auxiliary: whether the board has parameters of IMU 4 and 5, and a gyro behind 4 that no message shows.
        has_position: whether it has a GNSS fix, and so a position and a date.
        clock_ppm: how much faster its clock runs.
    """

    def __init__(
        self,
        aircraft: VirtualAircraft,
        imus: Sequence[ImuModel],
        *,
        system_id: int = 1,
        version: Version = NEWEST,
        vehicle: Literal["copter", "plane"] = "copter",
        parameters: Mapping[str, float] | None = None,
        up_s: float = 30.0,
        auxiliary: bool = False,
        has_position: bool = True,
        clock_ppm: float = 0.0,
        seed: int = 0,
    ) -> None:
        if not 1 <= len(imus) <= 3:
            raise ValueError(f"imus: found {len(imus)}; allowed: 1 to 3")
        channels = (ArduPilotChannel(system_id, self._handle), ArduPilotChannel(system_id, self._handle))
        super().__init__(aircraft, imus, channels, up_s=up_s, has_position=has_position, clock_ppm=clock_ppm, seed=seed)
        self.system_id, self.version, self.vehicle = system_id, version, vehicle
        self._auxiliary = auxiliary
        self.parameters = self._new_store(parameters or {})
        self.estimator = CoarseEstimator()
        self.external_nav = ExternalNav(self)
        self.airspeed_m_s = 0.0
        """What its VFR_HUD says."""
        self._router = Router(system_id, self.channels)
        self._paths = [InertialPath(model, number + 1, self.parameters, seed=seed) for number, model in enumerate(imus)]
        self.calibrations = Calibrations(self._paths, self.parameters, self.random)
        self._parameter_server = ParameterServer(self)
        self._commands = CommandServer(self)
        self._frozen: dict[int, Array] = {}
        self._boot_gyros(0.0)

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
        failures = [] if self.calibrations.gyros_ok else ["Gyros not calibrated"]
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
        if self.external_nav.enabled and not self.external_nav.healthy(loop_s):
            failures.append("VisOdom: not healthy")
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
        return since(self.version, "4.6") and not self.faults.int_only

    @property
    def fastest_interval_ms(self) -> int:
        """Whole milliseconds of 1.25 loop periods."""
        return int(1.25 * 1000.0 / LOOP_RATE_HZ[self.vehicle])

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
        yaw = (yaw + self.estimator.yaw_error_rad + np.pi) % (2.0 * np.pi) - np.pi
        return roll + roll_error - trim["AHRS_TRIM_X"], pitch + pitch_error - trim["AHRS_TRIM_Y"], float(yaw)

    def answer_delay_s(self) -> float:
        """Time to a PARAM_VALUE: 2 to 6 ms, on Plane 17 to 23 ms."""
        low, high = (0.002, 0.006) if self.vehicle == "copter" else (0.017, 0.023)
        return float(self.random.uniform(low, high))

    def read_delay_s(self) -> float:
        """Time to the answer to a read, which waits for the next turn of a slow thread: 5 to 95 ms."""
        return float(self.random.uniform(0.005, 0.095))

    def coin(self) -> bool:
        """Heads or tails."""
        return bool(self.random.integers(2))

    def announce(self, names: Iterable[str]) -> None:
        """PARAM_VALUE on every port for what the autopilot itself has changed and saved."""
        for name in names:
            self._parameter_server.announce(name)

    def say(self, severity: int, text: str) -> None:
        """STATUSTEXT on every port, cut at 50 characters a chunk."""
        data = text.encode()
        chunks = [data[start : start + 50] for start in range(0, len(data), 50)]
        text_id = int(self.random.integers(1, 65536)) if len(chunks) > 1 else 0
        for channel in self.channels:
            for number, chunk in enumerate(chunks):
                self.answer(channel, mavlink.MAVLink_statustext_message(severity, chunk, text_id, number))

    def erase_parameters(self) -> None:
        """PREFLIGHT_STORAGE 2 or 4: everything is gone, at the next boot the defaults are there."""
        for name, (value, _) in self._table().items():
            self.parameters.set(name, value, takes_effect=False)

    # The inside.

    def _table(self) -> dict[str, tuple[float, int]]:
        return default_parameters(self.version, len(self.imus), auxiliary=self._auxiliary)

    def _new_store(self, overrides: Mapping[str, float]) -> ParameterStore:
        table = self._table()
        own = "MAV_SYSID" if since(self.version, "4.7") else "SYSID_THISMAV"
        table[own] = (float(self.system_id), table[own][1])
        table["SCHED_LOOP_RATE"] = (LOOP_RATE_HZ[self.vehicle], table["SCHED_LOOP_RATE"][1])
        store = ParameterStore(table)
        for name, value in overrides.items():
            store.set(name, value)
        return store

    def build(self, message_id: int, loop_s: float) -> Message:
        """A message of `BUILDERS`."""
        return BUILDERS[message_id](self, loop_s)

    def _started(self, loop_s: float) -> None:
        self.estimator.reset(self.aircraft.time_at(loop_s) - self._up_s)
        self._choose_yaw_source(loop_s)
        self._start_heartbeats(loop_s)

    def _restarted(self, loop_s: float) -> None:
        self.parameters.set("STAT_BOOTCNT", self.parameters.values["STAT_BOOTCNT"] + 1)
        self.parameters.reload()
        self._router.forget()
        self._frozen.clear()
        self._boot_gyros(self.aircraft.time_at(loop_s))
        for path in self._paths:
            path.reset()
        self.estimator.reset(self.aircraft.time_at(loop_s))
        self._choose_yaw_source(loop_s)
        self._start_heartbeats(loop_s)

    def _choose_yaw_source(self, loop_s: float) -> None:
        """A boot: without a compass the heading begins at north, whatever it is."""
        self.external_nav.restart()
        self.estimator.compass = not self.external_nav.selected
        if self.external_nav.selected:
            _, _, yaw = self.aircraft.angles_rad(self.aircraft.time_at(loop_s))
            self.estimator.yaw_error_rad = -yaw

    def _boot_gyros(self, t_s: float) -> None:
        """INS_GYR_CAL = 1: every boot measures the gyro offsets anew and throws the stored ones away."""
        self.calibrations.gyros_ok = True
        if self.parameters.values["INS_GYR_CAL"] == 1:
            self.calibrations.gyros(t_s)

    def _start_heartbeats(self, loop_s: float) -> None:
        for channel in self.channels:
            channel.set_stream(HEARTBEAT, 1.0, loop_s)
            channel.streams[HEARTBEAT].next_s = loop_s

    def _holds_back(self, message_id: int) -> bool:
        # While it calibrates, the real one's delay loop sends heartbeats and parameters only.
        return super()._holds_back(message_id) or (self.calibrating and message_id != HEARTBEAT)

    def _receive_message(self, channel: Channel, message: Message, loop_s: float) -> None:
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
        elif isinstance(message, mavlink.MAVLink_vision_position_estimate_message | mavlink.MAVLink_odometry_message):
            self.external_nav.take(message, loop_s)
        elif isinstance(message, mavlink.MAVLink_timesync_message) and message.tc1 == 0:
            self.answer(channel, mavlink.MAVLink_timesync_message(self.boot_us(loop_s) * 1000, message.ts1))

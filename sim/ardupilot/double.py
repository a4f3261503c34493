"""A double of ArduPilot: parameters, telemetry and behaviour of the real one, on any event loop.

The model follows ArduPilot's sources and runs of the real firmware (autopilots 1, 2, 3, 5.4, 7.5, 9.1 and 9.3.1); the
class lists what is missing.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.aircraft import VirtualAircraft
from sim.ardupilot.board import ArduPilotBoard
from sim.ardupilot.commands import CommandServer
from sim.ardupilot.external_nav import ExternalNav
from sim.ardupilot.messages import BUILDERS, script_floats
from sim.ardupilot.parameter_server import ArduPilotParameterServer
from sim.ardupilot.parameters import device_id, offset_names
from sim.firmware.channel import Channel, Message, Stream, command_of
from sim.firmware.double import HEARTBEAT
from sim.imu_model import ImuModel

FLOATS = mavlink.MAVLINK_MSG_ID_DEBUG_FLOAT_ARRAY
FLOATS_EVERY_S = 0.09
FLOATS_ASKED_S = 3.0


class ArduPilotDouble(ArduPilotBoard):
    """An ArduPilot with up to three IMUs on a virtual aircraft.

    It is an `End` (attach, receive) for the companion; `ground` is a second `End` for a ground station. `run` sends due
    messages; answers need only the running loop. Time is the loop's clock.

    Not modelled: flight, notches, missions, learning of temperature calibrations (INS_TCALn_ENABLE = 2), calibration of
    accelerometers and of the level, the 10 s that consistency checks must pass before arming, the exchange of values
    between slots of COMPASS parameters by which a boot brings them into the order of priority. Nor the messages
    LOG_REQUEST_*, PREFLIGHT_STORAGE, REQUEST_DATA_STREAM, ODOMETRY, SETUP_SIGNING (`require_signatures` replaces it).

    Arguments are those of `ArduPilotBoard`.
    """

    def __init__(self, aircraft: VirtualAircraft, imus: Sequence[ImuModel], **more: Any) -> None:
        super().__init__(aircraft, imus, **more)
        self.external_nav: ExternalNav = ExternalNav(self)
        self._router = Router(self.system_id, self.channels)
        self._parameter_server = ArduPilotParameterServer(self)
        self._commands = CommandServer(self)
        self._floats_until_s = 0.0
        self.repeats_failures = False
        """Repeat failed checks every 30 s, as the real one does; most tests do without."""
        self._failures_due_s = 0.0
        self._boot_gyros(0.0)

    # What tests and people do to it.

    def parameter(self, name: str) -> float:
        return self.parameters.values[name]

    def set_parameter(self, name: str, value: float) -> None:
        """Set a parameter value without an announcement, as if it had always been so."""
        self.parameters.set(name, value)

    def write_as_another_station(self, name: str, value: float) -> None:
        """Set a parameter as another ground station does: stored, and announced on every port."""
        self.update_estimator(self.now_s())
        self.parameters.set(name, value)
        for member in self.parameters.family(name):
            self._parameter_server.announce(member)

    def arm(self) -> None:
        if not self.armed:
            self.armed = True
            self.say(mavlink.MAV_SEVERITY_INFO, "Arming motors")

    def disarm(self) -> None:
        if self.armed:
            self.armed = False
            self.say(mavlink.MAV_SEVERITY_INFO, "Disarming motors")

    def prearm_failures(self, loop_s: float) -> list[str]:
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

    def estimated_angles_rad(self, loop_s: float) -> tuple[float, float, float]:
        """Return roll, pitch, yaw of ATTITUDE: truth, estimator's tilt error, less AHRS_TRIM; yaw in (-pi, pi]."""
        self.update_estimator(loop_s)
        roll, pitch, yaw = self.aircraft.angles_rad(self.aircraft.time_at(loop_s))
        roll_error, pitch_error = map(float, self.estimator.tilt_error_rad)
        trim = self.parameters.effective
        yaw = (yaw + self.estimator.yaw_error_rad + np.pi) % (2.0 * np.pi) - np.pi
        return roll + roll_error - trim["AHRS_TRIM_X"], pitch + pitch_error - trim["AHRS_TRIM_Y"], float(yaw)

    def announce(self, names: Iterable[str]) -> None:
        for name in names:
            self._parameter_server.announce(name)

    # The inside.

    def build(self, message_id: int, loop_s: float) -> Message | None:
        """Build a message of `BUILDERS`, or the script's floats; None: the script is not allowed to send."""
        if message_id == HEARTBEAT and self.repeats_failures and not self.armed and loop_s >= self._failures_due_s:
            self._failures_due_s = loop_s + 30.0
            self._commands.report_failures(loop_s)
        if message_id != FLOATS:
            return BUILDERS[message_id](self, loop_s)
        return script_floats(self, loop_s) if loop_s < self._floats_until_s and not self.armed else None

    def _started(self, loop_s: float) -> None:
        self.estimator.reset(self.aircraft.time_at(loop_s) - self._up_s)
        self._choose_yaw_source(loop_s)
        self._start_heartbeats(loop_s)

    def _restarted(self, loop_s: float) -> None:
        self.parameters.set("STAT_BOOTCNT", self.parameters.values["STAT_BOOTCNT"] + 1)
        self.parameters.reload()
        self.boot_compasses()
        self._router.forget()
        self._frozen.clear()
        self._boot_gyros(self.aircraft.time_at(loop_s))
        for path in self._paths:
            path.reset()
        self.estimator.reset(self.aircraft.time_at(loop_s))
        self._choose_yaw_source(loop_s)
        self._start_heartbeats(loop_s)

    def _choose_yaw_source(self, loop_s: float) -> None:
        """Handle a boot; without a compass, the estimated heading starts at north."""
        self.external_nav.restart()
        self.estimator.compass = not self.external_nav.selected
        if self.external_nav.selected:
            _, _, yaw = self.aircraft.angles_rad(self.aircraft.time_at(loop_s))
            self.estimator.yaw_error_rad = -yaw

    def _boot_gyros(self, t_s: float) -> None:
        """Measure the gyro offsets at a boot if INS_GYR_CAL = 1, in place of the stored offsets."""
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
        elif isinstance(message, mavlink.MAVLink_vision_position_estimate_message):
            self.external_nav.take(message, loop_s)
        elif isinstance(message, mavlink.MAVLink_play_tune_message):
            self.buzzer.take(message, loop_s)
        elif isinstance(message, mavlink.MAVLink_tunnel_message):
            if self.script and bytes(message.payload[: message.payload_length]) == b"CMPF\x01":
                self._floats_until_s = loop_s + FLOATS_ASKED_S
                channel.streams.setdefault(FLOATS, Stream(FLOATS_EVERY_S, loop_s + FLOATS_EVERY_S))
        elif isinstance(message, mavlink.MAVLink_timesync_message) and message.tc1 == 0:
            self.answer(channel, mavlink.MAVLink_timesync_message(self.boot_us(loop_s) * 1000, message.ts1))


class Router:
    """Learns routes from every message, and keeps them until a reboot.

    Some messages address a component of the autopilot's system that was heard on the sender's port only, or never.
    The autopilot executes these itself (autopilots 5.4, rule 1e).
    """

    def __init__(self, system_id: int, channels: Sequence[Channel]) -> None:
        self._system_id = system_id
        self._channels = channels
        self._routes: dict[tuple[int, int], set[int]] = {}

    def forget(self) -> None:
        self._routes.clear()

    def route(self, came_by: Channel, message: Message) -> bool:
        """Learn the sender's route and forward the message; return True if the autopilot itself handles the message."""
        here = self._channels.index(came_by)
        source = (message.get_srcSystem(), message.get_srcComponent())
        if source == (self._system_id, 1):
            return False  # our own words came back
        self._routes.setdefault(source, set()).add(here)
        system = int(getattr(message, "target_system", 0))
        component = int(getattr(message, "target_component", 0))
        if system == 0:
            ports = set(range(len(self._channels)))
        elif system == self._system_id and component == 1:
            ports = set()
        else:
            ports = set()
            for (known_system, known_component), where in self._routes.items():
                if known_system == system and component in (0, known_component):
                    ports |= where
        ports.discard(here)
        for port in ports:
            self._channels[port].forward(bytes(message.get_msgbuf()))
        if system == 0:
            return True
        if system != self._system_id:
            return False
        return component in (0, 1) or not ports

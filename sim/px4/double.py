"""A double of PX4: parameters, telemetry and behaviour of the real one, on any event loop.

The model follows PX4's sources and runs of the real firmware (autopilots 4, 5.1, 5.2, 5.4, 7.5, 8, 9.2 and 9.3.2); the
class lists what is missing.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.aircraft import VirtualAircraft
from sim.firmware.channel import Channel, Message, command_of
from sim.imu_model import ImuModel
from sim.px4.arming import ArmAuthorization, Checks
from sim.px4.board import PX4Board
from sim.px4.commander import Commander
from sim.px4.external_vision import ExternalVision
from sim.px4.messages import BUILDERS
from sim.px4.parameter_server import PX4ParameterServer
from sim.px4.parameters import Consumer
from sim.px4.port import PX4Port
from sim.px4.rivals import SAMPLE_S, BackgroundGyroCalibration, CommandedCalibrations, LearnedOffsets
from sim.px4.shell import Shell

AUTOSAVE_S, AUTOSAVE_EVERY_S = 0.3, 2.0


class PX4Double(PX4Board):
    """A PX4 with up to four IMUs on a virtual aircraft; its own port is TELEM2 (MAV_1), `ground` is TELEM1 (MAV_0).

    Not modelled: flight, thermal compensation, calibrations but the gyros',
    PREFLIGHT_STORAGE, ODOMETRY, boards that save to flash, the data rate of a port, MAVFTP, missions, logs, events,
    SETUP_SIGNING, the target fields of TIMESYNC.

    Arguments are those of `PX4Board`.
    """

    def __init__(
        self, aircraft: VirtualAircraft, imus: Sequence[ImuModel], *, imu_rate_hz: float = 250.0, **more: Any
    ) -> None:
        super().__init__(aircraft, imus, imu_rate_hz=imu_rate_hz, **more)
        self.gyro_rival = BackgroundGyroCalibration(self)
        self.learned_offsets = LearnedOffsets(self)
        self.calibrations = CommandedCalibrations(self)
        self.authorization = ArmAuthorization(self)
        self.vision = ExternalVision(self)
        self.checks = Checks(self)
        self.commander: Commander = Commander(self, self.checks, self.calibrations, self.authorization)
        self._parameter_server = PX4ParameterServer(self)
        self._voice = Voice(self)
        self.shell = Shell(self)
        self._consumers = (
            Consumer(self, 1.0 / imu_rate_hz, self._update_imus),
            Consumer(self, SAMPLE_S, self._update_gyro_rival),
        )
        self._saving = False
        self._saved_s = -math.inf
        self._armed_s = 0.0

    # What tests and people do to it.

    def parameter(self, name: str) -> float:
        return self.parameters[name]

    def set_parameter(self, name: str, value: float) -> None:
        """Set a parameter value without an announcement; it is in use at once, however small the change."""
        self.parameters.preset(name, value)
        self.restart_sensors()
        self._read_boot_parameters()

    def write_as_another_station(self, name: str, value: float) -> None:
        """Set a parameter as another ground station does: stored, and announced on every port."""
        if self.parameters.set(name, value):
            self.parameters_changed()

    def arm(self) -> None:
        """Arm without checks; to have checks, send the arm command instead."""
        if not self.armed:
            self.armed, self._armed_s = True, self.now_s()
            self.say(mavlink.MAV_SEVERITY_INFO, "Armed by external command\t")

    def disarm(self) -> None:
        if self.armed:
            self.armed = False
            self.say(mavlink.MAV_SEVERITY_INFO, "Disarmed by external command\t")
            self.learned_offsets.disarmed(self.now_s(), self.now_s() - self._armed_s)

    def prearm_failures(self, loop_s: float) -> list[str]:
        """Return the reasons against arming, without the authorisation, in the firmware's words without prefix."""
        return self.checks.failures(loop_s)

    # What its parts use.

    def build(self, message_id: int, loop_s: float) -> Message | None:
        return BUILDERS[message_id](self, loop_s)

    def estimated_angles_rad(self, loop_s: float) -> tuple[float, float, float]:
        """Return roll, pitch, yaw of ATTITUDE: truth plus the first estimator's tilt error; yaw in (-pi, pi]."""
        self.update_estimators(loop_s)
        roll, pitch, yaw = self.aircraft.angles_rad(self.aircraft.time_at(loop_s))
        roll_error, pitch_error = self.vehicle_imus[0].estimator.tilt_error_rad
        self.vision.update(loop_s)
        yaw += self.vision.yaw_error_rad
        return roll + roll_error, pitch + pitch_error, float((yaw + np.pi) % (2.0 * np.pi) - np.pi)

    def parameters_changed(self, *, consumers: bool = True) -> None:
        if consumers:
            for consumer in self._consumers:
                consumer.notify()
        self._parameter_server.tell_changes()
        if not self._saving:
            self._saving = True
            since_s = self.now_s() - self._saved_s
            self.later(max(AUTOSAVE_S, AUTOSAVE_EVERY_S - since_s), self._autosave)

    def say(self, severity: int, text: str) -> None:
        self._voice.say(severity, text)

    # The inside.

    def _started(self, loop_s: float) -> None:
        self._set_up(loop_s, self.aircraft.time_at(loop_s) - self._up_s)

    def _restarted(self, loop_s: float) -> None:
        self.parameters.load()
        self._frozen.clear()
        self.restart_sensors()
        for part in (
            self._parameter_server,
            self.authorization,
            self.commander,
            self.vision,
            self.shell,
        ):
            part.restart()
        for consumer in self._consumers:
            consumer.restart()
        self._saving, self._saved_s = False, -math.inf
        self._set_up(loop_s, self.aircraft.time_at(loop_s))

    def _set_up(self, loop_s: float, since_s: float) -> None:
        for port in self.ports:
            port.restart(loop_s)
        self._read_boot_parameters()
        self.gyro_rival.restart(loop_s)
        self.checks.restart()
        self.learned_offsets.restart()
        for imu in self.vehicle_imus:
            error = self.residual(imu.index + 1, loop_s)
            imu.estimator.reset(since_s, error.accel_m_s2)

    def _read_boot_parameters(self) -> None:
        """Read the parameters that have an effect only at a boot."""
        companion, ground = self.ports
        companion.forwards = bool(self.parameters["MAV_1_FORWARD"])
        ground.forwards = bool(self.parameters["MAV_0_FORWARD"])

    def _update_imus(self, now_s: float) -> None:
        """Update the IMUs' parameters; an estimator deletes its bias when an offset or scale changes."""
        self.update_estimators(now_s)
        self.update_mags()
        for imu in self.vehicle_imus:
            gyro, accel = imu.gyro.count, imu.accel.count
            imu.gyro.parameters_update()
            imu.accel.parameters_update()
            if imu.gyro.count != gyro:
                imu.estimator.forget_gyro_bias()
            if imu.accel.count != accel:
                imu.estimator.forget_accel_bias()
            if (gyro, accel) != (imu.gyro.count, imu.accel.count):
                self.learned_offsets.calibration_changed(now_s)

    def _update_gyro_rival(self, now_s: float) -> None:
        if self.gyro_rival.running:
            self.gyro_rival.parameters_updated(now_s)

    def _autosave(self) -> None:
        self._saving, self._saved_s = False, self.now_s()
        self.parameters.save()

    def _receive_message(self, channel: Channel, message: Message, loop_s: float) -> None:
        assert isinstance(channel, PX4Port)
        source = (message.get_srcSystem(), message.get_srcComponent())
        if source == (self.system_id, 1):
            return  # our own words came back
        channel.seen.add(source)
        forward(self.system_id, self.ports, channel, message, heartbeats=bool(self.parameters["MAV_HB_FORW_EN"]))
        self._parameter_message(channel, message, loop_s)
        if isinstance(message, mavlink.MAVLink_heartbeat_message):
            self._voice.heard(channel, message, loop_s)
        elif isinstance(message, mavlink.MAVLink_command_long_message | mavlink.MAVLink_command_int_message):
            if is_for_us(self.system_id, message, broadcast=True):
                self.commander.handle(command_of(channel, message, loop_s))
        elif isinstance(message, mavlink.MAVLink_command_ack_message):
            if is_for_us(self.system_id, message, broadcast=True):
                self.authorization.acknowledged(message)
        elif isinstance(message, mavlink.MAVLink_play_tune_message):
            if is_for_us(self.system_id, message, broadcast=True):
                self.buzzer.take(message, loop_s)
        elif isinstance(message, mavlink.MAVLink_serial_control_message):
            self.shell.take(channel, message, loop_s)
        elif isinstance(message, mavlink.MAVLink_timesync_message):
            if message.tc1 == 0:
                now_ns = self.boot_us(loop_s) * 1000
                self.answer(channel, mavlink.MAVLink_timesync_message(now_ns, message.ts1))
            else:
                self.vision.timesync(message.tc1, message.ts1, loop_s)
        else:
            self.vision.take(message, loop_s)

    def _parameter_message(self, port: PX4Port, message: Message, loop_s: float) -> None:
        if not is_for_us(self.system_id, message, broadcast=False):
            return
        server = self._parameter_server
        if isinstance(message, mavlink.MAVLink_param_set_message):
            server.set(port, message, loop_s)
        elif isinstance(message, mavlink.MAVLink_param_request_read_message):
            server.read(port, message)
        elif isinstance(message, mavlink.MAVLink_param_request_list_message):
            server.list_all(port)


COMPONENT = 1


def forward(system_id: int, ports: Sequence[PX4Port], came_by: PX4Port, message: Message, *, heartbeats: bool) -> None:
    """Forward a packet to the other ports on which its target was heard.

    Both ports need MAV_n_FORWARD = 1 (autopilots 5.4).
    """
    system = int(getattr(message, "target_system", 0))
    component = int(getattr(message, "target_component", 0))
    if not came_by.forwards or (system, component) == (system_id, COMPONENT):
        return
    if message.get_type() == "HEARTBEAT" and not heartbeats:
        return
    for port in ports:
        if port is not came_by and port.forwards and port.has_seen(system, component):
            port.forward(bytes(message.get_msgbuf()))


def is_for_us(system_id: int, message: Message, *, broadcast: bool) -> bool:
    """Return True for a message to this autopilot or, with `broadcast`, to every system."""
    system, component = int(getattr(message, "target_system", 0)), int(getattr(message, "target_component", 0))
    return (system == system_id or (broadcast and system == 0)) and component in (0, COMPONENT)


TEXT_PERIOD_S = 0.05
STALE_S = 5.0
_CHUNK = 50


class Voice:
    """Sends texts, one at a time, on ports where a ground station's HEARTBEAT is received (autopilots 9.3.2).

    On other ports, texts wait, and are dropped when they are 5 s old.
    """

    def __init__(self, double: PX4Board) -> None:
        self._double = double

    def say(self, severity: int, text: str) -> None:
        """Queue a text on every port; if more than eight wait, the oldest is lost."""
        now_s = self._double.now_s()
        for port in self._double.ports:
            port.texts.append((now_s, severity, text))
            self.go_on(port)

    def heard(self, port: PX4Port, message: mavlink.MAVLink_heartbeat_message, loop_s: float) -> None:
        """Store the time of a ground station's HEARTBEAT, and continue sending."""
        if message.type == mavlink.MAV_TYPE_GCS:
            port.gcs_heard_s = loop_s
        self.go_on(port)

    def go_on(self, port: PX4Port) -> None:
        """Send the next text if it is due: 20 a second."""
        now_s = self._double.now_s()
        while port.texts and now_s - port.texts[0][0] >= STALE_S:
            port.texts.popleft()
        if not port.texts or port.text_next_s > now_s or not port.has_ground_station(now_s):
            return
        _, severity, text = port.texts.popleft()
        data = text.encode()
        for number, start in enumerate(range(0, len(data), _CHUNK)):
            chunk = data[start : start + _CHUNK]
            self._double.answer(port, mavlink.MAVLink_statustext_message(severity, chunk, port.text_number, number))
        port.text_number = (port.text_number + 1) % 65536
        port.text_next_s = now_s + TEXT_PERIOD_S
        self._double.later(TEXT_PERIOD_S, lambda: self.go_on(port))

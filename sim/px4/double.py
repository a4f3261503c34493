"""A PX4 that fits in a test: parameters, telemetry and manners of the real one, on any event loop.

What is modelled follows what was read in PX4's sources and seen in runs of the real firmware (the "autopilots"
reference of this project, sections 4, 5.1, 5.2, 5.4, 7.5, 8, 9.2 and 9.3.2); the class says what is not.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Literal, NamedTuple

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.aircraft import VirtualAircraft
from sim.earth import Array
from sim.firmware.channel import Channel, Message
from sim.firmware.command import command_of
from sim.firmware.double import AutopilotDouble
from sim.firmware.faults import Faults
from sim.firmware.writes import Write
from sim.imu_model import Bias, ImuModel
from sim.px4.arm_authorization import ArmAuthorization
from sim.px4.calibrations import Calibrations
from sim.px4.changes import Consumer
from sim.px4.checks import Checks
from sim.px4.commander import Commander, heard_ground_station
from sim.px4.defaults import EXTERNAL_IDS, SIMULATED_IDS, SLOTS, default_parameters
from sim.px4.external_vision import ExternalVision
from sim.px4.messages import BUILDERS, NORMAL_RATES, ONBOARD_RATES
from sim.px4.parameter_server import ParameterServer
from sim.px4.parameters import ParameterStore
from sim.px4.port import PX4Port
from sim.px4.rivals import SAMPLE_S, BackgroundGyroCalibration, LearnedOffsets
from sim.px4.routing import forward, is_for_us
from sim.px4.vehicle_imu import Sample, VehicleImu
from sim.px4.voice import Voice

__all__ = ["Applied", "Faults", "PX4Double", "Write"]

Version = Literal["1.18", "1.16"]
AUTOSAVE_S, AUTOSAVE_EVERY_S = 0.3, 2.0


class Applied(NamedTuple):
    """What one IMU works with at this moment, whatever its parameters say."""

    gyro_offset_rad_s: Array
    accel_offset_m_s2: Array
    accel_scale: Array
    gyro_slot: int | None
    """n of CAL_GYROn_*; None: no slot has its device id."""
    accel_slot: int | None
    rotation: Array
    """Sensor to vehicle."""


class PX4Double(AutopilotDouble):
    """An autopilot with up to four IMUs on a virtual aircraft; its port is TELEM2 (MAV_1), `ground` is TELEM1 (MAV_0).

    Not modelled: flight, thermal compensation (TC_* can be read and written, nothing more), the 6-side calibration (it
    fails), magnetometer calibrations, factory calibration storage, MAVFTP, missions, logs, events,
    SETUP_SIGNING, the target fields of TIMESYNC.

    Args:
        aircraft: the truth.
        imus: one to four models in the order of their uORB instances; the first is IMU 1. Their `mounting_deg` is how
            the board is really turned, which SENS_BOARD_ROT (default none) or CAL_x_ROT is meant to undo.
        version: "1.18": PARAM_ERROR. "1.16": silence instead.
        vehicle: "copter" or "plane".
        parameters: values that differ from the defaults, such as {"IMU_GYRO_CAL_EN": 0}; set before the first boot.
        slots: number n of the CAL_GYROn_/CAL_ACCn_ slot of each IMU, None for no slot; default 0, 1, 2, ...
        external: numbers (0..) of IMUs that are external: they turn with CAL_x_ROT.
        imu_rate_hz: of the integrated samples; streams are quantised by it.
        flash_storage: a board that saves to flash: while it is armed nothing is saved.
        default_streams: False: nothing but heartbeats and TIMESYNC runs by itself (quick tests).
        data_rate: bytes per second of the companion's port (MAV_1_RATE); None: enough.
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
        version: Version = "1.18",
        vehicle: Literal["copter", "plane"] = "copter",
        parameters: Mapping[str, float] | None = None,
        slots: Sequence[int | None] | None = None,
        external: Sequence[int] = (),
        imu_rate_hz: float = 250.0,
        flash_storage: bool = False,
        default_streams: bool = True,
        data_rate: float | None = None,
        up_s: float = 30.0,
        has_position: bool = True,
        clock_ppm: float = 0.0,
        seed: int = 0,
    ) -> None:
        if not 1 <= len(imus) <= SLOTS:
            raise ValueError(f"imus: found {len(imus)}; allowed: 1 to {SLOTS}")
        if slots is not None and len(slots) != len(imus):
            raise ValueError(f"slots: found {len(slots)}; allowed: one for each of the {len(imus)} IMUs")
        quiet = {mavlink.MAVLINK_MSG_ID_HEARTBEAT: 1.0, mavlink.MAVLINK_MSG_ID_TIMESYNC: 10.0}
        period_s = 1.0 / imu_rate_hz
        self.ports = (
            PX4Port(
                system_id, self._handle,
                defaults=ONBOARD_RATES if default_streams else quiet, period_s=period_s, data_rate=data_rate,
            ),
            PX4Port(
                system_id, self._handle,
                defaults=NORMAL_RATES if default_streams else quiet, period_s=period_s, data_rate=None,
            ),
        )  # fmt: skip
        super().__init__(
            aircraft, imus, self.ports, up_s=up_s, has_position=has_position, clock_ppm=clock_ppm, seed=seed
        )
        self.system_id, self.version, self.vehicle = system_id, version, vehicle
        self.flash_storage = flash_storage
        self.timesync_answers = 0
        """Answers to its own TIMESYNC requests."""
        ids = [EXTERNAL_IDS[n] if n in external else SIMULATED_IDS[n] for n in range(len(imus))]
        self.parameters = self._new_store(parameters or {}, ids, slots or range(len(imus)))
        self.vehicle_imus = [
            VehicleImu(model, n, ids[n], self.parameters, external=n in external, rate_hz=imu_rate_hz, seed=seed)
            for n, model in enumerate(imus)
        ]
        self.gyro_rival = BackgroundGyroCalibration(self)
        self.learned_offsets = LearnedOffsets(self)
        self.calibrations = Calibrations(self)
        self.authorization = ArmAuthorization(self)
        self.vision = ExternalVision(self)
        self.checks = Checks(self)
        self.commander = Commander(self)
        self._parameter_server = ParameterServer(self)
        self._voice = Voice(self)
        self._consumers = (
            Consumer(self, period_s, self._update_imus),
            Consumer(self, SAMPLE_S, self._update_gyro_rival),
        )
        self._frozen: dict[int, Sample] = {}
        self._saving = False
        self._saved_s = -math.inf
        self._armed_s = 0.0

    # What tests and people do to it.

    @property
    def writes(self) -> list[Write]:
        """Every PARAM_SET that arrived, obeyed or not, in order; integers as numbers."""
        return self._parameter_server.writes

    def parameter(self, name: str) -> float:
        """What is read back; KeyError if there is none of that name."""
        return self.parameters[name]

    def saved_parameter(self, name: str) -> float:
        """What the next boot will find; KeyError if there is none of that name."""
        return self.parameters.saved[name]

    def set_parameter(self, name: str, value: float) -> None:
        """Set without telling anyone, as if it had always been so: in use at once, whatever the threshold."""
        self.parameters.preset(name, value)
        for imu in self.vehicle_imus:
            imu.restart()
        self._read_boot_parameters()

    def write_as_another_station(self, name: str, value: float) -> None:
        """Another ground station sets a parameter: stored, and announced on every port."""
        if self.parameters.set(name, value):
            self.parameters_changed()

    def arm(self) -> None:
        """It arms, whatever the checks say; send the command to have them run."""
        if not self.armed:
            self.armed, self._armed_s = True, self.now_s()
            self.say(mavlink.MAV_SEVERITY_INFO, "Armed by external command\t")

    def disarm(self) -> None:
        """The pilot disarms."""
        if self.armed:
            self.armed = False
            self.say(mavlink.MAV_SEVERITY_INFO, "Disarmed by external command\t")
            self.learned_offsets.disarmed(self.now_s(), self.now_s() - self._armed_s)

    def applied(self, instance: int) -> Applied:
        """What IMU `instance` (1..) works with: the truth behind the parameters."""
        imu = self.vehicle_imus[instance - 1]
        gyro, accel = imu.gyro, imu.accel
        return Applied(
            gyro.offset.copy(), accel.offset.copy(), accel.scale.copy(), gyro.slot, accel.slot, accel.rotation.copy()
        )

    def residual(self, instance: int, loop_s: float) -> Bias:
        """What is left in the output of IMU `instance` (1..) after offsets and scales: output minus truth, FRD."""
        t_s = self.aircraft.time_at(loop_s)
        output, truth = self.vehicle_imus[instance - 1].corrected(t_s), self.aircraft.truth_at(t_s)
        return Bias(output[:3] - truth.rate_rad_s, output[3:] - truth.force_m_s2)

    def prearm_failures(self, loop_s: float) -> list[str]:
        """Why it would not arm, in the firmware's words without the prefix; the authorisation apart."""
        return self.checks.failures(loop_s)

    # What its parts use.

    def build(self, message_id: int, loop_s: float) -> Message | None:
        """A message of `BUILDERS`."""
        return BUILDERS[message_id](self, loop_s)

    def imu_output(self, index: int, loop_s: float) -> Sample:
        """The newest corrected sample of IMU index 0.. in vehicle FRD."""
        if self.faults.frozen_imu and index in self._frozen:
            return self._frozen[index]
        sample = self.vehicle_imus[index].sample(self.aircraft.time_at(loop_s))
        self._frozen[index] = sample
        return sample

    def update_estimators(self, loop_s: float) -> None:
        """Bring the estimators to this time; to be called before anything changes the output."""
        t_s = self.aircraft.time_at(loop_s)
        for imu in self.vehicle_imus:
            if imu.estimator.time_s == t_s:
                continue  # another message of the same instant has done it
            error = self.residual(imu.index + 1, loop_s)
            imu.estimator.update(t_s, error.gyro_rad_s, error.accel_m_s2)

    def estimated_angles_rad(self, loop_s: float) -> tuple[float, float, float]:
        """Roll, pitch, yaw of ATTITUDE: truth and the first estimator's tilt error; yaw in (-pi, pi]."""
        self.update_estimators(loop_s)
        roll, pitch, yaw = self.aircraft.angles_rad(self.aircraft.time_at(loop_s))
        roll_error, pitch_error = self.vehicle_imus[0].estimator.tilt_error_rad
        self.vision.update(loop_s)
        yaw += self.vision.yaw_error_rad
        return roll + roll_error, pitch + pitch_error, float((yaw + np.pi) % (2.0 * np.pi) - np.pi)

    def parameters_changed(self, *, consumers: bool = True) -> None:
        """Tell everyone: those who use parameters, every port, the storage."""
        if consumers:
            for consumer in self._consumers:
                consumer.notify()
        self._parameter_server.tell_changes()
        if not self._saving:
            self._saving = True
            since_s = self.now_s() - self._saved_s
            self.later(max(AUTOSAVE_S, AUTOSAVE_EVERY_S - since_s), self._autosave)

    def say(self, severity: int, text: str) -> None:
        """STATUSTEXT on every port with a ground station; elsewhere it waits for one, for 5 s."""
        self._voice.say(severity, text)

    # The inside.

    def _new_store(
        self, overrides: Mapping[str, float], ids: Sequence[int], slots: Sequence[int | None]
    ) -> ParameterStore:
        table = default_parameters()
        for device_id, slot in zip(ids, slots, strict=True):
            if slot is not None:
                table |= {f"CAL_GYRO{slot}_ID": device_id, f"CAL_ACC{slot}_ID": device_id}
        table["MAV_SYS_ID"] = self.system_id
        table["MAV_TYPE"] = 2 if self.vehicle == "copter" else 1
        store = ParameterStore(table)
        for name, value in overrides.items():
            store.preset(name, value)
        return store

    def _started(self, loop_s: float) -> None:
        self._set_up(loop_s, self.aircraft.time_at(loop_s) - self._up_s)

    def _restarted(self, loop_s: float) -> None:
        self.parameters.load()
        self._frozen.clear()
        for imu in self.vehicle_imus:
            imu.restart()
        for part in (self._parameter_server, self.calibrations, self.authorization, self.commander, self.vision):
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
        """What is looked at only at a boot."""
        companion, ground = self.ports
        companion.forwards = bool(self.parameters["MAV_1_FORWARD"])
        ground.forwards = bool(self.parameters["MAV_0_FORWARD"])

    def _update_imus(self, now_s: float) -> None:
        """The IMUs look at the parameters; an estimator forgets its bias when an offset or scale is taken."""
        self.update_estimators(now_s)
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
        if self.flash_storage and self.armed:
            self.later(1.0, self._autosave)
            return
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
            heard_ground_station(channel, message, loop_s)
            self._voice.go_on(channel)
        elif isinstance(message, mavlink.MAVLink_command_long_message | mavlink.MAVLink_command_int_message):
            if is_for_us(self.system_id, message, broadcast=True):
                self.commander.handle(command_of(channel, message, loop_s))
        elif isinstance(message, mavlink.MAVLink_command_ack_message):
            if is_for_us(self.system_id, message, broadcast=True):
                self.authorization.acknowledged(message)
        elif isinstance(message, mavlink.MAVLink_timesync_message):
            if message.tc1 == 0:
                now_ns = self.boot_us(loop_s) * 1000
                self.answer(channel, mavlink.MAVLink_timesync_message(now_ns, message.ts1))
            else:
                self.timesync_answers += 1
                self.vision.timesync(message.tc1, message.ts1, loop_s)
        else:
            self.vision.take(message, loop_s)

    def _parameter_message(self, port: PX4Port, message: Message, loop_s: float) -> None:
        server = self._parameter_server
        if isinstance(message, mavlink.MAVLink_param_set_message):
            if is_for_us(self.system_id, message, broadcast=False):
                server.set(port, message, loop_s)
        elif isinstance(message, mavlink.MAVLink_param_request_read_message):
            if is_for_us(self.system_id, message, broadcast=False):
                server.read(port, message)
        elif isinstance(message, mavlink.MAVLink_param_request_list_message) and is_for_us(
            self.system_id, message, broadcast=False
        ):
            server.list_all(port)

"""Interface of a firmware: everything in which ArduPilot and PX4 differ.

A new firmware is a subclass of `Firmware` in a file of its own, and an entry in `firmwares.FIRMWARES`.

A plain `Firmware` represents an autopilot without a heartbeat yet, `OtherFirmware` an unsupported one. Their methods
return "no" or refuse with a reason, so that the companion measures and writes nothing.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, Final, Literal

from companion.autopilot.firmware.compass_calibration import CompassCalibration, no_compass
from companion.autopilot.firmware.imu_calibration import ImuCalibration, Range, Rival
from companion.autopilot.firmware.imu_messages import ImuMessage
from companion.autopilot.parameters.change import Change, FirmwareName, Names, Parameters, same_float32
from companion.config.sections import Profile
from companion.errors import AutopilotError
from companion.estimation.solution.curve import Polynomial
from companion.links.mavlink.link import Message
from companion.messages import message
from companion.physics.frames import Matrix
from companion.samples import Triad, Vector


class Firmware:
    """Properties of one firmware. Methods that read parameters raise AutopilotError if one cannot be read."""

    name: FirmwareName | None = None
    words = "autopilot"
    mav_autopilot: int | None = None

    # --- link and telemetry

    heartbeat_rate_hz: float | None = None  # rate to request on our own link; None: the firmware's is fixed
    late_heartbeat_on_request = False
    integers_bytewise: bool | None = None  # integers are bytes in the float field; None: see AUTOPILOT_VERSION
    takes_nan_position = False
    imu_messages: Mapping[int, tuple[ImuMessage, ...]] = {}  # by IMU, the best first; new offsets show in the last
    tells_ekf_bias = False  # HIGHRES_IMU has the EKF's bias subtracted, and the console prints the bias
    estimator_message: type[Message] | None = None  # shows whether the yaw agrees with the magnetometer
    faster_log = ""

    def compass_ratio(self, message: Any) -> float:
        """Return the compass innovation divided by its gate, from an `estimator_message`; 0: no comparison made."""
        return 0.0

    # --- calibration of an IMU, and its write

    ranges: Mapping[str, Range] = {}  # allowed values of every parameter that a calibration or its undo writes
    rivals: tuple[Rival, ...] = ()
    parts: Mapping[tuple[int, int], Profile] = {}
    """IMU models by the device types of gyro and accelerometer; each firmware numbers device types its own way."""
    settle_s = 2.0  # time after a write in which the telemetry may still show the old offsets
    write_s = 5.0
    gyro_calibration_resets_ekf = False  # its own gyro calibration resets the EKF's gyro bias, which AHRS shows
    ekf_reset_s = 0.0  # time for the EKF to show that it has settled after that calibration
    why_no_thermal_write: str | None = None  # None: curves can be written as its temperature calibration
    level_turns_imus = False  # the level rotates the IMUs' data, not only the reported attitude

    async def read_calibration(self, parameters: Parameters, instance: int, memory: SlotMemory) -> ImuCalibration:
        """Read offsets, scales and other corrections that the autopilot applies to IMU `instance` (1 to 3)."""
        raise AutopilotError(message("firmware_not_supported", what="calibration"))

    def stale_tilt_deg(self, changes: Sequence[Change]) -> float:
        """Return the tilt error that the EKF may keep after these changes until a restart; 0: no restart needed."""
        return 0.0

    async def thermal_changes(
        self,
        parameters: Parameters,
        calibration: ImuCalibration,
        gyro: Polynomial,
        accel: Polynomial | None,
        degc: float,
    ) -> list[Change]:
        """Plan the changes that write curves of bias over temperature; the IMU's output at `degc` stays unchanged."""
        raise AutopilotError(self.why_no_thermal_write or message("firmware_not_supported", what="curves"))

    sensor_switches: Mapping[str, str] = {}  # parameters that are 0 if a sensor is not used; {}: its number, and from 0
    checks_in_health_alone = False  # SYS_STATUS shows the checks before arming in its health bits alone
    compass_messages: Mapping[int, type[Message]] = {}  # by compass (from 1), in milligauss
    compass_rival: type[Message] | None = None  # sent on request while the firmware itself calibrates a compass
    raw_fields: bool = False  # True: `compass_messages` carry raw fields, in the axes of the sensors

    async def read_compass(self, parameters: Parameters, number: int) -> CompassCalibration:
        """Read the correction that the autopilot applies to compass `number`; AutopilotError: it has none."""
        raise no_compass(number, message("firmware_not_supported", what="compass"))

    async def plan_level(
        self, parameters: Parameters, roll_rad: float, pitch_rad: float
    ) -> tuple[list[Change], Matrix]:
        """Plan the changes of the level for a measured tilt; also return their rotation, (3, 3), in vehicle axes."""
        raise AutopilotError(message("firmware_not_supported", what="level"))

    # --- heading from outside; `found`: values of `heading_names`

    heading_settings: tuple[HeadingSetting, ...] = ()
    heading_watched: tuple[str, ...] = ()  # further parameters that affect the use of our heading
    heading_risks: tuple[str, ...] = ()

    def heading_net(self, found: Mapping[str, float]) -> HeadingFallback:
        return "none"

    def takes_only_our_heading(self, found: Mapping[str, float]) -> bool:
        return False

    def missing_compass(self, found: Mapping[str, float]) -> str | None:
        """Return the parameter that switches off a compass which the firmware needs; None: the compass is on."""
        return None

    async def yaw_is_its_own(self, parameters: Parameters) -> bool:
        return True

    # --- arming

    gate_parameters: tuple[str, ...] = ()
    heater_parameters: Mapping[str, str] = {}  # "target", degC, of the IMU heater; "margin" below it at arming, K
    gate_is_script = False  # the gate is a script on the flight controller, which gets the verdict

    async def find_gate_problem(
        self, parameters: Parameters, system_id: int | None, script_starts_s: float
    ) -> str | None:
        """Return as text the settings without which the autopilot arms without asking us; None: nothing is missing.

        `script_starts_s`: wait before a second check if the script on the autopilot does not run yet.
        """
        return message("no_arm_authorisation")

    # --- the port, and ground stations behind it

    def port_needs(self, baud: int) -> str | None:
        """Return the parameters that the autopilot needs for its end of our serial line, as text; None: unknown."""
        return None

    async def read_closed_links(self, parameters: Parameters) -> list[str]:
        return []

    def forwarding_words(self, closed: Sequence[str]) -> tuple[bool, str]:
        """Return whether it is normal that no ground station is received, and as text the cause and the remedy."""
        return True, message("no_ground_station_heard", why="none connected?")

    # --- derived from the values above

    async def read_rivals(self, parameters: Parameters, seen: dict[str, int] | None = None) -> tuple[Rival, ...]:
        """Read which parameters overwrite our offsets, including any switched off that still act until the next boot.

        `seen` is stored between calls: the number of the boot in which each parameter was last found switched on.
        """
        found: list[Rival] = []
        seen = {} if seen is None else seen
        boots = parameters.boots
        for rival in self.rivals:
            value = await parameters.read_integer(rival.parameter)
            if value:
                found.append(rival.active(value))
                seen[rival.parameter] = boots
            elif rival.from_boot and seen.get(rival.parameter) == boots:
                found.append(rival)
        return tuple(found)

    def heading_names(self) -> list[str]:
        """List the parameters that decide whether the firmware uses our heading.

        Raises:
            AutopilotError: no heartbeat of the autopilot yet, or an unsupported firmware.
        """
        if self.name is None:
            raise AutopilotError(message("no_heartbeat_of_the_autopilot"))
        if not self.heading_settings:
            raise AutopilotError(message("firmware_not_supported", what="heading"))
        wanted = [name for one in self.heading_settings for name in (one.parameter, one.like) if name]
        return [*wanted, *self.heading_watched]

    def heading_changes(self, found: Mapping[str, float]) -> list[Change]:
        """Plan the changes that make the firmware use our heading; empty: everything is set.

        Raises:
            AutopilotError: this autopilot lacks a parameter, so it cannot use a heading.
        """
        changes = []
        for setting in self.heading_settings:
            before = found.get(setting.parameter)
            if before is None:
                if setting.optional:
                    continue
                raise AutopilotError(message("heading_parameter_missing", parameter=setting.parameter))
            after = setting.after(found)
            if not same_float32(before, after):
                changes.append(Change(setting.parameter, before, after))
        return changes


class OtherFirmware(Firmware):
    name = "other"


@dataclasses.dataclass(frozen=True, slots=True)
class HeadingSetting:
    """One parameter that the firmware needs to use our heading, and the reason.

    `bits`: set the bits of `value` and leave the other bits. `like`: another parameter, whose value is wanted; if that
    parameter does not exist, `value` is wanted.
    """

    parameter: str
    value: float
    why: str
    bits: bool = False
    optional: bool = False
    like: str = ""

    def after(self, found: Mapping[str, float]) -> float:
        value = found.get(self.like, self.value)
        return float(int(found[self.parameter]) | int(value)) if self.bits else value


HeadingFallback = Literal["script", "command", "autopilot", "none"]
"""Party that switches the autopilot to another heading source when our heading ends; "command" means the companion."""

HEADING_FALLBACKS: Final[dict[HeadingFallback, str]] = {
    "script": "if the companion's heading ends in flight, the script switches to gyros and GNSS within a second",
    "command": "if the companion's heading ends, it selects gyros and GNSS, unless its board fails (autopilot script)",
    "autopilot": "if the companion's heading ends, the autopilot returns to its magnetometer",
    "none": "if the companion's heading ends, no heading is left: fly only where you can land without one",
}

NO_IMU: Final = 0


class SlotMemory:
    """Remembers each device id's IMU and, for one boot, the offsets in use and the parameters that overwrite them."""

    def __init__(self) -> None:
        self._instance_of: dict[tuple[Triad, int], int] = {}
        self.enabled: dict[Triad, int] = {}  # number of slots in use at the last reading of a calibration
        self._in_use: dict[Names, tuple[int, Vector]] = {}
        self.rivals: dict[str, int] = {}

    def learn(self, sensor: Triad, device_id: int, instance: int) -> None:
        """Note that the offsets of this device change the telemetry of IMU `instance` (NO_IMU: of no IMU)."""
        for other in [key for key, known in self._instance_of.items() if key[0] == sensor and known == instance]:
            if instance != NO_IMU:
                del self._instance_of[other]
        self._instance_of[sensor, device_id] = instance

    def known(self, sensor: Triad, device_id: int) -> int | None:
        """Return the IMU whose telemetry a device's offsets change: NO_IMU if none does, None if not learned yet."""
        return self._instance_of.get((sensor, device_id))

    def holds_strangers(self, sensor: Triad, imus: int) -> bool:
        """Check for more parameter slots in use than IMUs: a slot may then belong to a sensor that was removed."""
        return self.enabled.get(sensor, 0) > imus

    def forget(self) -> None:
        self._instance_of.clear()

    def brought_into_use(self, names: Names, vector: Vector, boots: int) -> None:
        """Note that the firmware uses these offsets until a restart, because they were written with a large step."""
        self._in_use[names] = (boots, vector)

    def in_use(self, names: Names, vector: Vector, boots: int) -> bool:
        return self._in_use.get(names) == (boots, vector)

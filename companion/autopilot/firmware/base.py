"""Questions that a firmware answers.

A new firmware is a subclass of `Firmware` in a file of its own, and an entry in `firmwares.FIRMWARES`.

A plain `Firmware` is an autopilot that nobody has heard yet, `OtherFirmware` one that is not known here. Both answer
every question, with "no" or a reason in words; nothing is measured or written there.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, Final, Literal

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
    """One firmware. Whatever reads parameters raises AutopilotError where one cannot be read."""

    name: FirmwareName | None = None
    words = "autopilot"
    mav_autopilot: int | None = None

    # --- link and telemetry

    heartbeat_rate_hz: float | None = None  # to ask for on our own link; None: the firmware has a fixed one
    late_heartbeat_on_request = False
    integers_bytewise: bool | None = None  # integers travel as bytes in the float field; None: by AUTOPILOT_VERSION
    takes_nan_position = False
    imu_messages: Mapping[int, tuple[ImuMessage, ...]] = {}  # by IMU, the best first; new offsets show in the last
    tells_ekf_bias = False  # HIGHRES_IMU lacks the EKF's bias, and the console prints it
    estimator_message: type[Message] | None = None  # tells whether the yaw agrees with the magnetometer
    faster_log = ""

    def compass_ratio(self, message: Any) -> float:
        """Return innovation over gate of the compass, of an `estimator_message`; 0 where nothing is compared."""
        return 0.0

    # --- calibration of an IMU, and its write

    ranges: Mapping[str, Range] = {}  # of every parameter that a calibration or its undo ever writes
    rivals: tuple[Rival, ...] = ()
    parts: Mapping[tuple[int, int], Profile] = {}
    """Catalogue's names by the device types of gyro and accelerometer; the numbers are each firmware's own."""
    settle_s = 2.0  # time after a write in which the telemetry may still show the old offsets
    write_s = 5.0
    gyro_calibration_resets_ekf = False  # its own one; AHRS shows that bias
    ekf_reset_s = 0.0  # time for the EKF to show that it has settled after that calibration
    why_no_thermal_write: str | None = None  # None: curves are written into its temperature calibration
    level_turns_imus = False  # the level turns the IMUs' data, not only the attitude that is reported

    async def read_calibration(self, parameters: Parameters, instance: int, memory: SlotMemory) -> ImuCalibration:
        """Read what the autopilot corrects one of its IMUs (1 to 3) with; see `firmwares.read_calibration`."""
        raise AutopilotError(message("firmware_not_supported", what="calibration"))

    def stale_tilt_deg(self, changes: Sequence[Change]) -> float:
        """Return the tilt that the EKF may keep from before these changes until a restart; 0: none owes one."""
        return 0.0

    async def thermal_changes(
        self,
        parameters: Parameters,
        calibration: ImuCalibration,
        gyro: Polynomial,
        accel: Polynomial | None,
        degc: float,
    ) -> list[Change]:
        """Plan curves over temperature so that the output at this temperature stays as it is."""
        raise AutopilotError(self.why_no_thermal_write or message("firmware_not_supported", what="curves"))

    async def plan_level(
        self, parameters: Parameters, roll_rad: float, pitch_rad: float
    ) -> tuple[list[Change], Matrix]:
        """Plan the level of a board that sits so; also the turn of up in the vehicle's axes that it makes, (3, 3)."""
        raise AutopilotError(message("firmware_not_supported", what="level"))

    # --- heading from outside; `found`: values of `heading_names`

    heading_settings: tuple[HeadingSetting, ...] = ()
    heading_watched: tuple[str, ...] = ()  # further ones that decide what happens to our heading
    heading_risks: tuple[str, ...] = ()

    def heading_net(self, found: Mapping[str, float]) -> Net:
        return "none"

    def takes_only_our_heading(self, found: Mapping[str, float]) -> bool:
        return False

    def missing_compass(self, found: Mapping[str, float]) -> str | None:
        """Return the parameter that leaves it without a compass it needs, or None."""
        return None

    async def yaw_is_its_own(self, parameters: Parameters) -> bool:
        return True

    # --- arming

    gate_parameters: tuple[str, ...] = ()
    gate_is_script = False  # a script on the flight controller gates; it gets the verdict

    async def find_gate_problem(
        self, parameters: Parameters, system_id: int | None, script_starts_s: float
    ) -> str | None:
        """Return what has to be set so that the autopilot asks before it arms, for people; None: nothing.

        `script_starts_s`: time to wait for a script that does not run yet.
        """
        return message("no_arm_authorisation")

    # --- the port, and ground stations behind it

    def port_needs(self, baud: int) -> str | None:
        """Return the settings that the autopilot's end of a serial line needs; None: not known."""
        return None

    async def read_closed_links(self, parameters: Parameters) -> list[str]:
        return []

    def forwarding_words(self, closed: Sequence[str]) -> tuple[bool, str]:
        """Tell whether all is well while no ground station is heard, and the facts with the fix."""
        return True, message("no_ground_station_heard", why="none connected?")

    # --- follows from the answers above

    async def read_rivals(self, parameters: Parameters, seen: dict[str, int] | None = None) -> tuple[Rival, ...]:
        """Read the rivals that are switched on, and those that were and act until the next boot.

        `seen` is kept from one call to the next: the boot, as counted, in which each parameter was last seen on.
        """
        found: list[Rival] = []
        seen = {} if seen is None else seen
        boots = parameters.boots
        for rival in self.rivals:
            value = await parameters.read_integer(rival.parameter)
            if value:
                found.append(dataclasses.replace(rival, value=value))
                seen[rival.parameter] = boots
            elif rival.from_boot and seen.get(rival.parameter) == boots:
                found.append(rival)
        return tuple(found)

    def heading_names(self) -> list[str]:
        """List the parameters that the questions about the heading need.

        Raises:
            AutopilotError: no autopilot yet, or a firmware that is not known.
        """
        if self.name is None:
            raise AutopilotError(message("no_heartbeat_of_the_autopilot"))
        if not self.heading_settings:
            raise AutopilotError(message("firmware_not_supported", what="heading"))
        wanted = [name for one in self.heading_settings for name in (one.parameter, one.like) if name]
        return [*wanted, *self.heading_watched]

    def heading_changes(self, found: Mapping[str, float]) -> list[Change]:
        """Plan the changes that make the firmware use our heading; empty where all is set.

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
    """An autopilot that is neither of those that are known."""

    name = "other"


@dataclasses.dataclass(frozen=True, slots=True)
class HeadingSetting:
    """One parameter that the firmware needs to use our heading, and the reason.

    `bits`: those of `value` are to be set, others stay. `like`: another parameter whose value is wanted; `value` where
    that does not exist.
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


Net = Literal["script", "command", "autopilot", "none"]
"""Switch to another heading when ours ends, by whom; "autopilot": it does so by itself."""

NETS: Final[dict[Net, str]] = {
    "script": "if our heading ends in flight, the script goes on by gyros and GNSS within a second",
    "command": "if our heading ends, the companion asks for gyros and GNSS, but not if its board dies (companion lua)",
    "autopilot": "if our heading ends, the autopilot goes back to its magnetometer",
    "none": "if our heading ends there is none: fly only where you can land without one",
}

NO_IMU: Final = 0


class SlotMemory:
    """Facts that writes have shown: the IMU of each device; since a restart, offsets in use and rivals that act."""

    def __init__(self) -> None:
        self._instance_of: dict[tuple[Triad, int], int] = {}
        self.enabled: dict[Triad, int] = {}  # slots in use when a calibration was read last
        self._in_use: dict[Names, tuple[int, Vector]] = {}
        self.rivals: dict[str, int] = {}

    def learn(self, sensor: Triad, device_id: int, instance: int) -> None:
        """Note that the offsets in the slot of this device act on this IMU's telemetry (NO_IMU: on none)."""
        for other in [key for key, known in self._instance_of.items() if key[0] == sensor and known == instance]:
            if instance != NO_IMU:
                del self._instance_of[other]
        self._instance_of[sensor, device_id] = instance

    def known(self, sensor: Triad, device_id: int) -> int | None:
        """Return the IMU that a device was seen to be; NO_IMU: none in the telemetry."""
        return self._instance_of.get((sensor, device_id))

    def holds_strangers(self, sensor: Triad, imus: int) -> bool:
        """Check for more slots in use than IMUs: one of them may be of a sensor that is not there."""
        return self.enabled.get(sensor, 0) > imus

    def forget(self) -> None:
        self._instance_of.clear()

    def brought_into_use(self, names: Names, vector: Vector, boots: int) -> None:
        """Note that a vector of offsets was written by a far step, so that the firmware uses it until a restart."""
        self._in_use[names] = (boots, vector)

    def in_use(self, names: Names, vector: Vector, boots: int) -> bool:
        return self._in_use.get(names) == (boots, vector)

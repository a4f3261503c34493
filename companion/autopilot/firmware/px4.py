"""PX4's bias parameters: slots by device id, what R is made of, and what PX4 does with a value (autopilots 4).

    R = R(SENS_BOARD_X/Y/Z_OFF) R(SENS_BOARD_ROT)    of an internal sensor
    R = R(SENS_BOARD_X/Y/Z_OFF) R(CAL_*_ROT)         of an external one

so the level adjustment, unlike ArduPilot's trim, does turn IMU data. A thermal calibration (TC_*,
`px4_thermal`) takes its part off before the offsets and may be on or off.

The offsets of a sensor stand in the slot that holds its device id, CAL_GYROn_ID and CAL_ACCn_ID. SCALED_IMU, 2 and 3
show the first, second and third pair of a gyro and an accelerometer, in the order in which their drivers started, and
no message says which device id that is (autopilots 4.1, 4.5). PX4 itself prefers the slot of the same number, so the
order of the slots is a good guess; whether it was right shows only in the telemetry after a write. What was learned
that way is remembered here, by device id.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Final

import numpy as np

from companion.autopilot.firmware.imu_calibration import (
    ACCEL_SCALE_RANGE,
    FarStep,
    ImuCalibration,
    ImuParameters,
    read_rivals,
)
from companion.autopilot.parameters.change import Change
from companion.autopilot.parameters.reading import SCALES, Parameters, read_integer, read_vector
from companion.errors import AutopilotError
from companion.physics.frames import Matrix, rotation_matrix, vector
from companion.physics.units import MG
from companion.rotations import ROTATION_NAMES
from companion.samples import Triad, Vector

SLOTS: Final = 4
THERMAL_ENABLE: Final = "TC_G_ENABLE"
LEVEL: Final = ("SENS_BOARD_X_OFF", "SENS_BOARD_Y_OFF", "SENS_BOARD_Z_OFF")
NO_IMU: Final = 0
PREFIX: Final[dict[Triad, str]] = {"gyro": "CAL_GYRO", "accel": "CAL_ACC"}
WORDS: Final[dict[Triad, str]] = {"gyro": "gyro", "accel": "accelerometer"}


@dataclasses.dataclass(frozen=True, slots=True)
class Slot:
    """One slot that holds a device id."""

    number: int
    device_id: int
    enabled: bool


class SlotMemory:
    """Which device is which IMU; since the last restart: which offsets are in use, which rivals act."""

    def __init__(self) -> None:
        self._instance_of: dict[tuple[Triad, int], int] = {}
        self._enabled: dict[Triad, int] = {}
        self._in_use: dict[tuple[str, str, str], tuple[int, Vector]] = {}
        self.rivals: dict[str, int] = {}
        """As `read_rivals` keeps it."""

    def learn(self, sensor: Triad, device_id: int, instance: int) -> None:
        """The offsets in the slot of this device act on the telemetry of this IMU (NO_IMU: of none)."""
        for other in [key for key, known in self._instance_of.items() if key[0] == sensor and known == instance]:
            if instance != NO_IMU:
                del self._instance_of[other]
        self._instance_of[sensor, device_id] = instance

    def known(self, sensor: Triad, device_id: int) -> int | None:
        """The IMU that a device was seen to be; NO_IMU: none in the telemetry."""
        return self._instance_of.get((sensor, device_id))

    def holds_strangers(self, sensor: Triad, imus: int) -> bool:
        """Whether more slots are in use than there may be IMUs: then one may be of a sensor that is not there."""
        return self._enabled.get(sensor, 0) > imus

    def forget(self) -> None:
        """What was learned cannot be true."""
        self._instance_of.clear()

    def brought_into_use(self, names: tuple[str, str, str], vector: Vector, boots: int) -> None:
        """A vector of offsets was written in two steps, so that the firmware uses it, until a restart."""
        self._in_use[names] = (boots, vector)

    def in_use(self, names: tuple[str, str, str], vector: Vector, boots: int) -> bool:
        """Whether this very vector is known to be used."""
        return self._in_use.get(names) == (boots, vector)

    def choose(self, sensor: Triad, instance: int, slots: tuple[Slot, ...], like: int | None = None) -> Slot:
        """The slot to write for an IMU (1 to 3), of all that hold a device id: the known one, else the best guess.

        `like`: the device id of the IMU's other half; of a chip that is both, it is the same.

        Raises:
            AutopilotError: there is none.
        """
        prefix, word = PREFIX[sensor], WORDS[sensor]
        self._enabled[sensor] = sum(slot.enabled for slot in slots)
        if not slots:
            raise AutopilotError(
                f"PX4 has no {word} in {prefix}0_ID to {prefix}{SLOTS - 1}_ID: calibrate its {word}s once with the"
                " ground station, so that it knows them"
            )
        own = next((slot for slot in slots if self.known(sensor, slot.device_id) == instance), None)
        if own is None:
            free = [slot for slot in slots if self.known(sensor, slot.device_id) is None] or [
                slot for slot in slots if self.known(sensor, slot.device_id) == NO_IMU
            ]
            own = next((slot for slot in free if slot.device_id == like), None)
            if own is None and instance <= len(slots) and slots[instance - 1] in free:
                own = slots[instance - 1]
            if own is None and instance <= len(slots):
                own = next((slot for slot in free if slot.enabled), None)
        if own is None:
            raise AutopilotError(
                f"the autopilot has no IMU {instance}: only {len(slots)} of {prefix}0_ID to {prefix}{SLOTS - 1}_ID"
                f" hold a {word}"
            )
        if not own.enabled:
            raise AutopilotError(f"IMU {instance}: {prefix}{own.number}_PRIO = 0, so PX4 has this {word} switched off")
        return own


IGNORED_STEP: Final = 0.01
"""A vector of offsets no farther than this (rad/s, m/s^2) from the one in use is ignored (autopilots 4.2), and one of
scales likewise: `set_scale` of src/lib/sensor_calibration/Accelerometer.cpp. After a start 1 is in use."""

MARGIN: Final = 1.05
"""Both sides round to 32 bits."""

FAR_GYRO_RAD_S: Final = 0.022
"""1.3 deg/s: more than twice `IGNORED_STEP`, and 22 digits of SCALED_IMU."""
FAR_ACCEL_M_S2: Final = 0.09
"""9 digits of SCALED_IMU (9.2 mg): the least that `parameters.verify` can tell from no step."""
FAR_SCALE: Final = 0.022

SIMULATED_GYRO_GRID_RAD_S: Final = math.radians(2000.0 / 32768.0) / 4.0
SIMULATED_ACCEL_GRID_M_S2: Final = 1e3 * MG / 2048.0 / 4.0
"""PX4's simulator passes one of its IMUs through 16 bits, and telemetry is the mean of three such readings with weights
1, 2, 1: the floats of its HIGHRES_IMU are a quarter of a step apart. A real sensor's telemetry is the mean of many
readings with noise of their own: no steps are left there."""

_INTERNAL: Final = -1
_SIMULATION_BUS: Final = 4
_MAYBE_INTERNAL_BUSES: Final = (1, 2)
"""I2C and SPI; whether such a sensor is inside the autopilot is a fact of the board. PX4 keeps it in CAL_*_ROT."""

# Of number 38 both firmwares' drivers know better angles, but PX4 turns calibrated data by these.
_PX4_ONLY_DEG: Final = {38: (90.0, 68.0, 293.0)}


def parameters_of(gyro_slot: int, accel_slot: int) -> ImuParameters:
    """The names of one IMU's parameters; its gyro and its accelerometer may stand in slots of different numbers."""
    gyro, accel = f"{PREFIX['gyro']}{gyro_slot}", f"{PREFIX['accel']}{accel_slot}"
    return ImuParameters(
        gyro_offset=(f"{gyro}_XOFF", f"{gyro}_YOFF", f"{gyro}_ZOFF"),
        accel_offset=(f"{accel}_XOFF", f"{accel}_YOFF", f"{accel}_ZOFF"),
        accel_scale=(f"{accel}_XSCALE", f"{accel}_YSCALE", f"{accel}_ZSCALE"),
        gyro_id=f"{gyro}_ID",
        accel_id=f"{accel}_ID",
    )


def thermal_names(sensor: int) -> tuple[str, ...]:
    """Of one gyro's thermal compensation: ID, TREF, TMIN, TMAX; then the coefficients, the constants first, by axis."""
    own = f"TC_G{sensor}_"
    head = (f"{own}ID", f"{own}TREF", f"{own}TMIN", f"{own}TMAX")
    return (*head, *(f"{own}X{power}_{axis}" for power in range(4) for axis in range(3)))


async def read_slots(parameters: Parameters, sensor: Triad) -> tuple[Slot, ...]:
    """All slots that hold a device id, in order.

    Raises:
        AutopilotError: as `Parameters.read_optional`.
    """
    found: list[Slot] = []
    for number in range(SLOTS):
        device_id = await read_integer(parameters, f"{PREFIX[sensor]}{number}_ID")
        if device_id:
            priority = await read_integer(parameters, f"{PREFIX[sensor]}{number}_PRIO")
            found.append(Slot(number, device_id, enabled=priority != 0))
    return tuple(found)


async def read_calibration(parameters: Parameters, instance: int, memory: SlotMemory) -> ImuCalibration:
    """Read afresh what PX4 corrects one of its IMUs with.

    Raises:
        AutopilotError: no slot for such an IMU, or it is switched off, or a value that cannot be worked with; or no
            answer (ParameterTimeoutError).
    """
    boots = parameters.vehicle.boots
    accel = memory.choose("accel", instance, await read_slots(parameters, "accel"))
    gyro = memory.choose("gyro", instance, await read_slots(parameters, "gyro"), like=accel.device_id)
    names = parameters_of(gyro.number, accel.number)
    offset = await read_vector(parameters, names.accel_offset)
    small = too_small_to_apply_at_boot(offset)
    orientation = await _read_rotation(parameters, gyro, accel)
    calibration = ImuCalibration(
        instance=instance,
        parameters=names,
        gyro_offset_rad_s=await read_vector(parameters, names.gyro_offset),
        accel_offset_m_s2=offset,
        accel_scale=await read_vector(parameters, names.accel_scale, *SCALES),
        gyro_id=gyro.device_id,
        accel_id=accel.device_id,
        orientation=orientation,
        far_step=_far_step(orientation),
        gyro_grid_rad_s=SIMULATED_GYRO_GRID_RAD_S if _bus(gyro) == _SIMULATION_BUS else 0.0,
        accel_grid_m_s2=SIMULATED_ACCEL_GRID_M_S2 if _bus(accel) == _SIMULATION_BUS else 0.0,
        scale_unused_within=MARGIN * IGNORED_STEP,
        accel_offset_may_be_unused=small and not memory.in_use(names.accel_offset, offset, boots),
        rivals=await read_rivals(parameters, memory.rivals),
    )
    return dataclasses.replace(calibration, warnings=_warnings(calibration))


def too_small_to_apply_at_boot(accel_offset_m_s2: Vector) -> bool:
    """Whether PX4 will start without this vector: it compares with zero then, and small differences are ignored."""
    return 0.0 < math.hypot(*accel_offset_m_s2) <= MARGIN * IGNORED_STEP


def stale_tilt_deg(changes: Sequence[Change]) -> float:
    """How far EKF2's tilt may be off until a restart: it learns the step of an accelerometer very slowly; 0 without."""
    step: dict[str, float] = {}
    for change in changes:
        if change.parameter.startswith(PREFIX["accel"]):
            slot = change.parameter.partition("_")[2].partition("_")[0]
            step[slot] = math.hypot(step.get(slot, 0.0), change.after - change.before)
    return math.degrees(max(step.values(), default=0.0) / (1e3 * MG))


def accel_offset_with(calibration: ImuCalibration, changes: Sequence[Change]) -> Vector:
    """The accelerometer offsets after these changes."""
    after = {change.parameter: change.after for change in changes}
    names, before = calibration.parameters.accel_offset, calibration.accel_offset_m_s2
    x, y, z = (after.get(name, old) for name, old in zip(names, before, strict=True))
    return x, y, z


def warnings_about(calibration: ImuCalibration, changes: Sequence[Change]) -> tuple[str, ...]:
    """What PX4 makes of these changes later, for people."""
    after = accel_offset_with(calibration, changes)
    if calibration.far_step is None or not too_small_to_apply_at_boot(after):  # None: not PX4
        return ()
    size = f"{calibration.parameters.accel_offset[0]}, Y and Z are {math.hypot(*after) / MG:.2f} mg in all"
    return (f"{size}: below 1 mg (0.01 m/s^2) PX4 starts without them; calibrate again after a restart",)


async def _read_rotation(parameters: Parameters, gyro: Slot, accel: Slot) -> Matrix:
    level = rotation_matrix(await read_level(parameters))
    gyro_mounting = await _read_mounting(parameters, "gyro", gyro)
    accel_mounting = await _read_mounting(parameters, "accel", accel)
    if not np.array_equal(gyro_mounting, accel_mounting):
        raise AutopilotError(
            f"{PREFIX['gyro']}{gyro.number}_ROT and {PREFIX['accel']}{accel.number}_ROT mount the two halves of one IMU"
            " differently; set both as it is mounted"
        )
    matrix: Matrix = level @ accel_mounting
    return matrix


def _bus(slot: Slot) -> int:
    return slot.device_id & 0b111


async def read_level(parameters: Parameters) -> Vector:
    """The level adjustment: degrees of roll, pitch, yaw.

    Raises:
        AutopilotError: as `Parameters.read`, or no angles.
    """
    x, y, z = [await parameters.read(name) for name in LEVEL]
    for name, angle_deg in zip(LEVEL, (x, y, z), strict=True):
        if not math.isfinite(angle_deg):
            raise AutopilotError(f"{name} is {angle_deg}; an angle was expected")
    return x, y, z


async def _read_mounting(parameters: Parameters, sensor: Triad, slot: Slot) -> Matrix:
    """How a sensor is mounted on the vehicle, level adjustment apart."""
    own = await read_integer(parameters, f"{PREFIX[sensor]}{slot.number}_ROT")
    bus = _bus(slot)
    internal = bus == _SIMULATION_BUS or (bus in _MAYBE_INTERNAL_BUSES and own in (_INTERNAL, None))
    number = await read_integer(parameters, "SENS_BOARD_ROT") if internal else own
    # PX4 takes a number that it does not know for no rotation.
    if number is None or not 0 <= number < len(ROTATION_NAMES):
        number = 0
    return rotation_matrix(_PX4_ONLY_DEG.get(number) or ROTATION_NAMES[number])


def _warnings(calibration: ImuCalibration) -> tuple[str, ...]:
    found = [rival.words for rival in calibration.rivals]
    low, high = ACCEL_SCALE_RANGE
    if not all(low <= scale <= high for scale in calibration.accel_scale):
        name = calibration.parameters.accel_scale[0]
        found.append(f"{name}, Y or Z is outside {low} to {high}: the scale calibration looks wrong")
    return tuple(found)


def _far_step(orientation: Matrix) -> FarStep:
    vertical = np.zeros(3)
    vertical[np.abs(orientation[2]).argmax()] = 1.0
    return FarStep(
        gyro_rad_s=vector(FAR_GYRO_RAD_S * vertical),
        accel_m_s2=vector(FAR_ACCEL_M_S2 * vertical),
        scale=vector(FAR_SCALE * vertical),
    )

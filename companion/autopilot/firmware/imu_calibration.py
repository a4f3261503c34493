"""Corrections that an autopilot applies to one IMU, and the algebra of its offsets, common to all firmwares.

Firmware computes samples with R, the rotation from IMU to vehicle axes (docs/reference/autopilots 1.2, 4.1):

    gyro  = R (raw - gyro_offset)
    accel = R diag(accel_scale) (raw - accel_offset)

Offsets are therefore in the IMU's own axes, before scale and rotation. An active temperature calibration (`Thermal`)
corrects `raw` first. Parameter names, R and the use of a value are specific to each firmware.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from companion.autopilot.parameters.change import SCALES, Change, Names, float32, same_float32
from companion.errors import CalibrationRefusedError
from companion.estimation.solution.curve import NOTHING, Polynomial
from companion.messages import message
from companion.physics.frames import Array, Matrix, vector
from companion.physics.units import DEG, MG
from companion.samples import Triad, Vector

ANY_TIME: Final = "the autopilot may measure the gyros at any time and overwrite these gyro offsets"


@dataclasses.dataclass(frozen=True, slots=True)
class Rival:
    """Parameter that makes the autopilot overwrite our gyro offsets, unless the parameter is 0.

    `at_start`: overwrites only at a start of the autopilot. `from_boot`: read only at a boot, so switching it off has
    no effect before the next boot. `value`: as read; 0: switched off, but active until the next boot. `accelerometers`:
    also overwrites accelerometer offsets. `known`: the only value that `what` describes; None: all values.
    """

    parameter: str
    what: str
    at_start: bool = False
    accelerometers: bool = False
    from_boot: bool = False
    known: int | None = None
    value: int = 0

    def active(self, value: int) -> Rival:
        """Return this rival as read; a value of a later firmware may overwrite the offsets at any time."""
        what = self.what if self.known in (None, value) else ANY_TIME
        return dataclasses.replace(self, what=what, value=value)

    @property
    def words(self) -> str:
        if self.until_boot:
            return message("overwrites_offsets_until_reboot", parameter=self.parameter, what=self.what)
        return message("autopilot_overwrites_offsets", parameter=self.parameter, value=self.value, what=self.what)

    @property
    def name(self) -> str:
        return f"{self.parameter}={self.value}" if self.value else f"{self.parameter} (on until reboot)"

    @property
    def until_boot(self) -> bool:
        return self.value == 0


def stop(rivals: Sequence[Rival]) -> list[Change]:
    return [Change(rival.parameter, rival.value, 0.0) for rival in rivals if not rival.until_boot]


MAX_GYRO_RESIDUAL_RAD_S: Final = 5.0 * DEG
"""Largest gyro residual accepted as a bias; more means a moving aircraft or a broken sensor. ArduPilot regards 5 deg/s
between two gyros as a fault ("Gyros inconsistent"), and current MEMS gyros start within 1 deg/s."""

MAX_ACCEL_RESIDUAL_M_S2: Final = 1.0
"""Largest accelerometer residual accepted as a bias. The worst accelerometers in use are specified at 80 mg (0.8 m/s^2,
MPU-6000, vertical axis). ArduPilot refuses to arm if two differ by 0.75 m/s^2. A wrong mounting, or a wrong setting of
a tilt sensor, soon exceeds the limit."""

MAX_GYRO_OFFSET_RAD_S: Final = 20.0 * DEG  # the loosest zero-rate specification of gyros in use (MPU-6000)

MAX_ACCEL_OFFSET_M_S2: Final = 3.5  # documented range of ArduPilot's INS_ACCOFFS, which ArduPilot does not enforce

ACCEL_SCALE_RANGE: Final = (0.8, 1.2)  # documented range of ArduPilot's INS_ACCSCAL, which ArduPilot does not enforce

FAR_GYRO_RAD_S: Final = 0.022
"""Step that makes PX4 use new gyro offsets, 1.3 deg/s: over twice what PX4 ignores, 22 times SCALED_IMU's resolution.

PX4 ignores a vector that differs by at most 0.01 (rad/s, m/s^2) from the one in use (docs/reference/autopilots 4.2).
PX4 may read the parameters between any two writes, so the value in use may differ by 0.01 from the stored one. A step
of more than 0.02 on one axis makes PX4 use the whole vector. The chosen axis is the one nearest to the vehicle's
vertical: a wrong value there turns the heading, but does not tilt.
"""
FAR_ACCEL_M_S2: Final = 0.09  # 9 digits of SCALED_IMU: the least step that `parameters.verify` can detect
FAR_SCALE: Final = 0.022

NOT_ZERO_M_S2: Final = 1e-6  # replaces one of three zeros, which mean "not calibrated": ArduPilot would not arm

_AXES: Final = "XYZ"


@dataclasses.dataclass(frozen=True, slots=True)
class Range:
    """Allowed values of one parameter, both ends included."""

    low: float
    high: float
    whole: bool = False
    unit: str = ""

    def holds(self, value: float) -> bool:
        return self.low <= value <= self.high and not (self.whole and value != int(value))

    def __str__(self) -> str:
        kind = "whole numbers " if self.whole else ""
        return f"{kind}{self.low:.3g} to {self.high:.3g}{self.unit and f' {self.unit}'}"


# The ranges include any value that an autopilot may have had before, as an undo restores it, but no nonsense.
_GYRO_RAD_S: Final = MAX_GYRO_OFFSET_RAD_S + MAX_GYRO_RESIDUAL_RAD_S + 0.05
"""Largest gyro offset from which one calibration reaches a plausible offset, plus the step to an intermediate value."""
_ACCEL_M_S2: Final = MAX_ACCEL_OFFSET_M_S2 + MAX_ACCEL_RESIDUAL_M_S2 + 0.4
GYRO_OFFSET: Final = Range(-_GYRO_RAD_S, _GYRO_RAD_S, unit="rad/s")
ACCEL_OFFSET: Final = Range(-_ACCEL_M_S2, _ACCEL_M_S2, unit="m/s^2")
ACCEL_SCALE: Final = Range(*SCALES)
HOVER_BIAS: Final = Range(-_ACCEL_M_S2, _ACCEL_M_S2, unit="m/s^2")
DEGC_RANGE: Final = Range(-300.0, 400.0, unit="deg C")  # -300: unknown; 400 admits a thermometer in kelvin
DEVICE_ID_RANGE: Final = Range(0.0, 2.0**24, whole=True)
SWITCH_RANGE: Final = Range(0.0, 255.0, whole=True)


@dataclasses.dataclass(kw_only=True)
class ImuParameters:
    """Names of the parameters that correct one IMU: X, Y, Z in rad/s and m/s^2, and device ids (0: no device)."""

    gyro_offset: Names
    accel_offset: Names
    accel_scale: Names
    gyro_id: str
    accel_id: str
    hover_bias: str = ""
    """Bias of the vertical accelerometer that the firmware learns in hover, m/s^2, vehicle axes; empty: none."""


def offset_ranges(names: ImuParameters) -> dict[str, Range]:
    return {
        **dict.fromkeys(names.gyro_offset, GYRO_OFFSET),
        **dict.fromkeys(names.accel_offset, ACCEL_OFFSET),
        **dict.fromkeys(names.accel_scale, ACCEL_SCALE),
    }


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Thermal:
    """Temperature calibration of one IMU: curves that the firmware subtracts from its readings, in the IMU's axes."""

    enabled_by: str = ""  # parameter that has switched it on; empty: not active
    values: Mapping[str, float] = dataclasses.field(default_factory=dict)
    gyro: Polynomial = NOTHING
    accel: Polynomial = NOTHING

    def taken_off(self, degc: float | None) -> tuple[Array, Array]:
        """Return the corrections of gyro and accelerometer, (3,) each, rad/s and m/s^2; zero if `degc` is unknown."""
        return (np.zeros(3), np.zeros(3)) if degc is None else (self.gyro.at(degc), self.accel.at(degc))


@dataclasses.dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class ImuCalibration:
    """Corrections that the autopilot applies to one IMU, as read from its parameters."""

    instance: int  # 1 to 3: the IMU whose telemetry they affect
    parameters: ImuParameters
    gyro_offset_rad_s: Vector
    accel_offset_m_s2: Vector
    accel_scale: Vector
    gyro_id: int | None
    accel_id: int | None
    orientation: Matrix  # 3x3, the IMU's axes to the vehicle's FRD: R
    thermal: Thermal = Thermal()
    zero_is_uncalibrated: bool = False  # three accelerometer offsets of exactly zero mean "not calibrated"
    far_axis: int | None = None  # axis with an intermediate value, so that small changes are used; None: not needed
    scale_unused_within: float = 0.0  # after a start, the firmware does not use scales within this distance of 1
    accel_offset_may_be_unused: bool = False  # the firmware may use other offsets than its parameters hold
    rivals: tuple[Rival, ...] = ()
    warnings: tuple[str, ...] = ()

    @property
    def offsets(self) -> dict[str, float]:
        names = self.parameters
        return {
            **dict(zip(names.gyro_offset, self.gyro_offset_rad_s, strict=True)),
            **dict(zip(names.accel_offset, self.accel_offset_m_s2, strict=True)),
        }

    @property
    def corrections(self) -> dict[str, float]:
        return {**self.offsets, **dict(zip(self.parameters.accel_scale, self.accel_scale, strict=True))}

    def in_use(self, accel_scale: Vector | None = None) -> Array:
        """Return the scales, (3,), that the firmware uses if `accel_scale` (default: as read) is in its parameters."""
        scale = np.asarray(self.accel_scale if accel_scale is None else accel_scale, dtype=np.float64)
        return np.ones(3) if np.linalg.norm(scale - 1.0) <= self.scale_unused_within else scale

    def output(self, gyro_rad_s: Vector, accel_m_s2: Vector, degc: float | None) -> Array:
        """Convert a raw reading to the firmware's output, (6,), rad/s and m/s^2; both are in vehicle FRD."""
        rotation, (thermal_gyro, thermal_accel) = self.orientation, self.thermal.taken_off(degc)
        gyro = np.asarray(gyro_rad_s) - rotation @ (thermal_gyro + self.gyro_offset_rad_s)
        board = rotation.T @ np.asarray(accel_m_s2) - thermal_accel - self.accel_offset_m_s2
        return np.concatenate((gyro, rotation @ (self.in_use() * board)))

    def subtracted(self, degc: float | None) -> Array:
        """Return the bias that offsets and temperature calibration remove from the output, (6,), vehicle FRD.

        Formulas: R (gyro_offset + gyro_thermal) and R diag(accel_scale) (accel_offset + accel_thermal) at `degc`.
        """
        rotation, (gyro, accel) = self.orientation, self.thermal.taken_off(degc)
        force = np.asarray(self.accel_scale) * (accel + self.accel_offset_m_s2)
        return np.concatenate((rotation @ (gyro + self.gyro_offset_rad_s), rotation @ force))

    def thermal_change(self, triad: Triad, degc: float, then_degc: float) -> Array:
        """Return the change of a triad's temperature correction from `degc` to `then_degc`, (3,), vehicle FRD."""
        half = 0 if triad == "gyro" else 1
        change = self.thermal.taken_off(then_degc)[half] - self.thermal.taken_off(degc)[half]
        return self.orientation @ (change if triad == "gyro" else np.asarray(self.accel_scale) * change)

    def corrects_like(self, other: ImuCalibration) -> bool:
        return (
            self.corrections == other.corrections
            and self.thermal == other.thermal
            and (self.gyro_id, self.accel_id) == (other.gyro_id, other.accel_id)
            and np.array_equal(self.orientation, other.orientation)
        )

    def contradicts(self, values: Mapping[str, float]) -> bool:
        known = {**self.corrections, **self.thermal.values}
        return any(name in known and not same_float32(known[name], value) for name, value in values.items())


def gyro_offset_after(calibration: ImuCalibration, residual_rad_s: Vector) -> Vector:
    """Return the offset that removes a residual (output - true value, FRD): gyro_offset + R^-1 residual, float32."""
    _require_plausible(calibration, "gyro residual", residual_rad_s, MAX_GYRO_RESIDUAL_RAD_S)
    step = calibration.orientation.T @ np.asarray(residual_rad_s)
    after = _vector(np.asarray(calibration.gyro_offset_rad_s) + step)
    _require_plausible(calibration, "gyro offset", after, MAX_GYRO_OFFSET_RAD_S)
    return after


def accel_offset_after(calibration: ImuCalibration, residual_m_s2: Vector) -> Vector:
    """Return accel_offset + diag(1/accel_scale) R^-1 residual, float32; not 0, 0, 0 if that means "uncalibrated"."""
    _require_plausible(calibration, "accelerometer residual", residual_m_s2, MAX_ACCEL_RESIDUAL_M_S2)
    step = (calibration.orientation.T @ np.asarray(residual_m_s2)) / np.asarray(calibration.accel_scale)
    after = _vector(np.asarray(calibration.accel_offset_m_s2) + step)
    _require_plausible(calibration, "accelerometer offset", after, MAX_ACCEL_OFFSET_M_S2)
    if calibration.zero_is_uncalibrated and not any(after):
        return float32(NOT_ZERO_M_S2), 0.0, 0.0
    return after


def changes_for(
    calibration: ImuCalibration, gyro_residual_rad_s: Vector | None, accel_residual_m_s2: Vector | None
) -> list[Change]:
    """Plan new offsets, accelerometers first (docs/reference/autopilots 9.3); a residual of None leaves its offsets.

    Raises:
        CalibrationRefusedError: a value beyond the limits at the top of this file.
    """
    names, axis = calibration.parameters, calibration.far_axis
    changes: list[Change] = []
    if accel_residual_m_s2 is not None:
        after = accel_offset_after(calibration, accel_residual_m_s2)
        changes += vector_changes(names.accel_offset, calibration.accel_offset_m_s2, after, axis, FAR_ACCEL_M_S2)
    if gyro_residual_rad_s is not None:
        after = gyro_offset_after(calibration, gyro_residual_rad_s)
        changes += vector_changes(names.gyro_offset, calibration.gyro_offset_rad_s, after, axis, FAR_GYRO_RAD_S)
    return changes


def vector_changes(
    names: Names, before: Vector, after: Vector, far_axis: int | None = None, step: float = 0.0
) -> list[Change]:
    """Plan the changes of one vector; axis `far_axis` first goes to `step` above the larger of old and new value."""
    vias = [
        max(b, a) + step if axis == far_axis else None for axis, (b, a) in enumerate(zip(before, after, strict=True))
    ]
    return list(map(Change, names, before, after, vias))


def whole_accelerometer(calibration: ImuCalibration, bias_m_s2: Vector, scale: Vector) -> list[Change]:
    """Plan accelerometer offsets and scales that remove a bias and a scale error, both in the IMU's axes.

    If the output is (1 + scale) true value + bias, new offsets are offset + bias / accel_scale, and new scales are
    accel_scale / (1 + scale). If the firmware would not use the new scales after a start, they become 1, with offsets
    right for a level aircraft.

    Raises:
        CalibrationRefusedError: a value beyond the limits at the top of this file.
    """
    names, before = calibration.parameters, calibration.in_use()
    right = before / (1.0 + np.asarray(scale))
    after = _vector(calibration.in_use(_vector(right)))
    level = calibration.orientation.T @ (0.0, 0.0, -1e3 * MG)
    left = level * (1.0 / right - 1.0 / np.asarray(after)) if calibration.scale_unused_within else np.zeros(3)
    offset = _vector(np.asarray(calibration.accel_offset_m_s2) + np.asarray(bias_m_s2) / before + left)
    _require_plausible(calibration, "accelerometer offset", offset, MAX_ACCEL_OFFSET_M_S2)
    low, high = ACCEL_SCALE_RANGE
    for axis, value in zip(_AXES, after, strict=True):
        if not low <= value <= high:
            raise _implausible(calibration, f"accelerometer scale {axis}", f"{value:.3g}", f"{low} to {high}")
    far_axis = calibration.far_axis
    changes = vector_changes(names.accel_offset, calibration.accel_offset_m_s2, offset, far_axis, FAR_ACCEL_M_S2)
    if not calibration.scale_unused_within or after != calibration.accel_scale:
        changes += vector_changes(names.accel_scale, calibration.accel_scale, after, far_axis, FAR_SCALE)
    return changes


def hover_bias_changes(
    calibration: ImuCalibration, changes: Sequence[Change], learned_m_s2: Mapping[str, float]
) -> list[Change]:
    """Plan a hover bias that leaves the vertical force in flight, output - hover bias, unchanged by `changes`.

    The learned bias includes what the old offsets left: with new offsets, this would be subtracted twice.
    """
    name, (_, _, step) = calibration.parameters.hover_bias, output_step(calibration, changes, (0.0, 0.0, -1e3 * MG))[1]
    before = learned_m_s2.get(name, 0.0)
    return [Change(name, before, before + step)] if before and step and HOVER_BIAS.holds(before) else []


def output_step(
    calibration: ImuCalibration, changes: Sequence[Change], accel_m_s2: Vector = (0.0, 0.0, 0.0)
) -> tuple[Vector, Vector]:
    """Return the step of the IMU's output that the changes must cause: rad/s and m/s^2, vehicle FRD.

    `accel_m_s2`: accelerometer output before the changes; a change of scale multiplies this output.
    """
    names = calibration.parameters
    by_name = {change.parameter: change.after - change.before for change in changes}
    gyro, accel, stretch = (
        np.array([by_name.get(name, 0.0) for name in each])
        for each in (names.gyro_offset, names.accel_offset, names.accel_scale)
    )
    rotation, before = calibration.orientation, calibration.in_use()
    after = calibration.in_use(vector(calibration.accel_scale + stretch)) if stretch.any() else before
    unscaled = rotation.T @ np.asarray(accel_m_s2) / before
    return vector(-rotation @ gyro), vector(rotation @ ((after - before) * unscaled - after * accel))


def _require_plausible(calibration: ImuCalibration, what: str, vector: Vector, limit: float) -> None:
    unit, words = (DEG, "deg/s") if "gyro" in what else (1.0, "m/s^2")
    for axis, value in zip(_AXES, vector, strict=True):
        if not abs(value) <= limit:  # this form also rejects NaN
            raise _implausible(calibration, f"{what} {axis}", f"{value / unit:.3g} {words}", f"{limit / unit:.3g}")


def _implausible(calibration: ImuCalibration, what: str, value: str, allowed: str) -> CalibrationRefusedError:
    words = message("result_not_plausible", imu=calibration.instance, what=what, value=value, allowed=allowed)
    return CalibrationRefusedError(words)


def _vector(values: Array) -> Vector:
    x, y, z = (float32(float(value)) for value in values)
    return x, y, z

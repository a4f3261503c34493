"""ArduPilot's temperature calibration, INS_TCALn_* (AP_InertialSensor_tempcal.cpp, autopilots 10.1).

In the IMU's axes, with d the temperature less 35 degC, both of them held between TMIN and TMAX:

    raw - (P(d) - P(d at CALTEMP)) - offset,    P(d) = (c1 d + c2 d^2 + c3 d^3) 1e-6

So a curve, CALTEMP and the offset belong together. It is looked at with every sample; only learning (ENABLE = 2) waits
for a boot. Gyros and accelerometers have coefficients and a CALTEMP each, but one ENABLE, TMIN and TMAX.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Final

import numpy as np

from companion.autopilot.firmware.imu_calibration import ImuCalibration, Thermal, vector_changes
from companion.autopilot.parameters.change import Change
from companion.autopilot.parameters.reading import Parameters, read_integer
from companion.errors import AutopilotError
from companion.estimation.temperature.polynomial import ZERO, Polynomial
from companion.physics.frames import vector
from companion.samples import Vector

Names = tuple[str, str, str]
REFERENCE_DEGC: Final = 35.0
_UNIT: Final = 1e-6
_ON: Final = 1
_LEARNING: Final = 2


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class TcalParameters:
    """The names of one IMU's."""

    enable: str
    """0 off, 1 on, 2 learning."""
    low: str
    high: str
    gyro: tuple[Names, Names, Names]
    """By power of the temperature."""
    accel: tuple[Names, Names, Names]
    gyro_caltemp: str
    """Temperature at which nothing is taken off, deg C; -300: unknown, which is held at TMIN."""
    accel_caltemp: str

    @property
    def deciding(self) -> tuple[str, ...]:
        """All but the CALTEMPs, which the firmware's own calibrations set."""
        coefficients = (name for names in (*self.accel, *self.gyro) for name in names)
        return (self.low, self.high, *coefficients, self.enable)


def names_of(instance: int) -> TcalParameters:
    """Of one of the instances, which are regular up to 3, and from 4 on otherwise."""
    tcal = f"INS{instance}_TCAL_" if instance > 3 else f"INS_TCAL{instance}_"
    caltemp = f"INS{instance}_{{}}_CALTEMP" if instance > 3 else f"INS_{{}}{instance}_CALTEMP"

    def coefficients(triad: str) -> tuple[Names, Names, Names]:
        one, two, three = ((f"{tcal}{triad}{n}_X", f"{tcal}{triad}{n}_Y", f"{tcal}{triad}{n}_Z") for n in (1, 2, 3))
        return one, two, three

    return TcalParameters(
        enable=f"{tcal}ENABLE",
        low=f"{tcal}TMIN",
        high=f"{tcal}TMAX",
        gyro=coefficients("GYR"),
        accel=coefficients("ACC"),
        gyro_caltemp=caltemp.format("GYR"),
        accel_caltemp=caltemp.format("ACC"),
    )


async def read_thermal(parameters: Parameters, instance: int) -> Thermal:
    """Read afresh what it takes off; nothing where it is switched off, or not in the firmware.

    Raises:
        AutopilotError: it is learning, or as `Parameters.read`.
    """
    names = names_of(instance)
    enable = await read_integer(parameters, names.enable)
    if enable is None:
        return Thermal()
    if enable == _LEARNING:
        raise AutopilotError(
            f"{names.enable} = 2: IMU {instance} is learning its temperature calibration;"
            " let it finish, or set it to 0 or 1"
        )
    if enable != _ON:
        return Thermal(values={names.enable: float(enable)})
    found = await parameters.read_many((*names.deciding, names.gyro_caltemp, names.accel_caltemp))
    return Thermal(
        enabled_by=names.enable,
        values={name: found[name] for name in names.deciding},
        gyro=_polynomial(found, names, names.gyro).zero_at(found[names.gyro_caltemp]),
        accel=_polynomial(found, names, names.accel).zero_at(found[names.accel_caltemp]),
    )


def _polynomial(
    found: Mapping[str, float], names: TcalParameters, coefficients: tuple[Names, Names, Names]
) -> Polynomial:
    one, two, three = (vector(np.array([found[name] for name in each]) * _UNIT) for each in coefficients)
    return Polynomial(
        coefficients=(ZERO, one, two, three),
        reference_degc=REFERENCE_DEGC,
        low_degc=found[names.low],
        high_degc=found[names.high],
    )


async def thermal_changes(
    parameters: Parameters, calibration: ImuCalibration, gyro: Polynomial, accel: Polynomial | None, degc: float
) -> list[Change]:
    """What to write so that curves are in force and the output at this temperature stays as it is.

    The offsets belong to this temperature from then on. Where none of the accelerometers is given, one that is in force
    stays, held at the ends of the new span; one that is not is cleared, for it would come into force with the gyros'.

    Args:
        parameters: of the autopilot.
        calibration: in force.
        gyro: in the IMU's axes, about 35 degC.
        accel: likewise, before its scale; None: not known.
        degc: of the IMU now.

    Raises:
        AutopilotError: this firmware has none, or as `Parameters.read`.
    """
    assert gyro.reference_degc == REFERENCE_DEGC
    names, thermal, own = names_of(calibration.instance), calibration.thermal, calibration.parameters
    if not thermal.values:
        raise AutopilotError(
            f"{names.enable} does not exist: this firmware has no temperature calibration (boards of 1 MB have none)"
        )
    acts = accel is not None or any(map(any, thermal.accel.coefficients))
    caltemps = [names.gyro_caltemp, *([names.accel_caltemp] if acts else [])]
    before = await parameters.read_many((*names.deciding, *caltemps))
    wanted = {name: before[name] if thermal.enabled_by else 0.0 for each in names.accel for name in each}
    for of, curve in ((names.gyro, gyro), *(((names.accel, accel),) if accel is not None else ())):
        for each, values in zip(of, curve.coefficients[1:], strict=True):
            wanted |= zip(each, (value / _UNIT for value in values), strict=True)
    wanted |= {names.low: gyro.low_degc, names.high: gyro.high_degc, names.enable: float(_ON)}
    wanted |= dict.fromkeys(caltemps, degc)
    taken_gyro, taken_accel = thermal.taken_off(degc)
    changes = [
        *_moved(own.accel_offset, calibration.accel_offset_m_s2, vector(taken_accel)),
        *_moved(own.gyro_offset, calibration.gyro_offset_rad_s, vector(taken_gyro)),
        # The switch comes last, and is put back first.
        *(Change(name, before[name], wanted[name]) for name in (*caltemps, *names.deciding)),
    ]
    return [change for change in changes if change.before != change.after]


def _moved(names: Names, offset: Vector, by: Vector) -> list[Change]:
    return vector_changes(names, offset, vector(np.add(offset, by)), None)

"""ArduPilot's parameters of each IMU, and its calibration over temperature.

INS_TCALn_* (AP_InertialSensor_tempcal.cpp, autopilots 10.1) takes this off a reading, in the IMU's axes, with d the
temperature less 35 degC, both held between TMIN and TMAX:

    raw - (P(d) - P(d at CALTEMP)) - offset,    P(d) = (c1 d + c2 d^2 + c3 d^3) 1e-6

so a curve, CALTEMP and the offset belong together. Gyros and accelerometers have coefficients and a CALTEMP each, but
one ENABLE, TMIN and TMAX.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from companion.autopilot.firmware.imu_calibration import ImuCalibration, ImuParameters, Thermal, vector_changes
from companion.autopilot.parameters.change import Change, Parameters
from companion.errors import AutopilotError
from companion.estimation.temperature.curve import ZERO, Polynomial
from companion.physics.frames import vector
from companion.samples import Vector

INSTANCES: Final = (1, 2, 3, 4, 5)
"""4 and 5 exist from 4.4 on boards with auxiliary instances; no message carries them, so none can be measured."""

REFERENCE_DEGC: Final = 35.0
_UNIT: Final = 1e-6
_ON: Final = 1
_LEARNING: Final = 2

AT_START: Final = "INS_GYR_CAL"
"""1: every start measures the gyros anew."""

Names = tuple[str, str, str]


class ArduPilotParameters(ImuParameters):
    """Parameter names of one IMU, counting from 1; the first is irregular, 4 and 5 are again (autopilots 1.1)."""

    def __init__(self, instance: int) -> None:
        """Raise AutopilotError where there is no such instance."""
        if instance not in INSTANCES:
            raise AutopilotError(f"IMU {instance} is not known; allowed are {', '.join(map(str, INSTANCES))}")
        # INS_GYROFFS, INS_GYR2OFFS, INS4_GYROFFS; but INS_GYR1_CALTEMP, INS_TCAL1_ENABLE.
        ins, n = (f"INS{instance}_", "") if instance > 3 else ("INS_", "" if instance == 1 else str(instance))
        tcal = f"INS{instance}_TCAL_" if instance > 3 else f"INS_TCAL{instance}_"
        caltemp = f"INS{instance}_{{}}_CALTEMP" if instance > 3 else f"INS_{{}}{instance}_CALTEMP"
        super().__init__(
            gyro_offset=_xyz(f"{ins}GYR{n}OFFS_"),
            accel_offset=_xyz(f"{ins}ACC{n}OFFS_"),
            accel_scale=_xyz(f"{ins}ACC{n}SCAL_"),
            gyro_id=f"{ins}GYR{n}_ID",
            accel_id=f"{ins}ACC{n}_ID",
        )
        self.use = f"{ins}USE{n}"
        self.gyro_caltemp, self.accel_caltemp = caltemp.format("GYR"), caltemp.format("ACC")
        """Temperature at which nothing is taken off, deg C; -300: unknown, which is held at TMIN."""
        self.tcal_enable, self.tcal_low, self.tcal_high = f"{tcal}ENABLE", f"{tcal}TMIN", f"{tcal}TMAX"
        """ENABLE: 0 off, 1 on, 2 learning until the next boot."""
        self.tcal_gyro = [_xyz(f"{tcal}GYR{power}_") for power in (1, 2, 3)]
        """Coefficients by power of the temperature."""
        self.tcal_accel = [_xyz(f"{tcal}ACC{power}_") for power in (1, 2, 3)]
        coefficients = (name for names in (*self.tcal_accel, *self.tcal_gyro) for name in names)
        self.tcal = (self.tcal_low, self.tcal_high, *coefficients, self.tcal_enable)
        """All names but the CALTEMPs, which the firmware's own calibrations set; the switch comes last."""


def _xyz(stem: str) -> Names:
    return f"{stem}X", f"{stem}Y", f"{stem}Z"


# --- temperature


async def read_thermal(parameters: Parameters, instance: int) -> Thermal:
    """Read the temperature calibration of one IMU; it takes nothing off where it is switched off or not built in.

    Raises:
        AutopilotError: it is learning, or as `Parameters.read`.
    """
    names = ArduPilotParameters(instance)
    enable = await parameters.read_integer(names.tcal_enable)
    if enable is None:
        return Thermal()
    if enable == _LEARNING:
        raise AutopilotError(
            f"{names.tcal_enable} = 2: IMU {instance} is learning its temperature calibration;"
            " let it finish, or set it to 0 or 1"
        )
    if enable != _ON:
        return Thermal(values={names.tcal_enable: float(enable)})
    found = await parameters.read_many((*names.tcal, names.gyro_caltemp, names.accel_caltemp))

    def polynomial(coefficients: list[Names]) -> Polynomial:
        one, two, three = (vector(np.array([found[name] for name in each]) * _UNIT) for each in coefficients)
        return Polynomial(
            coefficients=(ZERO, one, two, three),
            reference_degc=REFERENCE_DEGC,
            low_degc=found[names.tcal_low],
            high_degc=found[names.tcal_high],
        )

    return Thermal(
        enabled_by=names.tcal_enable,
        values={name: found[name] for name in names.tcal},
        gyro=polynomial(names.tcal_gyro).zero_at(found[names.gyro_caltemp]),
        accel=polynomial(names.tcal_accel).zero_at(found[names.accel_caltemp]),
    )


async def thermal_changes(
    parameters: Parameters, calibration: ImuCalibration, gyro: Polynomial, accel: Polynomial | None, degc: float
) -> list[Change]:
    """Plan curves about 35 degC, as `Firmware.thermal_changes`.

    The offsets belong to this temperature from then on. Without a curve of the accelerometers, one that is in force
    stays, held at the ends of the new span; one that is not is cleared, for it would come into force with the gyros'.
    """
    assert gyro.reference_degc == REFERENCE_DEGC
    names, thermal = ArduPilotParameters(calibration.instance), calibration.thermal
    if not thermal.values:
        raise AutopilotError(
            f"{names.tcal_enable} does not exist: this firmware has no temperature calibration"
            " (boards of 1 MB have none)"
        )
    acts = accel is not None or any(map(any, thermal.accel.coefficients))
    caltemps = [names.gyro_caltemp, *([names.accel_caltemp] if acts else [])]
    before = await parameters.read_many((*names.tcal, *caltemps))
    wanted = {name: before[name] if thermal.enabled_by else 0.0 for each in names.tcal_accel for name in each}
    for of, curve in ((names.tcal_gyro, gyro), *(((names.tcal_accel, accel),) if accel is not None else ())):
        for each, values in zip(of, curve.coefficients[1:], strict=True):
            wanted |= zip(each, (value / _UNIT for value in values), strict=True)
    wanted |= {names.tcal_low: gyro.low_degc, names.tcal_high: gyro.high_degc, names.tcal_enable: float(_ON)}
    wanted |= dict.fromkeys(caltemps, degc)

    def moved(of: Names, offset: Vector, by: Vector) -> list[Change]:
        return vector_changes(of, offset, vector(np.add(offset, by)))

    taken_gyro, taken_accel = thermal.taken_off(degc)
    changes = [
        *moved(names.accel_offset, calibration.accel_offset_m_s2, vector(taken_accel)),
        *moved(names.gyro_offset, calibration.gyro_offset_rad_s, vector(taken_gyro)),
        # The switch comes last, and is restored first.
        *(Change(name, before[name], wanted[name]) for name in (*caltemps, *names.tcal)),
    ]
    return [change for change in changes if change.before != change.after]

"""PX4's thermal compensation of the gyros: its parameters TC_G*, from a curve and back (autopilots 10.2).

In the sensor's axes `modules/temperature_compensation` takes off X0 + X1 d + X2 d^2 + X3 d^3, with d = T - TREF and T
held within TMIN and TMAX, in steps of a kelvin; the offsets in CAL_GYROn come off besides. Most boards are built
without it, and then have no such parameters.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Final

import msgspec
import numpy as np

from companion.autopilot.firmware.imu_calibration import ImuCalibration, Thermal, vector_changes
from companion.autopilot.firmware.px4 import SLOTS, THERMAL_ENABLE, thermal_names
from companion.autopilot.parameters.change import Change
from companion.autopilot.parameters.reading import Parameters, read_integer
from companion.autopilot.parameters.wire import float32, same_float32
from companion.calibration.temperature.polynomial import NOTHING, Polynomial
from companion.errors import AutopilotError
from companion.physics.frames import Array, vector

NOT_STORED: Final = 2.0**-23
"""A float that differs from its default by no more (FLT_EPSILON) is left out of what PX4 stores (`parameters.cpp`)."""
_LEAST: Final = float(np.nextafter(np.float32(NOT_STORED), np.float32(1.0)))


async def read_thermal(parameters: Parameters, gyro_id: int | None) -> Thermal:
    """Read afresh what is taken off one gyro; nothing where it is switched off, or not in the firmware.

    Whether the module runs cannot be read: it is taken to where it is switched on, as the start script has it.

    Raises:
        AutopilotError: a value that cannot be worked with, or as `Parameters.read`.
    """
    enable = await read_integer(parameters, THERMAL_ENABLE)
    if enable is None:
        return Thermal()
    switch = {THERMAL_ENABLE: float(enable)}
    if enable != 1:
        return Thermal(values=switch)
    for sensor in range(SLOTS):
        if await read_integer(parameters, thermal_names(sensor)[0]) == gyro_id:
            break
    else:
        return Thermal(values=switch)
    found = await parameters.read_many(thermal_names(sensor))
    if (wrong := next((name for name, value in found.items() if not math.isfinite(value)), None)) is not None:
        raise AutopilotError(f"{wrong} is {found[wrong]}; a number was expected")
    polynomial = polynomial_of(sensor, found)
    acts = any(map(any, polynomial.coefficients))
    return Thermal(
        enabled_by=THERMAL_ENABLE if acts else "",
        values={**switch, **found},
        gyro=polynomial if acts else NOTHING,
        gyro_constant=thermal_names(sensor)[4:7],
    )


async def thermal_changes(
    parameters: Parameters, calibration: ImuCalibration, gyro: Polynomial, degc: float
) -> list[Change]:
    """What to write so that a curve of the gyros is in force and the output at this temperature stays as it is.

    PX4 starts the module at a boot, where it is switched on. So the first write only switches it on, for this gyro and
    with nothing to take off; the next one, after the boot, goes by a far constant, whose effect shows that it acts.

    Args:
        parameters: of the autopilot.
        calibration: in force.
        gyro: in the IMU's axes.
        degc: of the IMU now.

    Raises:
        AutopilotError: this PX4 has none, or as `Parameters.read`.
    """
    thermal, far = calibration.thermal, calibration.far_step
    if not thermal.values:
        raise AutopilotError(f"this PX4 has no thermal compensation ({THERMAL_ENABLE} does not exist)")
    assert calibration.gyro_id is not None
    assert far is not None
    if not thermal.gyro_constant:
        return await _switching_on(parameters, calibration.parameters.gyro_id, calibration.gyro_id)
    x, y, z = thermal.gyro_constant
    sensor = int(x.removeprefix("TC_G").partition("_")[0])
    zero, one, two, three = (found := stored(gyro, degc)).coefficients
    constant = vector(_kept(np.array(zero) + thermal.gyro.at(degc)))
    found = msgspec.structs.replace(found, coefficients=(constant, one, two, three))
    wanted = values_of(sensor, calibration.gyro_id, found)
    changed = [name for name, value in wanted.items() if not same_float32(thermal.values[name], value)]
    if not changed:
        return []
    before = (thermal.values[x], thermal.values[y], thermal.values[z])
    return [
        *vector_changes((x, y, z), before, constant, far.gyro_rad_s),
        *(Change(name, thermal.values[name], wanted[name]) for name in changed if name not in (x, y, z)),
    ]


async def _switching_on(parameters: Parameters, slot: str, gyro_id: int) -> list[Change]:
    sensor = int(slot.removeprefix("CAL_GYRO").removesuffix("_ID"))
    before = await parameters.read_many((*thermal_names(sensor), THERMAL_ENABLE))
    if before[THERMAL_ENABLE] != 1.0:
        others = [thermal_names(other)[0] for other in range(SLOTS) if other != sensor]
        for name, device_id in (await parameters.read_many(others)).items():
            if device_id:
                raise AutopilotError(f"{name} is set, and what stands there would come into force: set it to 0 first")
    own, *_ = thermal_names(sensor)
    wanted = {own: float(gyro_id), **dict.fromkeys(thermal_names(sensor)[4:], 0.0), THERMAL_ENABLE: 1.0}
    return [Change(name, before[name], value) for name, value in wanted.items() if before[name] != value]


def values_of(sensor: int, device_id: int, polynomial: Polynomial) -> dict[str, float]:
    """By parameter, what makes PX4 take this off the gyro with this id; of a `stored` one exactly this."""
    terms = (term for each in polynomial.coefficients for term in each)
    head = (device_id, polynomial.reference_degc, polynomial.low_degc, polynomial.high_degc)
    return dict(zip(thermal_names(sensor), (*head, *terms), strict=True))


def polynomial_of(sensor: int, values: Mapping[str, float]) -> Polynomial:
    """What these parameters take off."""
    _, reference, low, high, *terms = (values[name] for name in thermal_names(sensor))
    constant, first, second, third = map(vector, np.reshape(terms, (4, 3)))
    return Polynomial(
        coefficients=(constant, first, second, third), reference_degc=reference, low_degc=low, high_degc=high
    )


def stored(polynomial: Polynomial, zero_degc: float) -> Polynomial:
    """The nearest to it that PX4 can store and find again after a start, nothing at a temperature.

    About the middle of its span; what a coefficient cannot hold the lower ones take over: the best lower power over
    the span is Chebyshev's, h^2/2 for d^2 and 3/4 h^2 d for d^3, with h half of the span.

    Args:
        polynomial: with a finite span.
        zero_degc: at which nothing is to be taken off.
    """
    low, high = float32(polynomial.low_degc), float32(polynomial.high_degc)
    middle, half = float32((low + high) / 2.0), (high - low) / 2.0
    terms = _about(polynomial, middle)
    for power, lower, share in ((3, 1, 0.75 * half**2), (2, 0, half**2 / 2.0), (1, 0, 0.0)):
        kept = _kept(terms[power])
        terms[lower] += share * (terms[power] - kept)
        terms[power] = kept
    first, second, third = map(vector, terms[1:])
    found = Polynomial(
        coefficients=((0.0, 0.0, 0.0), first, second, third), reference_degc=middle, low_degc=low, high_degc=high
    ).zero_at(zero_degc)
    constant = vector(_kept(np.array(found.coefficients[0])))
    return msgspec.structs.replace(found, coefficients=(constant, first, second, third))


def _about(polynomial: Polynomial, degc: float) -> Array:
    """Its coefficients about another reference, (4, 3)."""
    terms, by = np.array(polynomial.coefficients), degc - polynomial.reference_degc
    shifted = [sum(math.comb(n, k) * by ** (n - k) * terms[n] for n in range(k, len(terms))) for k in range(len(terms))]
    return np.array(shifted)


def _kept(values: Array) -> Array:
    """The nearest that PX4 stores."""
    rounded = values.astype(np.float32).astype(np.float64)
    least = np.where(np.abs(values) > NOT_STORED / 2.0, np.copysign(_LEAST, values), 0.0)
    return np.where(np.abs(rounded) > NOT_STORED, rounded, least)

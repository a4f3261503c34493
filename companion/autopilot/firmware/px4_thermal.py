"""PX4's thermal compensation of the gyros, read from its parameters TC_G* and never written (autopilots 10.2).

In the sensor's axes `modules/temperature_compensation` takes off X0 + X1 d + X2 d^2 + X3 d^3, with d = T - TREF and T
held within TMIN and TMAX, in steps of a kelvin; the offsets in CAL_GYROn come off besides. Most boards are built
without it, and then have no such parameters.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from companion.autopilot.firmware.imu_calibration import Thermal
from companion.autopilot.firmware.px4 import SLOTS, THERMAL_ENABLE, thermal_names
from companion.autopilot.parameters.reading import Parameters, read_integer
from companion.errors import AutopilotError
from companion.estimation.temperature.polynomial import NOTHING, Polynomial
from companion.physics.frames import vector


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
    )


def polynomial_of(sensor: int, values: Mapping[str, float]) -> Polynomial:
    """What these parameters take off."""
    _, reference, low, high, *terms = (values[name] for name in thermal_names(sensor))
    constant, first, second, third = map(vector, np.reshape(terms, (4, 3)))
    return Polynomial(
        coefficients=(constant, first, second, third), reference_degc=reference, low_degc=low, high_degc=high
    )

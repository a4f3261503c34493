"""What else is done with a still IMU, re-stated from its description; all of it in vehicle FRD and SI units.

- The plain mean: level is believed, the Earth does not turn, sigma is s / sqrt(n).
- ArduPilot's own calibrations (autopilots 3; `AP_InertialSensor::_init_gyro`, `_acal_simple`) and PX4's
  (autopilots 4.6; `gyro_calibration.cpp`, quick calibration of the accelerometers), with their acceptance.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from sim.accuracy.stand import Stand
from sim.earth import STANDARD_GRAVITY_M_S2, Array
from sim.px4.calibration import THRESHOLD

LEVEL: Final = np.array([0.0, 0.0, -STANDARD_GRAVITY_M_S2])

_ARDUPILOT_PERIOD_S: Final = 0.005
_ARDUPILOT_SAMPLES: Final = 50
_ARDUPILOT_BLOCK_S: Final = _ARDUPILOT_SAMPLES * _ARDUPILOT_PERIOD_S
_GYRO_BLOCKS: Final = 121
_GYRO_AGREES_RAD_S: Final = math.radians(0.1)
_GYRO_MOVED_M_S2: Final = 0.2
_ACCEL_BLOCKS: Final = 41
_ACCEL_AGREES_M_S2: Final = 0.05

_PX4_PERIOD_S: Final = 0.004
_PX4_SAMPLES: Final = 250
_PX4_TRIES: Final = 20
_PX4_MEDIAN_OF: Final = 9
_PX4_AGREES_RAD_S: Final = math.radians(0.6)
_PX4_QUEUE: Final = 8
_PX4_ATTITUDE_S: Final = 10.0


def plain_mean(rows: Array) -> tuple[Array, Array]:
    """Bias (6) and its sigma (6) of readings (n, 6): their mean less a level aircraft's on an Earth at rest."""
    bias = rows.mean(axis=0) - np.concatenate([np.zeros(3), LEVEL])
    return bias, np.asarray(rows.std(axis=0, ddof=1) / math.sqrt(len(rows)))


def ardupilot(standing: Stand, start_s: float) -> Array:
    """Bias (6) by its gyro calibration (param1 = 1) and its simple accelerometer calibration (param5 = 4)."""
    return np.concatenate(
        [_agreeing_blocks(standing, start_s, gyro=True), _agreeing_blocks(standing, start_s, gyro=False) - LEVEL]
    )


def _agreeing_blocks(standing: Stand, start_s: float, *, gyro: bool) -> Array:
    """Half the sum of the first two neighbouring blocks that agree, or of the pair that came nearest."""
    part = slice(0, 3) if gyro else slice(3, 6)
    blocks, allowed = (_GYRO_BLOCKS, _GYRO_AGREES_RAD_S) if gyro else (_ACCEL_BLOCKS, _ACCEL_AGREES_M_S2)
    last, best, nearest = np.zeros(3), np.zeros(3), math.inf
    first = True
    for block in range(blocks):
        rows = standing.read(start_s + block * _ARDUPILOT_BLOCK_S, _ARDUPILOT_PERIOD_S, _ARDUPILOT_SAMPLES)
        if gyro and np.linalg.norm(rows[-1, 3:] - rows[0, 3:]) > _GYRO_MOVED_M_S2:
            continue
        mean = rows[:, part].mean(axis=0)
        apart = float(np.linalg.norm(mean - last))
        both = (mean + last) / 2.0
        if first:
            best, nearest, first = mean, apart, False
        elif apart < allowed:
            return np.asarray(both)
        elif apart < nearest:
            best, nearest = both, apart
        last = mean
    return np.asarray(best)


def px4_mean(standing: Stand, start_s: float) -> Array:
    """Bias (3) by its gyro calibration (param1 = 1), before it is asked whether that is worth applying."""
    mean = np.zeros(3)
    for attempt in range(_PX4_TRIES):
        rows = standing.read(start_s + attempt * _PX4_SAMPLES * _PX4_PERIOD_S, _PX4_PERIOD_S, _PX4_SAMPLES)[:, :3]
        mean = rows.mean(axis=0)
        if (np.abs(np.median(rows[-_PX4_MEDIAN_OF:], axis=0) - mean) <= _PX4_AGREES_RAD_S).all():
            break
    return np.asarray(mean)


def px4(standing: Stand, start_s: float) -> Array:
    """Bias (6) that is in force after gyro and quick accelerometer calibration (param5 = 4), from no offsets.

    A vector within 0.01 (rad/s, m/s^2) of the one in use is not taken. The attitude that the accelerometers are
    compared with has been levelled by themselves.
    """
    gyro = px4_mean(standing, start_s)
    direction = standing.read(start_s - _PX4_ATTITUDE_S, 0.1, round(_PX4_ATTITUDE_S / 0.1))[:, 3:].mean(axis=0)
    expected = direction / np.linalg.norm(direction) * STANDARD_GRAVITY_M_S2
    accel = standing.read(start_s, _PX4_PERIOD_S, _PX4_QUEUE)[:, 3:].mean(axis=0) - expected
    return np.concatenate([_applied(gyro), _applied(accel)])


def _applied(offset: Array) -> Array:
    return offset if np.linalg.norm(offset) > THRESHOLD else np.zeros(3)

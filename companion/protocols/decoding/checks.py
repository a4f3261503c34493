"""Whether values that arrived whole can be true at all; what cannot is rejected, not passed on."""

from __future__ import annotations

import math

from companion.protocols.decoding import reasons
from companion.protocols.decoding.base import RejectedError
from companion.samples import Vector

GYRO_LIMIT_RAD_S = 100.0
"""5730 deg/s; the widest ranges sold are 4000 deg/s."""
ACCEL_LIMIT_M_S2 = 2000.0
"""204 g; the widest range of a part with a gyro in it is 200 g."""
TEMPERATURE_LIMIT_DEGC = 200.0


def numbers(fields: list[bytes]) -> list[float]:
    """Decimal numbers from the fields of a sentence.

    Raises:
        RejectedError: one of them is not a number, or not a finite one.
    """
    try:
        values = list(map(float, fields))
    except ValueError:
        raise RejectedError(reasons.NOT_A_NUMBER) from None
    # One test for all of them: whatever is not finite makes the sum so.
    if not math.isfinite(sum(values)):
        raise RejectedError(reasons.NON_FINITE)
    return values


def check_imu(gyro_rad_s: Vector, accel_m_s2: Vector, temperature_degc: float | None) -> None:
    """Check one sample of an IMU.

    Raises:
        RejectedError: a value is not finite, or beyond what any IMU can measure.
    """
    gx, gy, gz = gyro_rad_s
    ax, ay, az = accel_m_s2
    temperature = temperature_degc or 0.0
    if not math.isfinite(gx + gy + gz + ax + ay + az + temperature):
        raise RejectedError(reasons.NON_FINITE)
    gyro, accel = GYRO_LIMIT_RAD_S, ACCEL_LIMIT_M_S2
    if not (
        -gyro <= gx <= gyro
        and -gyro <= gy <= gyro
        and -gyro <= gz <= gyro
        and -accel <= ax <= accel
        and -accel <= ay <= accel
        and -accel <= az <= accel
        and -TEMPERATURE_LIMIT_DEGC <= temperature <= TEMPERATURE_LIMIT_DEGC
    ):
        raise RejectedError(reasons.OUT_OF_RANGE)


def check_attitude(yaw_deg: float, pitch_deg: float, roll_deg: float) -> None:
    """Check yaw (either convention, so -180 to 360), pitch and roll in degrees.

    Raises:
        RejectedError: an angle is not finite or out of range.
    """
    if not math.isfinite(yaw_deg + pitch_deg + roll_deg):
        raise RejectedError(reasons.NON_FINITE)
    if not (-180.0 <= yaw_deg <= 360.0 and -90.0 <= pitch_deg <= 90.0 and -180.0 <= roll_deg <= 180.0):
        raise RejectedError(reasons.OUT_OF_RANGE)


def check_vector(vector: Vector) -> None:
    """Check a vector for which no limit is known.

    Raises:
        RejectedError: a component is not finite.
    """
    if not math.isfinite(sum(vector)):
        raise RejectedError(reasons.NON_FINITE)

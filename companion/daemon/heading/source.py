"""Which IMU carries the attitude, and what of its calibration the estimator must know."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from companion.attitude.estimator import AttitudeSettings
from companion.calibration.noise.allan import noise_profile
from companion.calibration.solution.record import ImuRecord
from companion.calibration.solution.site import LocalEarth
from companion.config.sections import Config, Imu
from companion.physics.frames import rotation_matrix
from companion.physics.units import MG
from companion.samples import ImuSample, Vector

UNCALIBRATED_ACCEL_MG: Final = 50.0
"""What a consumer accelerometer may be off by where only the gyros were calibrated."""
_ZERO: Final[Vector] = (0.0, 0.0, 0.0)


def carrying_imu(config: Config) -> Imu:
    """The companion's own IMU where it has one: faster, unfiltered, and nobody else changes its offsets."""
    return next((imu for imu in config.imu if imu.source == "serial"), config.imu[0])


def settings_of(imu: Imu, record: ImuRecord, local: LocalEarth, gyro_step_rad_s: float) -> AttitudeSettings | None:
    """How the estimator is to take this IMU's samples; None where its gyros were not calibrated."""
    serial = imu.source == "serial"
    gyro = record.gyro_bias_rad_s if serial else _left(record, record.residual_gyro_rad_s, "GYR")
    accel = record.accel_bias_m_s2 if serial else _left(record, record.residual_accel_m_s2, "ACC")
    if gyro is None or record.gyro_sigma_use_rad_s is None:
        return None
    covariance = np.diag(np.square(record.gyro_sigma_use_rad_s))
    if record.covariance is not None:
        full = [row[:3] for row in record.covariance[:3]]
        if not any(value is None for row in full for value in row):
            covariance = np.array(full, dtype=np.float64)
    # What is left of the steps where the rate is too small to be told from none.
    covariance = covariance + np.eye(3) * gyro_step_rad_s**2 / 12.0
    unknown = UNCALIBRATED_ACCEL_MG * MG
    return AttitudeSettings(
        vehicle_from_sensor=rotation_matrix(imu.mounting if serial else "ROTATION_NONE"),
        gravity_m_s2=local.gravity_m_s2,
        latitude_deg=local.site.latitude_deg,
        gyro_noise=noise_profile(imu.profile).gyro,
        gyro_bias_rad_s=gyro,
        gyro_covariance=covariance,
        accel_bias_m_s2=accel or _ZERO,
        accel_sigma_m_s2=(_level_sigma(record) if accel else None) or (unknown, unknown, unknown),
    )


def _level_sigma(record: ImuRecord) -> Vector | None:
    """Of the bias as the level aircraft's, which it mostly is in flight, however it stood when it was calibrated."""
    return record.accel_sigma_use_m_s2 if record.effective is None else record.effective.level_sigma_m_s2


def _left(record: ImuRecord, residual: Vector | None, mark: str) -> Vector | None:
    """What an autopilot's stream still has in it: nothing, if it was written; else what was found there."""
    outcomes = {one.outcome for name, one in record.written.items() if mark in name}
    return _ZERO if outcomes and outcomes <= {"verified", "stored"} else residual


def without_truncation(sample: ImuSample, step_rad_s: float) -> ImuSample:
    """A sample whose rates were cut off towards zero: in the middle of what they may have been."""
    x, y, z = sample.gyro_rad_s
    rates: Vector = (_middle(x, step_rad_s), _middle(y, step_rad_s), _middle(z, step_rad_s))
    return ImuSample(t_s=sample.t_s, gyro_rad_s=rates, accel_m_s2=sample.accel_m_s2)


def _middle(value: float, step: float) -> float:
    return value + math.copysign(0.5 * step, value) if value else 0.0

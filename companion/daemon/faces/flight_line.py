"""What can be set at the flight line from a ground station: the component's own parameters."""

from __future__ import annotations

from typing import Final, get_args

from companion.calibration.solution.record import ImuRecord
from companion.component.own_parameters import OwnParameters
from companion.component.service import JobResult
from companion.config.sections import AtArm, Config
from companion.daemon.calibrating.conductor import Conductor
from companion.daemon.job import Job
from companion.errors import ConfigError
from companion.physics.units import DEG_H, MG

AT_ARM: Final[tuple[AtArm, ...]] = ("off", "warn", "gate")
STATE_NUMBER: Final = {"done": 1.0, "failed": 2.0, "cancelled": 3.0}
LARGEST: Final = 1e6


def define_parameters(parameters: OwnParameters, config: Config, conductor: Conductor) -> None:
    """Define CMP_*: targets, at_arm and push may be set; the last result is shown.

    What a ground station sets holds until the daemon restarts: the configuration file is the aircraft owner's.
    """
    assert set(AT_ARM) == set(get_args(AtArm))
    wanted = config.calibration

    def set_gyro_target(deg_h: float) -> None:
        conductor.retarget(gyro_sigma_rad_s=deg_h * DEG_H)

    def set_accel_target(mg: float) -> None:
        conductor.retarget(accel_sigma_m_s2=mg * MG)

    def set_push(value: float) -> None:
        conductor.switch(push=bool(_whole("CMP_PUSH", value)))

    def set_at_arm(value: float) -> None:
        conductor.switch(at_arm=AT_ARM[_whole("CMP_AT_ARM", value)])

    parameters.define("CMP_GYR_TGT", wanted.target_gyro_sigma_deg_h, 0.01, LARGEST, set_gyro_target)
    parameters.define("CMP_ACC_TGT", wanted.target_accel_sigma_mg, 0.0001, LARGEST, set_accel_target)
    parameters.define("CMP_PUSH", float(config.push.parameters), 0.0, 1.0, set_push)
    parameters.define("CMP_AT_ARM", float(AT_ARM.index(wanted.at_arm)), 0.0, 2.0, set_at_arm)
    parameters.define("CMP_STATE", 0.0, 0.0, 3.0, read_only=True)
    parameters.define("CMP_GYR_SIG", 0.0, 0.0, LARGEST, read_only=True)
    parameters.define("CMP_ACC_SIG", 0.0, 0.0, LARGEST, read_only=True)

    def show(job: Job, result: JobResult) -> None:
        del result
        if (record := job.record) is None:
            return
        parameters.set("CMP_STATE", STATE_NUMBER[record.state])
        parameters.set("CMP_GYR_SIG", _worst(record.imus, "gyro_sigma_use_rad_s", DEG_H))
        parameters.set("CMP_ACC_SIG", _worst(record.imus, "accel_sigma_use_m_s2", MG))

    conductor.watch(show)


def _whole(name: str, value: float) -> int:
    if value != round(value):
        raise ConfigError(f"{name}: found {value:g}; allowed: a whole number")
    return round(value)


def _worst(imus: tuple[ImuRecord, ...], sigma: str, unit: float) -> float:
    """The largest sigma of all axes in its unit; 0 where nothing was found."""
    values = [value for imu in imus for value in getattr(imu, sigma) or ()]
    return min(max(values, default=0.0) / unit, LARGEST)

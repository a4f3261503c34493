"""Reader of flights in ArduPilot logs (LogStructure.h of AP_Logger, AP_InertialSensor, AP_NavEKF3 and AP_AHRS)."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from companion.autopilot.firmware.ardupilot import ArduPilot
from companion.lab.autopilot_logs import Boot, BootMessages, FlownImu, changes, dataflash, in_use
from companion.lab.inertial import joined
from companion.physics.frames import Floats
from companion.physics.units import DEG

_ROWS: Final[dict[str, tuple[str, tuple[str, ...]]]] = {
    "IMU": ("I", ("GyrX", "GyrY", "GyrZ", "AccX", "AccY", "AccZ", "T", "GH", "AH")),
    "VIBE": ("IMU", ("VibeX", "VibeY", "VibeZ")),
    "XKF1": ("C", ("VN", "VE", "VD", "PN", "PE", "PD", "GX", "GY", "GZ")),
    "XKF2": ("C", ("AZ",)),
    "XKQ": ("C", ("Q1", "Q2", "Q3", "Q4")),
    "XKV1": ("C", ("V10", "V11")),
    "XKV2": ("C", ("V12", "V15")),
    "XKF4": ("C", ("PI",)),
    "XKT": ("C", ("EKFMin", "EKFMax")),
    "SIM": ("", ("Q1", "Q2", "Q3", "Q4")),
    "SIM2": ("", ("VN", "VE", "VD", "PN", "PE", "PD")),
    "GPS": ("I", ("Status", "GWk", "GMS", "Lat", "Alt")),
    "ARM": ("", ("ArmState",)),
    "EV": ("", ("Id",)),
    "RCOU": ("", tuple(f"C{k}" for k in range(1, 15))),
}
"""Log messages to read, each with the name of its instance field ("": none) and the names of the fields to read."""
_IMUS: Final = 5
_GPS_UNIX_S: Final = 315964800.0
_LEAP_S: Final = 18.0
_STEPS: Final = np.array([*[0.01 * DEG] * 3, 0.01])
"""Resolution of the EKF's biases in the log, which truncates them towards zero: 0.01 deg/s and 0.01 m/s^2."""
_EVENTS: Final = {"armed": {10: True, 11: False}, "airborne": {28: True, 18: False}}
_MOTOR_FUNCTIONS: Final = (*range(33, 41), *range(82, 86), 70)
_TURNING_US: Final = 30.0


def read(path: Path) -> Iterator[Boot]:
    return map(_boot, dataflash(path, _ROWS))


def _boot(start: BootMessages) -> Boot:
    parameters = {name: value for _, name, value in start.parameters}
    mask = round(parameters.get("EK3_IMU_MASK", 3.0))
    cores = [k for k in range(_IMUS) if mask >> k & 1]  # IMU (from 0) of each EKF core
    lanes = _lanes(start)
    simulated = bool(start.instances("SIM"))
    return Boot(
        firmware=ArduPilot.name,
        imus=tuple(_imu(start, number, parameters, cores) for number in start.instances("IMU")),
        solution=joined(*(_of_core_in_use(start, name, lanes) for name in ("XKQ", "XKF1"))),
        truth=joined(start.rows("SIM"), start.rows("SIM2")),
        armed=_events(start, "armed"),
        motors=_motors(start.rows("RCOU"), parameters),
        airborne=_events(start, "airborne"),
        parameters=tuple(start.parameters),
        unix_offset_s=_unix_offset(start.rows("GPS")),
        place=_place(start.rows("GPS")),
        # A simulator has neither the Earth's rate nor local gravity.
        earth_turns=not simulated,
        standard_gravity=simulated,
        notes=(
            *(("simulated: the Earth does not turn in it",) if simulated else ()),
            *(("the EKF has changed its lane: measured from the one in use",) if np.ptp(lanes[:, 1]) else ()),
        ),
    )


def _lanes(start: BootMessages) -> Floats:
    """Return time and number of the EKF core in use, (n, 2), which every core logs; core 0 if the log has none."""
    told = next((start.rows("XKF4", core) for core in start.instances("XKF4")), np.zeros((0, 2)))
    told = told[(told[:, 1] >= 0) & (told[:, 1] < _IMUS)]
    return told if len(told) else np.zeros((1, 2))


def _of_core_in_use(start: BootMessages, name: str, lanes: Floats) -> Floats:
    parts = [start.rows(name)[:0]]
    for core in start.instances(name):
        rows = start.rows(name, core)
        parts.append(rows[in_use(lanes, rows[:, 0]) == core])
    found = np.concatenate(parts)
    return np.asarray(found[np.argsort(found[:, 0])])


def _imu(start: BootMessages, instance: int, parameters: dict[str, float], cores: list[int]) -> FlownImu:
    rows = start.rows("IMU", instance)
    failed: NDArray[np.bool_] = np.any(rows[:, 8:10] < 1.0, axis=1)  # False in a log without the health fields
    used = rows[np.isfinite(rows[:, :7]).all(axis=1) & ~failed]
    vibration = start.rows("VIBE", instance)
    number = instance + 1
    prefix, suffix = (f"INS{number}_", "") if number > 3 else ("INS_", "" if number == 1 else str(number))
    ids = [parameters.get(f"{prefix}{half}{suffix}_ID") for half in ("GYR", "ACC")]
    gyro_id, accel_id = (None if each is None else round(each) for each in ids)
    return FlownImu(
        number=number, t_s=used[:, 0], readings=used[:, 1:7], means=False,
        gyro_id=gyro_id, accel_id=accel_id,
        degc=rows[np.isfinite(rows[:, 7])][:, [0, 7]],
        failed_s=rows[failed, 0],
        vibration=np.column_stack([vibration[:, 0], np.linalg.norm(vibration[:, 1:4], axis=1)]),
        estimated=_estimated(start, cores.index(instance)) if instance in cores else None,
    )  # fmt: skip


def _estimated(start: BootMessages, core: int) -> Floats | None:
    gyro, accel = start.rows("XKF1", core), start.rows("XKF2", core)
    if not len(gyro) or not len(accel):
        return None
    t_s = gyro[:, 0]
    steps = start.rows("XKT", core)
    step_s = float(steps[:, 1:3].mean()) if len(steps) else 0.01
    biases = np.column_stack([gyro[:, 7:10] * DEG, np.interp(t_s, accel[:, 0], accel[:, 1])])
    # Only the primary core's variances are logged; the other cores have the same tuning.
    of = next((one for one in (core, *start.instances("XKV2")) if len(start.rows("XKV2", one))), core)
    first, second = start.rows("XKV1", of), start.rows("XKV2", of)
    sigmas = np.full(biases.shape, np.nan)
    if len(first) and len(second) and step_s > 0.0:
        # The variances are those of increments in one step of the filter.
        variances = [(first, 1), (first, 2), (second, 1), (second, 2)]
        columns = [np.interp(t_s, rows[:, 0], rows[:, k]) for rows, k in variances]
        sigmas = np.sqrt(np.maximum(np.column_stack(columns), 0.0)) / step_s
    # A logged value is truncated toward zero: the middle of its range is half a step further from zero.
    middle = biases + 0.5 * _STEPS * np.sign(biases)
    cut = np.where(np.abs(biases) < 0.5 * _STEPS, 2.0 * _STEPS, _STEPS) / math.sqrt(12.0)
    return np.column_stack([t_s, middle, np.hypot(sigmas, cut)])


def _events(start: BootMessages, what: str) -> tuple[tuple[float, bool], ...]:
    rows = start.rows("ARM") if what == "armed" else np.zeros((0, 2))
    if len(rows):
        return changes(rows[:, 0], rows[:, 1] > 0.5)
    known = _EVENTS[what]
    told = [(at_s, known[int(event)]) for at_s, event in start.rows("EV") if int(event) in known]
    return changes([at_s for at_s, _ in told], [state for _, state in told])


def _motors(outputs: Floats, parameters: dict[str, float]) -> tuple[tuple[float, bool], ...]:
    used = [k for k in range(1, 15) if round(parameters.get(f"SERVO{k}_FUNCTION", 0.0)) in _MOTOR_FUNCTIONS]
    if not len(outputs) or not used:
        return ()
    least = np.array([parameters.get(f"SERVO{k}_MIN", 1000.0) for k in used])
    least = np.maximum(np.minimum(least, parameters.get("MOT_PWM_MIN", 3000.0) or 3000.0), 800.0)
    return changes(outputs[:, 0], (outputs[:, used] > least + _TURNING_US).any(axis=1))


def _unix_offset(gps: Floats) -> float | None:
    fixed = gps[(gps[:, 1] >= 3) & (gps[:, 2] > 0)]
    unix_s = _GPS_UNIX_S + fixed[:, 2] * 604800.0 + fixed[:, 3] * 1e-3 - _LEAP_S
    return float(np.median(unix_s - fixed[:, 0])) if len(fixed) else None


def _place(gps: Floats) -> tuple[float, float] | None:
    fixed = gps[gps[:, 1] >= 3]
    return (float(fixed[-1, 4]), float(fixed[-1, 5])) if len(fixed) else None

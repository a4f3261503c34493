"""Reader of flights in PX4's ULog, one start of the autopilot per file (PX4's messages; autopilots.md section 4)."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Final

import numpy as np

from companion.autopilot.firmware.px4 import PX4
from companion.lab.autopilot_logs import US, Boot, BootMessages, FlownImu, ascending, changes, in_use, ulog
from companion.lab.inertial import Navigation, joined
from companion.physics.frames import Floats


def _elements(name: str, count: int = 3) -> tuple[str, ...]:
    return tuple(f"{name}[{k}]" for k in range(count))


_MOVING: Final = ("timestamp_sample", "vx", "vy", "vz", "x", "y", "z", "ref_lat", "ref_alt")
_TOPICS: Final[dict[str, tuple[str, ...]]] = {
    "sensor_combined": (*_elements("gyro_rad"), *_elements("accelerometer_m_s2")),
    "sensor_selection": ("gyro_device_id",),
    "vehicle_imu_status": ("gyro_device_id", "accel_device_id", "temperature_gyro", "accel_vibration_metric"),
    "estimator_sensor_bias": (
        "gyro_device_id", *_elements("gyro_bias"), "accel_bias[2]", *_elements("gyro_bias_variance"),
        "accel_bias_variance[2]",
    ),
    "vehicle_attitude": ("timestamp_sample", *_elements("q", 4)),
    "vehicle_attitude_groundtruth": ("timestamp_sample", *_elements("q", 4)),
    "vehicle_local_position": _MOVING,
    "vehicle_local_position_groundtruth": _MOVING,
    "actuator_armed": ("armed",),
    "actuator_motors": _elements("control", 12),
    "vehicle_land_detected": ("landed",),
    "vehicle_gps_position": ("time_utc_usec",),
}  # fmt: skip
_TURNING: Final = 0.02


def read(path: Path) -> Iterator[Boot]:
    start = ulog(path, _TOPICS)
    armed, landed = start.rows("actuator_armed"), start.rows("vehicle_land_detected")
    yield Boot(
        firmware=PX4.name,
        imus=_imus(start),
        solution=_navigation(start, ""),
        truth=_navigation(start, "_groundtruth"),
        armed=changes(armed[:, 0], armed[:, 1] > 0.5),
        motors=_motors(start),
        airborne=changes(landed[:, 0], landed[:, 1] < 0.5),
        parameters=tuple(start.parameters),
        unix_offset_s=_unix_offset(start),
        place=_place(start),
        notes=(
            *((f"gaps in it, in which PX4 could not write: {start.gaps}",) if start.gaps else ()),
            *(("PX4 has changed the IMU that it flies by",) if np.ptp(_selection(start)[:, 1]) else ()),
        ),
    )


def _whole(rows: Floats) -> Floats:
    return np.asarray(rows[np.isfinite(rows).all(axis=1)])


def _sampled(rows: Floats) -> Floats:
    """Order rows by sample time (second column); older PX4 versions have only the message's time (first column)."""
    at_s = rows[:, 1] * US
    return ascending(_whole(np.column_stack([np.where(np.isfinite(at_s), at_s, rows[:, 0]), rows[:, 2:]])))


def _navigation(start: BootMessages, suffix: str) -> Navigation | None:
    attitude, moving = (start.rows(f"vehicle_{what}{suffix}") for what in ("attitude", "local_position"))
    return joined(_sampled(attitude), _sampled(moving[:, :8]))


def _imus(start: BootMessages) -> tuple[FlownImu, ...]:
    found: dict[int, FlownImu] = {}
    status = {k: start.rows("vehicle_imu_status", k) for k in start.instances("vehicle_imu_status")}
    ids = {rows[-1, 1]: k for k, rows in status.items() if len(rows)}
    combined = _whole(start.rows("sensor_combined"))
    selected = in_use(_selection(start), combined[:, 0])
    for gyro_id in np.unique(selected):
        number = ids.get(gyro_id, 0)
        found[number] = _imu(start, number, combined[selected == gyro_id])
    return tuple(found[k] for k in sorted(found))


def _selection(start: BootMessages) -> Floats:
    """Return the device id of the gyro in use over time, (n, 2): time and id."""
    told = _whole(start.rows("sensor_selection"))
    return told if len(told) else np.zeros((1, 2))


def _imu(start: BootMessages, k: int, rows: Floats) -> FlownImu:
    status = start.rows("vehicle_imu_status", k)
    known = status[np.isfinite(status[:, 1:3]).all(axis=1)]
    gyro_id, accel_id = map(int, known[-1, 1:3]) if len(known) else (None, None)
    return FlownImu(
        number=k + 1, t_s=rows[:, 0], readings=rows[:, 1:7], means=True, gyro_id=gyro_id, accel_id=accel_id,
        degc=_whole(status[:, [0, 3]]), vibration=_whole(status[:, [0, 4]]), estimated=_estimated(start, gyro_id),
    )  # fmt: skip


def _estimated(start: BootMessages, gyro_id: int | None) -> Floats | None:
    for instance in start.instances("estimator_sensor_bias"):
        rows = start.rows("estimator_sensor_bias", instance)
        if not len(rows) or gyro_id not in (None, rows[-1, 1]):
            continue
        rows = _whole(rows)
        return np.column_stack([rows[:, 0], rows[:, 2:6], np.sqrt(np.maximum(rows[:, 6:], 0.0))])
    return None


def _motors(start: BootMessages) -> tuple[tuple[float, bool], ...]:
    outputs = start.rows("actuator_motors")
    return changes(outputs[:, 0], np.any(outputs[:, 1:] > _TURNING, axis=1))


def _unix_offset(start: BootMessages) -> float | None:
    rows = start.rows("vehicle_gps_position")
    known = (rows[:, 1] * US - rows[:, 0])[rows[:, 1] > 1e15]
    return float(np.median(known)) if len(known) else None


def _place(start: BootMessages) -> tuple[float, float] | None:
    rows = _whole(start.rows("vehicle_local_position")[:, 8:10])
    rows = rows[rows[:, 0] != 0.0]
    if not len(rows):
        return None
    # A simulator's gravity is that of the ellipsoid.
    simulated = start.instances("vehicle_attitude_groundtruth")
    return float(rows[-1, 0]), 0.0 if simulated else float(rows[-1, 1])

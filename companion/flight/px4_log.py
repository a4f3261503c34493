"""PX4's ULog of flights (its message definitions; autopilots 4)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from companion.flight.inertial import Navigation, joined
from companion.flight.log import Boot, Estimated, FlownImu, Place, ascending, changes
from companion.physics.frames import Floats
from companion.replay.autopilot_logs import Progress, ulog

_US: Final = 1e-6
_TOPICS: Final = [
    "sensor_combined", "sensor_selection", "vehicle_imu", "vehicle_imu_status", "estimator_sensor_bias",
    "vehicle_attitude", "vehicle_local_position", "vehicle_attitude_groundtruth", "vehicle_local_position_groundtruth",
    "actuator_armed", "actuator_motors", "vehicle_land_detected", "vehicle_gps_position",
]  # fmt: skip
_FAST_HZ: Final = 20.0
"""vehicle_imu is usually logged twice a second: each is then one of a hundred."""
_TURNING: Final = 0.02

_Data = Mapping[tuple[str, int], dict[str, Any]]


def read(path: Path, progress: Progress) -> Iterator[Boot]:
    """A ULog is of one start.

    Raises:
        StorageError: one line: it cannot be read, or pyulog is not there.
    """
    with ulog(path, _TOPICS, progress) as found:
        data: _Data = {(each.name, int(each.multi_id)): each.data for each in found.data_list}
        start_s = found.start_timestamp * _US
        told = [(start_s, str(name), float(value)) for name, value in found.initial_parameters.items()]
        told += [(at * _US, str(name), float(value)) for at, name, value in found.changed_parameters]
        gaps = len(found.dropouts)
        boot = _boot(data, told, gaps)
    yield boot


def _boot(data: _Data, parameters: list[tuple[float, str, float]], gaps: int) -> Boot:
    notes = [f"{gaps} gaps in it, in which PX4 could not write"] if gaps else []
    armed, landed = data.get(("actuator_armed", 0)), data.get(("vehicle_land_detected", 0))
    return Boot(
        firmware="px4",
        imus=_imus(data),
        solution=_navigation(data, ""),
        truth=_navigation(data, "_groundtruth"),
        armed=() if armed is None else changes(np.asarray(armed["timestamp"]) * _US, armed["armed"]),
        motors=_motors(data.get(("actuator_motors", 0))),
        airborne=()
        if landed is None
        else changes(np.asarray(landed["timestamp"]) * _US, np.asarray(landed["landed"]) == 0),
        parameters=tuple(parameters),
        unix_offset_s=_unix_offset(data),
        place=_place(data),
        notes=tuple(notes),
    )


def _table(data: dict[str, Any], names: Sequence[str], when: str = "timestamp") -> Floats:
    """The time and these fields, what is whole of it, in order; times of older versions are of the message."""
    times = np.asarray(data[when if when in data else "timestamp"], dtype=np.float64) * _US
    rows = np.column_stack([times, *(np.asarray(data[name], dtype=np.float64) for name in names)])
    return ascending(rows[np.isfinite(rows).all(axis=1)])


def _xyz(name: str, axes: int = 3) -> list[str]:
    return [f"{name}[{k}]" for k in range(axes)]


def _navigation(data: _Data, suffix: str) -> Navigation | None:
    attitude = data.get((f"vehicle_attitude{suffix}", 0))
    local = data.get((f"vehicle_local_position{suffix}", 0))
    if attitude is None or local is None:
        return None
    moving = _table(local, ("vx", "vy", "vz", "x", "y", "z"), "timestamp_sample")
    return joined(_table(attitude, _xyz("q", 4), "timestamp_sample"), moving)


def _imus(data: _Data) -> tuple[FlownImu, ...]:
    """Those whose readings are logged fast enough: the one that PX4 flies by, and others if somebody has asked."""
    found: dict[int, FlownImu] = {}
    status = {k: each for (name, k), each in data.items() if name == "vehicle_imu_status" and "gyro_device_id" in each}
    ids = {int(each["gyro_device_id"][-1]): k for k, each in status.items() if len(each["gyro_device_id"])}
    combined, selection = data.get(("sensor_combined", 0)), data.get(("sensor_selection", 0))
    if combined is not None:
        chosen = int(selection["gyro_device_id"][-1]) if selection and "gyro_device_id" in selection else -1
        number = ids.get(chosen, 0)
        found[number] = _imu(data, number, _table(combined, [*_xyz("gyro_rad"), *_xyz("accelerometer_m_s2")]))
    for (name, k), each in data.items():
        if name != "vehicle_imu" or k in found:
            continue
        what = [*_xyz("delta_angle"), *_xyz("delta_velocity"), "delta_angle_dt", "delta_velocity_dt"]
        rows = _table(each, what, "timestamp_sample")
        rows = rows[(rows[:, 7:] > 0.0).all(axis=1)]
        imu = _imu(data, k, np.hstack([rows[:, :1], rows[:, 1:7] / (np.repeat(rows[:, 7:], 3, axis=1) * _US)]))
        if imu.rate_hz >= _FAST_HZ:
            found[k] = imu
    return tuple(found[k] for k in sorted(found))


def _imu(data: _Data, k: int, rows: Floats) -> FlownImu:
    status = data.get(("vehicle_imu_status", k))
    degc = vibration = np.zeros((0, 2))
    gyro_id = accel_id = None
    if status is not None and "gyro_device_id" in status:
        gyro_id, accel_id = int(status["gyro_device_id"][-1]), int(status["accel_device_id"][-1])
        degc, vibration = _table(status, ["temperature_gyro"]), _table(status, ["accel_vibration_metric"])
    return FlownImu(
        number=k + 1, t_s=rows[:, 0], readings=rows[:, 1:7], means=True, gyro_id=gyro_id, accel_id=accel_id, degc=degc,
        vibration=vibration, estimated=_estimated(data, gyro_id),
    )  # fmt: skip


def _estimated(data: _Data, gyro_id: int | None) -> Estimated | None:
    for (name, _), each in sorted(data.items(), key=lambda item: item[0]):
        if name != "estimator_sensor_bias" or (gyro_id is not None and int(each["gyro_device_id"][-1]) != gyro_id):
            continue
        rows = _table(each, [name for half in ("gyro", "accel") for name in _xyz(f"{half}_bias")])
        sigmas = _table(each, [name for half in ("gyro", "accel") for name in _xyz(f"{half}_bias_variance")])
        sigmas = np.sqrt(np.maximum(sigmas, 0.0))
        if len(rows) == len(sigmas):
            return Estimated(rows[:, 0], rows[:, 1:4], sigmas[:, 1:4], rows[:, 4:7], sigmas[:, 4:7])
    return None


def _motors(data: dict[str, Any] | None) -> tuple[tuple[float, bool], ...]:
    if data is None:
        return ()
    outputs = np.column_stack([data[name] for name in _xyz("control", 12) if name in data])
    return changes(np.asarray(data["timestamp"]) * _US, np.nan_to_num(outputs).max(axis=1) > _TURNING)


def _unix_offset(data: _Data) -> float | None:
    gps = data.get(("vehicle_gps_position", 0))
    rows = np.zeros((0, 2)) if gps is None else _table(gps, ["time_utc_usec"])
    known = np.sort((rows[:, 1] * _US - rows[:, 0])[rows[:, 1] > 1e15])
    return float(known[len(known) // 2]) if len(known) else None


def _place(data: _Data) -> Place | None:
    local = data.get(("vehicle_local_position", 0))
    rows = np.zeros((0, 3)) if local is None else _table(local, ["ref_lat", "ref_alt"])
    rows = rows[rows[:, 1] != 0.0]
    if not len(rows):
        return None
    # The simulator's gravity is that of the ellipsoid.
    simulated = ("vehicle_attitude_groundtruth", 0) in data
    return Place(float(rows[-1, 1]), 0.0 if simulated else float(rows[-1, 2]))

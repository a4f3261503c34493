"""PX4's ULog of flights (its message definitions; autopilots 4)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from companion.flight.inertial import Navigation
from companion.flight.log import Boot, Estimated, FlownImu, Place, changes
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


def read(path: Path, progress: Progress) -> list[Boot]:
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
        return [_boot(data, told, gaps)]


def _boot(data: _Data, parameters: list[tuple[float, str, float]], gaps: int) -> Boot:
    notes = [f"{gaps} gaps in it, in which PX4 could not write"] if gaps else []
    armed, landed = data.get(("actuator_armed", 0)), data.get(("vehicle_land_detected", 0))
    return Boot(
        firmware="px4",
        imus=_imus(data),
        solution=_navigation(data, ""),
        truth=_navigation(data, "_groundtruth"),
        armed=() if armed is None else changes(_times(armed), armed["armed"]),
        motors=_motors(data.get(("actuator_motors", 0))),
        airborne=() if landed is None else changes(_times(landed), np.asarray(landed["landed"]) == 0),
        parameters=tuple(parameters),
        unix_offset_s=_unix_offset(data),
        place=_place(data),
        notes=tuple(notes),
    )


def _times(data: dict[str, Any], key: str = "timestamp") -> Floats:
    return np.asarray(data[key if key in data else "timestamp"], dtype=np.float64) * _US


def _vectors(data: dict[str, Any], name: str, axes: int = 3) -> Floats:
    return np.column_stack([np.asarray(data[f"{name}[{k}]"], dtype=np.float64) for k in range(axes)])


def _ascending(t_s: Floats, rows: Floats) -> tuple[Floats, Floats]:
    """Of what is whole, in order of time."""
    good = np.isfinite(rows).all(axis=1) & np.isfinite(t_s)
    t_s, rows = t_s[good], rows[good]
    if not len(t_s):
        return t_s, rows
    ahead = np.concatenate([[True], t_s[1:] > np.maximum.accumulate(t_s)[:-1]])
    return t_s[ahead], rows[ahead]


def _navigation(data: _Data, suffix: str) -> Navigation | None:
    attitude = data.get((f"vehicle_attitude{suffix}", 0))
    local = data.get((f"vehicle_local_position{suffix}", 0))
    if attitude is None or local is None:
        return None
    names = ("vx", "vy", "vz", "x", "y", "z")
    at, q = _ascending(_times(attitude, "timestamp_sample"), _vectors(attitude, "q", 4))
    moved, states = _ascending(
        _times(local, "timestamp_sample"),
        np.column_stack([np.asarray(local[name], dtype=np.float64) for name in names]),
    )
    if len(moved) < 2:
        return None
    inside = (at >= moved[0]) & (at <= moved[-1]) & (np.linalg.norm(q, axis=1) > 0.5)
    at, q = at[inside], q[inside]
    if len(at) < 2:
        return None
    states = np.column_stack([np.interp(at, moved, column) for column in states.T])
    return Navigation(at, q, states[:, :3], states[:, 3:])


def _imus(data: _Data) -> tuple[FlownImu, ...]:
    """Those whose readings are logged fast enough: the one that PX4 flies by, and others if somebody has asked."""
    found: dict[int, FlownImu] = {}
    status = {k: each for (name, k), each in data.items() if name == "vehicle_imu_status" and "gyro_device_id" in each}
    ids = {int(each["gyro_device_id"][-1]): k for k, each in status.items() if len(each["gyro_device_id"])}
    combined, selection = data.get(("sensor_combined", 0)), data.get(("sensor_selection", 0))
    if combined is not None:
        chosen = int(selection["gyro_device_id"][-1]) if selection and "gyro_device_id" in selection else None
        rows = np.hstack([_vectors(combined, "gyro_rad"), _vectors(combined, "accelerometer_m_s2")])
        number = ids.get(chosen or -1, 0)
        found[number] = _imu(data, number, *_ascending(_times(combined), rows))
    for (name, k), each in data.items():
        if name != "vehicle_imu" or k in found:
            continue
        # The middle of both times of integration.
        rows = np.hstack(
            [
                _vectors(each, f"delta_{what}")
                / (np.asarray(each[f"delta_{what}_dt"], dtype=np.float64)[:, None] * _US)
                for what in ("angle", "velocity")
            ]
        )
        imu = _imu(data, k, *_ascending(_times(each, "timestamp_sample"), rows))
        if imu.rate_hz >= _FAST_HZ:
            found[k] = imu
    return tuple(found[k] for k in sorted(found))


def _imu(data: _Data, k: int, t_s: Floats, readings: Floats) -> FlownImu:
    status = data.get(("vehicle_imu_status", k))
    degc = vibration = np.zeros((0, 2))
    gyro_id = accel_id = None
    if status is not None and len(status["timestamp"]):
        gyro_id, accel_id = int(status["gyro_device_id"][-1]), int(status["accel_device_id"][-1])
        at = _times(status)
        degc = np.column_stack(_ascending(at, np.asarray(status["temperature_gyro"], dtype=np.float64)[:, None]))
        level = np.asarray(status["accel_vibration_metric"], dtype=np.float64)[:, None]
        vibration = np.column_stack(_ascending(at, level))
    return FlownImu(
        number=k + 1, t_s=t_s, readings=readings, means=True, gyro_id=gyro_id, accel_id=accel_id, degc=degc,
        vibration=vibration, estimated=_estimated(data, gyro_id),
    )  # fmt: skip


def _estimated(data: _Data, gyro_id: int | None) -> Estimated | None:
    for (name, _), each in sorted(data.items(), key=lambda item: item[0]):
        if name != "estimator_sensor_bias" or not len(each["timestamp"]):
            continue
        if gyro_id is not None and int(each["gyro_device_id"][-1]) not in (gyro_id, 0):
            continue
        columns = [_vectors(each, key) for key in ("gyro_bias", "accel_bias")]
        sigmas = [np.sqrt(np.maximum(_vectors(each, f"{key}_bias_variance"), 0.0)) for key in ("gyro", "accel")]
        return Estimated(_times(each), columns[0], sigmas[0], columns[1], sigmas[1])
    return None


def _motors(data: dict[str, Any] | None) -> tuple[tuple[float, bool], ...]:
    if data is None:
        return ()
    outputs = np.nan_to_num(_vectors(data, "control", 12))
    return changes(_times(data), np.max(outputs, axis=1) > _TURNING)


def _unix_offset(data: _Data) -> float | None:
    gps = data.get(("vehicle_gps_position", 0))
    if gps is None:
        return None
    utc = np.asarray(gps["time_utc_usec"], dtype=np.float64) * _US
    known = np.sort((utc - _times(gps))[utc > 1e9])
    return float(known[len(known) // 2]) if len(known) else None


def _place(data: _Data) -> Place | None:
    local = data.get(("vehicle_local_position", 0))
    if local is None:
        return None
    latitude, height = (np.asarray(local[key], dtype=np.float64) for key in ("ref_lat", "ref_alt"))
    known = np.flatnonzero(np.isfinite(latitude) & (latitude != 0.0))
    if not len(known):
        return None
    at = known[-1]
    # The simulator's gravity is that of the ellipsoid.
    simulated = ("vehicle_attitude_groundtruth", 0) in data
    return Place(float(latitude[at]), float(height[at]) if math.isfinite(height[at]) and not simulated else 0.0)

"""Small logs as autopilots write them, from the descriptions of the formats.

ULog: PX4 user guide, "ULog File Format". Dataflash: ArduPilot's AP_Logger/LogStructure.h (struct log_Format, HEAD_BYTE1
and 2), and AP_InertialSensor/LogStructure.h (struct log_IMU).
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from pathlib import Path

from tests.support.made_noise import Floats

_IMU = ("IMU", "QBffffffIIfBBHH", "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ,EG,EA,T,GH,AH,GHz,AHz")
_IMU_STRUCT = struct.Struct("<QBffffffIIfBBHH")
_FMT, _IMU_ID = 0x80, 0x81
_HEAD = b"\xa3\x95"


def write_dataflash(path: Path, imus: Mapping[int, tuple[Floats, Floats]], degc: float = 31.5) -> Path:
    """IMU messages of several instances: by each, (n,) times in s and (n, 6) rad/s and m/s^2."""
    parts = [
        _format(_FMT, 89, "FMT", "BBnNZ", "Type,Length,Name,Format,Columns"),
        _format(_IMU_ID, _IMU_STRUCT.size + 3, *_IMU),
    ]
    rows = [
        (round(t_s * 1e6), instance, row)
        for instance, (times, readings) in imus.items()
        for t_s, row in zip(times.tolist(), readings.tolist(), strict=True)
    ]
    for t_us, instance, row in sorted(rows, key=lambda each: each[:2]):
        parts.append(_HEAD + bytes((_IMU_ID,)))
        parts.append(_IMU_STRUCT.pack(t_us, instance, *row, 0, 0, degc, 1, 1, 1000, 1000))
    path.write_bytes(b"".join(parts))
    return path


def _format(number: int, length: int, name: str, letters: str, columns: str) -> bytes:
    return _HEAD + struct.pack("<BBB4s16s64s", _FMT, number, length, name.encode(), letters.encode(), columns.encode())


_TOPICS = {
    "sensor_combined": "uint64_t timestamp;float[3] gyro_rad;float[3] accelerometer_m_s2;",
    "sensor_gyro": "uint64_t timestamp;float x;float y;float z;float temperature;",
    "sensor_accel": "uint64_t timestamp;float x;float y;float z;",
    "sensor_selection": "uint64_t timestamp;float gyro_device_id;",
    "vehicle_imu_status": "uint64_t timestamp;float gyro_device_id;float accel_device_id;float temperature_gyro;"
    "float accel_vibration_metric;",
    "vehicle_attitude": "uint64_t timestamp;float[4] q;",
    "vehicle_local_position": "uint64_t timestamp;float vx;float vy;float vz;float x;float y;float z;"
    "float ref_lat;float ref_alt;",
    "actuator_armed": "uint64_t timestamp;float armed;",
    "vehicle_land_detected": "uint64_t timestamp;float landed;",
    "actuator_motors": "uint64_t timestamp;float[12] control;",
    "estimator_sensor_bias": "uint64_t timestamp;float gyro_device_id;float[3] gyro_bias;float[3] gyro_bias_variance;"
    "float[3] accel_bias;float[3] accel_bias_variance;",
}


def write_ulog(path: Path, topics: Mapping[tuple[str, int], tuple[Floats, Floats]]) -> Path:
    """Write topics: key is topic and instance, value times (n,) in s and the numbers."""
    parts = [b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0), ulog_message(b"B", bytes(40))]
    parts += [ulog_message(b"F", f"{name}:{fields}".encode()) for name, fields in _TOPICS.items()]
    rows = []
    for number, ((name, instance), (times, values)) in enumerate(topics.items()):
        parts.append(ulog_message(b"A", struct.pack("<BH", instance, number) + name.encode()))
        rows += [(round(t_s * 1e6), number, row) for t_s, row in zip(times.tolist(), values.tolist(), strict=True)]
    for t_us, number, row in sorted(rows, key=lambda each: each[:2]):
        parts.append(ulog_message(b"D", struct.pack(f"<HQ{len(row)}f", number, t_us, *row)))
    path.write_bytes(b"".join(parts))
    return path


def ulog_message(kind: bytes, body: bytes) -> bytes:
    return struct.pack("<Hc", len(body), kind) + body

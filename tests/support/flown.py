"""A flight on a turning Earth, worked out from its path and attitude, and logs of it as autopilots write them.

Nothing is integrated: rates and forces are differences of the path's own functions, at 2 kHz.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from tests.support.made_noise import Floats

LATITUDE_DEG, HEIGHT_M = 47.4, 500.0
EARTH_RAD_S = 7.292115e-5


def gravity() -> float:
    s2 = np.sin(np.radians(LATITUDE_DEG)) ** 2
    surface = 9.7803253359 * (1 + 0.00193185265241 * s2) / np.sqrt(1 - 0.00669437999013 * s2)
    return float(surface - 3.086e-6 * HEIGHT_M)


def earth_rate() -> Floats:
    latitude = np.radians(LATITUDE_DEG)
    return EARTH_RAD_S * np.array([np.cos(latitude), 0.0, -np.sin(latitude)])


@dataclass(frozen=True)
class Flown:
    """60 s on the ground, then in the air; times in s since the autopilot's start."""

    t_s: Floats
    """Times of the readings; each is the mean since the one before."""
    readings: Floats
    at_s: Floats
    """Times of the states."""
    quaternions: Floats
    velocity: Floats
    position: Floats
    motors_s: float = 65.0
    airborne_s: float = 67.0
    landed_s: float = 240.0
    disarmed_s: float = 242.0


def fly(
    *,
    seconds: float = 250.0,
    rate_hz: float = 100.0,
    gyro_rad_s: Iterable[float] = (0.0, 0.0, 0.0),
    accel_m_s2: Iterable[float] = (0.0, 0.0, 0.0),
    step_m_s2: float = 0.0,
    white: tuple[float, float] = (0.0, 0.0),
    seed: int = 0,
) -> Flown:
    """With biases, one of accelerometer z that steps by `step_m_s2` when the motors start, and white noise."""
    fine = 2000.0
    t = np.arange(0.0, seconds + 0.5 / fine, 1.0 / fine)
    air = np.clip((t - 67.0) / 10.0, 0.0, 1.0) * np.clip((240.0 - t) / 10.0, 0.0, 1.0)
    air = air**3 * (10.0 - 15.0 * air + 6.0 * air**2)
    roll = np.radians(5.0) * air * np.sin(0.9 * t)
    pitch = np.radians(4.0) * air * np.sin(0.7 * t + 1.0) + np.radians(1.0)
    yaw = np.radians(30.0) + np.radians(40.0) * air * np.sin(0.11 * t)
    body = Rotation.from_euler("ZYX", np.column_stack([yaw, pitch, roll]))
    position = np.column_stack([15.0 * air * np.sin(0.2 * t), 10.0 * air * np.cos(0.15 * t), -20.0 * air])
    velocity = np.gradient(position, t, axis=0)
    acceleration = np.gradient(velocity, t, axis=0)
    rate = (body[:-1].inv() * body[1:]).as_rotvec() * fine + body[:-1].inv().apply(
        np.tile(earth_rate(), (len(t) - 1, 1))
    )
    coriolis = np.cross(2.0 * earth_rate(), velocity)
    force = body.inv().apply(acceleration + coriolis - [0.0, 0.0, gravity()])[:-1]
    each = round(fine / rate_hz)
    count = (len(t) - 1) // each
    readings = np.hstack([rate, force])[: count * each].reshape(count, each, 6).mean(axis=1)
    at = t[each : (count + 1) * each : each][:count]
    readings += [*gyro_rad_s, *accel_m_s2]
    readings[:, 5] += step_m_s2 * (at > 65.0)
    rng = np.random.default_rng(seed)
    readings += rng.normal(size=readings.shape) * np.repeat(white, 3) * np.sqrt(rate_hz)
    slow = slice(0, None, round(fine / 25.0))
    q = body[slow].as_quat()[:, [3, 0, 1, 2]]
    return Flown(at, readings, t[slow], q, velocity[slow], position[slow])


_SIZES = {
    "Q": "Q",
    "B": "B",
    "b": "b",
    "f": "f",
    "c": "h",
    "L": "i",
    "H": "H",
    "I": "I",
    "N": "16s",
    "h": "h",
    "e": "i",
}
_MESSAGES: dict[str, tuple[str, str]] = {
    "PARM": ("QNff", "TimeUS,Name,Value,Default"),
    "IMU": ("QBffffffIIfBBHH", "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ,EG,EA,T,GH,AH,GHz,AHz"),
    "VIBE": ("QBfffI", "TimeUS,IMU,VibeX,VibeY,VibeZ,Clip"),
    "XKF1": ("QBccCfffffffccce", "TimeUS,C,Roll,Pitch,Yaw,VN,VE,VD,dPD,PN,PE,PD,GX,GY,GZ,OH"),
    "XKQ": ("QBffff", "TimeUS,C,Q1,Q2,Q3,Q4"),
    "XKF4": ("QBcccccfffHBIHb", "TimeUS,C,SV,SP,SH,SM,SVT,errRP,OFN,OFE,FS,TS,SS,GPS,PI"),
    "GYR": ("QBQfff", "TimeUS,I,SampleUS,GyrX,GyrY,GyrZ"),
    "ACC": ("QBQfff", "TimeUS,I,SampleUS,AccX,AccY,AccZ"),
    "ARM": ("QBIBB", "TimeUS,ArmState,ArmChecks,Forced,Method"),
    "EV": ("QB", "TimeUS,Id"),
    "GPS": ("QBBIHBcLLeffffB", "TimeUS,I,Status,GMS,GWk,NSats,HDop,Lat,Lng,Alt,Spd,GCrs,VZ,Yaw,U"),
    "RCOU": ("QHHHHHHHHHHHHHH", "TimeUS,C1,C2,C3,C4,C5,C6,C7,C8,C9,C10,C11,C12,C13,C14"),
}  # fmt: skip
"""Formats of ArduPilot's LogStructure.h; its type C is 16 bits, unsigned."""


def dataflash(path: Path, messages: Iterable[tuple[str, tuple[Any, ...]]]) -> Path:
    """Write messages in this order; numbers as they stand in the file."""
    numbers = {name: 0x81 + k for k, name in enumerate(_MESSAGES)}
    sizes = {**_SIZES, "C": "H"}
    packers = {
        name: struct.Struct("<" + "".join(sizes[c] for c in letters)) for name, (letters, _) in _MESSAGES.items()
    }

    def said(number: int, length: int, name: str, letters: str, columns: str) -> bytes:
        return b"\xa3\x95\x80" + struct.pack(
            "<BB4s16s64s", number, length, name.encode(), letters.encode(), columns.encode()
        )

    parts = [said(0x80, 89, "FMT", "BBnNZ", "Type,Length,Name,Format,Columns")]
    parts += [said(numbers[name], packers[name].size + 3, name, *_MESSAGES[name]) for name in _MESSAGES]
    parts += [b"\xa3\x95" + bytes((numbers[name],)) + packers[name].pack(*values) for name, values in messages]
    path.write_bytes(b"".join(parts))
    return path


def parameters(**others: float) -> dict[str, float]:
    found = {"AHRS_ORIENTATION": 0.0, "INS_GYR_ID": 2752772.0, "INS_ACC_ID": 2753028.0, "INS_USE": 1.0}
    for axis in "XYZ":
        found |= {f"INS_GYROFFS_{axis}": 0.001, f"INS_ACCOFFS_{axis}": 0.02, f"INS_ACCSCAL_{axis}": 1.0}
    return found | {"SERVO1_FUNCTION": 33.0, "SERVO1_MIN": 1000.0} | others


def messages(
    flown: Flown, values: Mapping[str, float], *, from_s: float = 0.0, degc: Floats | None = None
) -> list[tuple[str, tuple[Any, ...]]]:
    """A log of ArduPilot, in order; GPS week 2440 began on 2026-10-11."""
    found: list[tuple[float, str, tuple[Any, ...]]] = []
    for name, value in values.items():
        found.append((from_s, "PARM", (name.encode(), value, 0.0)))
    warm = np.full(len(flown.t_s), 40.0) if degc is None else degc
    for t_s, row, now_degc in zip(flown.t_s.tolist(), flown.readings.tolist(), warm.tolist(), strict=True):
        found.append((t_s, "IMU", (0, *row, 0, 0, now_degc, 1, 1, 1000, 1000)))
    states = zip(
        flown.at_s.tolist(), flown.quaternions.tolist(), flown.velocity.tolist(), flown.position.tolist(), strict=True
    )
    for k, (t_s, q, v, p) in enumerate(states):
        found.append((t_s, "XKQ", (0, *q)))
        found.append((t_s, "XKF1", (0, 0, 0, 0, *v, v[2], *p, 0, 0, 0, 0)))
        if k % 5 == 0:
            spun = flown.motors_s <= t_s < flown.disarmed_s
            found.append((t_s, "RCOU", (1500 if spun else 1000, *[0] * 13)))
            found.append((t_s, "VIBE", (0, *[3.0 if spun else 0.05] * 3, 0)))
            found.append(
                (
                    t_s,
                    "GPS",
                    (
                        0,
                        3,
                        int(t_s * 1000.0),
                        2440,
                        12,
                        90,
                        round(LATITUDE_DEG * 1e7),
                        85000000,
                        round(HEIGHT_M * 100.0),
                        *[0.0] * 4,
                        1,
                    ),
                )
            )
    found += [(flown.motors_s - 1.0, "ARM", (1, 0, 0, 0)), (flown.disarmed_s, "ARM", (0, 0, 0, 0))]
    found += [(flown.airborne_s, "EV", (28,)), (flown.landed_s, "EV", (18,))]
    return [
        (name, (round(t_s * 1e6), *rest))
        for t_s, name, rest in sorted(found, key=lambda each: each[0])
        if t_s >= from_s
    ]

"""Reasons of the autopilot against arming: read from its messages and grouped by cause (firmware/prearm.toml).

ArduPilot repeats them every 30 s, PX4 sends changes to ground stations only; SYS_STATUS shows whether any is left.
"""

from __future__ import annotations

import functools
import math
import re
import statistics
import tomllib
from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple

import msgspec
import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.autopilot import firmware
from companion.autopilot.firmware.imu_messages import MRAD
from companion.autopilot.vehicle.vehicle import ArmState, Vehicle
from companion.formats import printable
from companion.messages import ANY
from companion.physics.frames import Array
from companion.physics.magnetic import heading_rad
from companion.physics.units import MG, G
from companion.samples import Triad, rows_of

_PREFIX: Final = re.compile(r"(PreArm|Arm|Preflight Fail): *")
_REPEATED_S: Final = 40.0  # Age at which a text is void without SYS_STATUS: ArduPilot repeats its list every 30 s
_LIST_S: Final = 3.0  # Longest time between texts of one list, which replaces the list before
_CHUNK: Final = 50  # Length of all chunks of a text but the last
_LONGEST: Final = 400  # Length at which a text is cut
_MOST: Final = 32  # Reasons stored, as any device on the link can send texts
_CHECKS: Final[int] = mavlink.MAV_SYS_STATUS_PREARM_CHECK
_BITS: Final = {1: "gyro", 2: "accelerometer", 4: "compass", 32: "GNSS", 16384: "position"}  # Of MAV_SYS_STATUS_SENSOR
_MEAN_S: Final = 3.0
_ASK_S: Final = 0.5
_AT_REST: Final = np.repeat([0.03, 0.5], 3)  # Largest spread of readings at rest, rad/s and m/s^2
_UNDECIDED: Final = 2.0  # Ratio of two sensors' errors below which neither is called wrong
_INSTANCES: Final[Mapping[str, int]] = {"RAW_IMU": 1, "SCALED_IMU": 1, "SCALED_IMU2": 2, "SCALED_IMU3": 3}
FIELD, DEGC = slice(6, 9), 9  # Columns of a mean: magnetic field (any unit), temperature (deg C, 0: unknown)


Sensor = Literal["gyro", "accel", "compass"]
Limits = Mapping[str, tuple[str, float]]


class Cause(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One table of prearm.toml, which describes the fields."""

    remedy: str
    texts: tuple[tuple[str, str, str], ...]
    sensors: Mapping[Sensor, Limits] = {}
    fix: str = ""
    waits: bool = False


class Reason(NamedTuple):
    """One reason against arming, as the firmware words it; times of the event loop."""

    text: str
    cause: Cause | None
    since_s: float
    seen_s: float


@functools.cache
def patterns() -> list[tuple[re.Pattern[str], Cause]]:
    table = (Path(firmware.__path__[0]) / "prearm.toml").read_text(encoding="utf-8")
    causes = msgspec.convert(tomllib.loads(table), dict[str, Cause]).values()
    found = [(text, cause) for cause in causes for _, text, _ in cause.texts]
    return [(re.compile(".*".join(map(re.escape, text.split(ANY)))), cause) for text, cause in found]


def cause_of(text: str) -> Cause | None:
    bare = _PREFIX.sub("", text, count=1)
    return next((cause for pattern, cause in patterns() if pattern.fullmatch(bare)), None)


class PrearmWatch:
    """Collects the autopilot's present reasons against arming, and the readings of all its IMUs."""

    def __init__(self, vehicle: Vehicle) -> None:
        self._vehicle = vehicle
        self._refuses: bool | None = None  # By SYS_STATUS; None: unknown
        self._reasons: dict[str, Reason] = {}
        self._unhealthy: list[str] = []
        self._chunks: tuple[int, str] = (0, "")
        self._list_s = self._text_s = self._status_s = -math.inf  # Times of the first and last text, and of SYS_STATUS
        vehicle.hear(mavlink.MAVLink_statustext_message, self._on_text)
        vehicle.hear(mavlink.MAVLink_sys_status_message, self._on_status)
        self._seen: dict[int, deque[tuple[float, Any]]] = {number: deque(maxlen=256) for number in (1, 2, 3)}
        for name, number in _INSTANCES.items():
            keep = lambda message, t_s, seen=self._seen[number]: seen.append((t_s, message))  # noqa: E731
            vehicle.hear(getattr(mavlink, f"MAVLink_{name.lower()}_message"), keep)

    def step(self, now_s: float) -> list[Reason]:
        """List the present reasons, those that need work first; if none is named, the sensors called unhealthy."""
        if self._vehicle.arm_state is not ArmState.DISARMED:
            self._refuses, self._reasons = None, {}
        oldest_s = self._list_s if now_s - self._list_s > _LIST_S else -math.inf
        oldest_s = max(oldest_s, -math.inf if self._refuses else now_s - _REPEATED_S)
        self._reasons = {key: one for key, one in self._reasons.items() if one.seen_s >= oldest_s}
        if (self._reasons or self._refuses) and now_s - self._status_s > 2.0 * _ASK_S:
            self._vehicle.commands.request_message(mavlink.MAVLINK_MSG_ID_SYS_STATUS)
        if self._refuses and not self._reasons:
            return [Reason(text, cause_of(text), now_s, now_s) for text in self._unhealthy]
        return sorted(self._reasons.values(), key=lambda one: 2 if one.cause is None else one.cause.waits)

    def _on_status(self, message: mavlink.MAVLink_sys_status_message, t_s: float) -> None:
        used, healthy = message.onboard_control_sensors_enabled, message.onboard_control_sensors_health
        self._refuses = not healthy & _CHECKS if used & _CHECKS or self._vehicle.kind.checks_in_health_alone else None
        self._unhealthy = [f"SYS_STATUS: {what} unhealthy" for bit, what in _BITS.items() if used & ~healthy & bit]
        self._status_s = t_s
        if self._refuses is False:
            self._reasons = {}

    def _on_text(self, message: mavlink.MAVLink_statustext_message, t_s: float) -> None:
        begun = self._chunks[1] if message.chunk_seq and self._chunks[0] == message.id else ""
        text = (begun + message.text)[:_LONGEST]
        self._chunks = message.id, text
        whole = not message.id or len(message.text) < _CHUNK
        if whole and _PREFIX.match(text) and message.severity <= mavlink.MAV_SEVERITY_WARNING:
            if t_s - self._text_s > _LIST_S:
                self._list_s = t_s
            text, self._text_s = printable(text.strip()), t_s
            key = re.sub(r"-?\d+(\.\d+)?", "", _PREFIX.sub("", text))  # A repeated text has other numbers
            if key in self._reasons or len(self._reasons) < _MOST:
                since_s = self._reasons[key].since_s if key in self._reasons else t_s
                self._reasons[key] = Reason(text, cause_of(text), since_s, t_s)

    def compare(self, now_s: float) -> dict[int, Array]:
        """Return each IMU's mean, (10,): rates (rad/s), forces (m/s^2), field (0: raw), degC; empty if it moves.

        A message of each IMU that sends none is requested: requesting a rate could slow down the IMU's own stream.
        """
        means = {}
        for instance, kind in self._vehicle.kind.compass_messages.items():  # they carry the IMU too
            if not self._seen[instance] or now_s - self._seen[instance][-1][0] > _ASK_S:
                self._vehicle.commands.request_message(kind.id)
        for instance, messages in self._seen.items():
            rows = np.array([self._row(message) for t_s, message in messages if t_s >= now_s - _MEAN_S])
            if len(rows) and (np.ptp(rows[:, :6], axis=0) > _AT_REST).any():
                return {}
            if len(rows) > 1 and rows[:, 3:6].any():  # all zero: no such IMU
                means[instance] = rows.mean(axis=0)
        return means

    def _row(self, message: Any) -> Array:
        field = np.multiply((message.xmag, message.ymag, message.zmag), not self._vehicle.kind.raw_fields)
        gyro, accel = (message.xgyro, message.ygyro, message.zgyro), (message.xacc, message.yacc, message.zacc)
        return np.concatenate([np.multiply(gyro, MRAD), np.multiply(accel, MG), field, [message.temperature * 0.01]])


Means = Mapping[int, Array]
OddSensor = tuple[int | None, str, float, tuple[int, ...]]  # Instance (None: undecided), axis, error (SI), the others


def odd_imu(means: Means, triad: Triad, up: Array | None) -> OddSensor | None:
    """Find the IMU with the largest error at rest, by the unit vector `up`, (3,), or of three by the others."""
    outputs = {instance: mean[rows_of(triad)] for instance, mean in means.items()}
    if not outputs:
        return None
    usual = np.median([*outputs.values()], axis=0) if len(outputs) > 2 else outputs[min(outputs)]
    truth = np.zeros(3) if triad == "gyro" else usual if up is None else G * up
    known = triad == "gyro" or up is not None or len(outputs) > 2
    return _worst({instance: output - truth for instance, output in outputs.items()}, known=known)


def odd_compass(means: Means, heading: float | None) -> OddSensor | None:
    """Find the compass that differs most from the best one by the `heading` (rad), or of three by the others."""
    ups = {one: mean[3:6] / np.linalg.norm(mean[3:6]) for one, mean in means.items() if mean[FIELD].any()}
    headings = {one: heading_rad(means[one][FIELD], up) for one, up in ups.items()}
    if len(headings) < 2:
        return None
    start = next(iter(headings.values())) if heading is None else heading
    apart = {one: math.remainder(each - start, math.tau) for one, each in headings.items()}
    best = statistics.median_low(apart.values()) if heading is None else min(apart.values(), key=abs)
    errors = {one: np.array([math.remainder(each - best, math.tau)]) for one, each in apart.items()}
    return _worst(errors, known=heading is not None or len(errors) > 2)


def _worst(errors: Mapping[int, Array], *, known: bool) -> OddSensor:
    """Return the sensor with the largest error; undecided unless the truth is `known` and the next error is smaller."""
    sizes = {instance: float(np.linalg.norm(error)) for instance, error in errors.items()}
    order = sorted(sizes, key=sizes.__getitem__, reverse=True)
    decided = known and all(sizes[order[0]] > _UNDECIDED * sizes[other] for other in order[1:])
    axis = int(np.abs(errors[order[0]]).argmax())
    name = "xyz"[axis] if len(errors[order[0]]) == 3 else "heading"
    return order[0] if decided else None, name, float(errors[order[0]][axis]), tuple(sorted(order[decided:]))

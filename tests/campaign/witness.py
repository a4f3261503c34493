"""Judges from outside: what passes the wire, what the autopilot really holds, what lies on the disk."""

from __future__ import annotations

import contextlib
import json
import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests.campaign.stage import Stage
from tests.support.component import CALIBRATE, CANCEL, IN_PROGRESS, UNDO

COMMANDS = (CALIBRATE, CANCEL, UNDO)
SILENT_S = 2.0
"""Between two heartbeats of the companion; and so long after the autopilot's last one its arming is not known."""
SIGMAS = 5.0

Values = dict[str, float]


class Witness:
    """Listens at the companion's end of the wire with parsers of its own."""

    def __init__(self, stage: Stage) -> None:
        self._stage = stage
        self.faults: list[str] = []
        self.writes = 0
        self.longest_silence_s = 0.0
        self._autopilot_s = -1e9
        self._armed = True
        self._beat_s: float | None = None
        self._open: dict[tuple[int, int, int], float] = {}
        self._finals: dict[tuple[int, int, int], tuple[float, int]] = {}
        self._repeat_s: dict[tuple[int, int, int], float] = {}
        self._packets: dict[bytes, float] = {}
        self._held: dict[str, set[float]] = {}
        self._look()
        self._parsers = {True: _parser(), False: _parser()}
        stage.wire.seen = self._see
        stage.on_start = self._on_start

    def silence_s(self, now_s: float) -> float:
        """The longest between two heartbeats of the companion, the present pause included."""
        return max(self.longest_silence_s, math.inf if self._beat_s is None else now_s - self._beat_s)

    @property
    def open_requests(self) -> list[int]:
        """Commands that wait for their one final answer."""
        return [key[2] for key in self._open]

    def _on_start(self) -> None:
        """A new daemon: what the dead one had promised is void, and it knows nothing of the autopilot yet."""
        self._open.clear()
        self._beat_s, self._autopilot_s, self._armed = None, -1e9, True
        self._parsers = {True: _parser(), False: _parser()}

    def _see(self, data: bytes, inbound: bool, t_s: float) -> None:
        for message in self._parsers[inbound](data):
            if inbound:
                self._came(message, t_s)
            else:
                self._left(message, t_s)

    def _came(self, message: mavlink.MAVLink_message, t_s: float) -> None:
        if isinstance(message, mavlink.MAVLink_heartbeat_message):
            if (message.get_srcSystem(), message.get_srcComponent()) == (1, 1):
                self._autopilot_s, self._armed = t_s, bool(message.base_mode & 128)
                self._look()
        elif isinstance(message, mavlink.MAVLink_command_long_message):
            sender = (message.get_srcSystem(), message.get_srcComponent())
            if (message.target_system, message.target_component) != (1, 191) or message.command not in COMMANDS:
                return
            if sender == (1, 191):
                return  # our own echo asks for nothing
            packet = bytes(message.get_msgbuf())
            self._packets = {data: at_s for data, at_s in self._packets.items() if t_s - at_s < 0.5}
            copy = packet in self._packets
            self._packets[packet] = t_s
            if copy:
                return
            key = (*sender, message.command)
            if message.confirmation > 0 or key in self._open:
                self._repeat_s[key] = t_s
            recently = t_s - self._finals.get(key, (-1e9, 0))[0] < 3.0
            if not (message.confirmation > 0 and recently):
                self._open.setdefault(key, t_s)

    def _left(self, message: mavlink.MAVLink_message, t_s: float) -> None:
        if isinstance(message, mavlink.MAVLink_heartbeat_message):
            if self._beat_s is not None:
                self.longest_silence_s = max(self.longest_silence_s, t_s - self._beat_s)
            self._beat_s = t_s
        elif isinstance(message, mavlink.MAVLink_param_set_message):
            self.writes += 1
            if self._armed or t_s - self._autopilot_s >= SILENT_S:
                self.faults.append(
                    f"PARAM_SET {message.param_id} at {t_s:.3f}: armed {self._armed},"
                    f" heartbeat {t_s - self._autopilot_s:.3f} s ago"
                )
            self._judge_set(message)
        elif isinstance(message, mavlink.MAVLink_play_tune_message):
            if self._armed or t_s - self._autopilot_s >= SILENT_S:
                self.faults.append(f"a tune at {t_s:.3f}: armed {self._armed}")
        elif isinstance(message, mavlink.MAVLink_command_ack_message) and message.command in COMMANDS:
            self._answered(message, t_s)

    def _judge_set(self, message: mavlink.MAVLink_param_set_message) -> None:
        """Only IMU 1's offsets get new values; all else at most gets back what it had (the firmware's own gyro
        calibration, which we start, changes the others' too)."""
        name, value = message.param_id, message.param_value
        if re.fullmatch(MAY_BE_SET, name):
            return
        if not any(same(value, old) for old in self._held.get(name, ())):
            self.faults.append(f"PARAM_SET of {name} to {value:.6g}, which it never had: {self._held.get(name)}")

    def _look(self) -> None:
        """Record the autopilot's true values at every heartbeat."""
        for name in WATCHED[self._stage.variant.name == "PX4"]:
            self._held.setdefault(name, set()).add(self._stage.autopilot.parameter(name))

    def _answered(self, message: mavlink.MAVLink_command_ack_message, t_s: float) -> None:
        if message.result == IN_PROGRESS:
            return
        key = (message.target_system, message.target_component, message.command)
        if key in self._open:
            del self._open[key]
        elif t_s - self._repeat_s.get(key, -1e9) > 0.5:
            self.faults.append(f"a second final answer to {key} at {t_s:.3f}")
        self._finals[key] = (t_s, message.result)


MAY_BE_SET = r"INS_(GYR|ACC)OFFS_[XYZ]|CAL_(GYRO|ACC)0_[XYZ]OFF"
"""Parameters of IMU 1, the calibrated one.

Its slot on PX4 is the first, as on a board whose drivers start in slot order: docs/faults.md has the others.
"""
WATCHED = {
    True: [f"CAL_{sensor}1_{axis}OFF" for sensor in ("ACC", "GYRO") for axis in "XYZ"],
    False: [
        *(f"INS_{sensor}{n}OFFS_{axis}" for sensor in ("ACC", "GYR") for n in ("", "2") for axis in "XYZ"),
        *(f"INS_GYR{n}_CALTEMP" for n in "12"),
        *(f"INS_TCAL{n}_ENABLE" for n in "12"),
    ],
}
"""Key: is it PX4."""


def same(one: float, other: float) -> bool:
    return bool(np.float32(one) == np.float32(other))


_OF_INTEREST = frozenset({0, 23, 76, 77})
"""HEARTBEAT, PARAM_SET, COMMAND_LONG, COMMAND_ACK."""


def _parser() -> Any:
    """A function that makes messages out of the packets of a wire, whatever has become of them."""
    codec = mavlink.MAVLink(None)

    def parse(data: bytes) -> Iterator[mavlink.MAVLink_message]:
        if len(data) < 12 or data[0] != 0xFD or int.from_bytes(data[7:10], "little") not in _OF_INTEREST:
            return
        with contextlib.suppress(mavlink.MAVError):
            yield codec.decode(bytearray(data))

    return parse


# --- the autopilot


def vectors(stage: Stage) -> Values:
    """The offsets of IMU 1, the one that is calibrated."""
    return {name: stage.autopilot.parameter(name) for name in _names(stage, "1")}


def others(stage: Stage) -> Values:
    """The offsets of IMU 2, which is none of ours; ArduPilot's own gyro calibration sets those of all its gyros."""
    px4 = stage.variant.name == "PX4"
    return {name: stage.autopilot.parameter(name) for name in _names(stage, "2") if px4 or "ACC" in name}


def _names(stage: Stage, which: str) -> list[str]:
    if stage.variant.name == "PX4":
        slot = str(int(which) - 1)
        return [f"CAL_{sensor}{slot}_{axis}OFF" for sensor in ("ACC", "GYRO") for axis in "XYZ"]
    number = "" if which == "1" else which
    return [f"INS_{sensor}{number}OFFS_{axis}" for sensor in ("ACC", "GYR") for axis in "XYZ"]


def half_written(now: Values, *known: Values) -> list[str]:
    """Vectors that are neither as they were nor as a calibration that says "done" has left them."""
    names = sorted(now)
    found = []
    for part in (names[:3], names[3:]):
        if all(any(abs(now[name] - each[name]) > 1e-9 for name in part) for each in known):
            found.append(f"half written: {', '.join(f'{name} {now[name]:.6g}' for name in part)}")
    return found


def undoable(stage: Stage) -> list[Values]:
    """Values left by finished writes, by the values for undo: a power cut may have come before their record."""
    found = []
    for path in stage.store.glob("undo-*.json"):
        with contextlib.suppress(ValueError, KeyError, TypeError):
            for step in json.loads(path.read_bytes())["steps"]:
                found.append({c["parameter"]: c["after"] for c in step["changes"]})
    return found


def off_truth(stage: Stage, record: Any) -> list[str]:
    """Compare the active calibration, and the own IMU's in the record, with the simulator's truth."""
    found = []
    left = stage.autopilot.residual(1, stage.now_s)
    true = stage.own_model.true_bias(stage.aircraft.time_at(stage.now_s))
    for imu in record.imus:
        pairs = {
            "gyro": (imu.gyro_bias_rad_s, left.gyro_rad_s, true.gyro_rad_s, imu.gyro_sigma_use_rad_s),
            "accelerometer": (imu.accel_bias_m_s2, left.accel_m_s2, true.accel_m_s2, imu.accel_sigma_use_m_s2),
        }
        for sensor, (bias, residual, truth, sigma) in pairs.items():
            if bias is None or sigma is None:
                continue
            error = residual if imu.name == "fc" else np.subtract(bias, truth)
            if imu.name == "fc" and not any(_sensor(name) == sensor for name in imu.written):
                continue
            worst = float(np.abs(error / np.asarray(sigma)).max())
            if worst > SIGMAS:
                found.append(f"{imu.name} {sensor} is {worst:.1f} sigma off: {error}, sigma {sigma}")
    return found


def _sensor(parameter: str) -> str:
    return "accelerometer" if "ACC" in parameter else "gyro"


# --- the disk


def lost(before: dict[str, bytes], folder: Path, spoilt: set[str]) -> list[str]:
    """Records that were kept before and are not there, or other ones, now."""
    found = []
    for name, content in before.items():
        path = folder / name
        if name in spoilt:
            continue
        if not path.exists():
            found.append(f"{name} is gone")
        elif path.read_bytes() != content and "undone_at" not in json.loads(path.read_bytes() or b"{}"):
            found.append(f"{name} has changed")
    return found


def kept(folder: Path) -> dict[str, bytes]:
    """The records on the disk, by path below the folder."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in (folder / "records").glob("??????.json")}


def unreadable(folder: Path, spoilt: set[str]) -> list[str]:
    """JSON files that are cut off or otherwise none, and what a crash has left lying about."""
    found = []
    for path in folder.rglob("*.json"):
        if str(path.relative_to(folder)) in spoilt:
            continue
        try:
            json.loads(path.read_bytes())
        except ValueError as error:
            found.append(f"{path.name}: {error}")
    return found

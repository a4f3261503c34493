"""The script that one would write instead of the daemon: a thread a port, pyserial, pymavlink's `mavutil`.

It is what `tests.bench_daemon` compares the daemon's processor time with, so it is written as such scripts are, and
fairly: whole reads instead of single bytes, a CRC in C, no numpy for three numbers, no printing. It does the least of
what the daemon does. It reads an IMU, a gradienter and a compass, and subtracts a given bias. A complementary filter
carries the attitude, which it sends 50 times a second. It keeps the last message of each kind.
It knows nothing of stillness, calibration, faults, records, people.
"""

from __future__ import annotations

import binascii
import math
import re
import struct
import threading
import time
from collections import Counter
from typing import Any

import serial
from pymavlink import mavutil
from pymavlink.dialects.v20 import ardupilotmega as mavlink

RATE_HZ = 50.0
_VECTORNAV = struct.Struct("<Q7f")
_FRAME_BYTES = 44
_TILT = re.compile(rb"([XY])=([+-]\d+\.\d+)\r\n")
_HEADING = re.compile(rb"\s*(-?\d+\.\d+),\s*(-?\d+\.\d+),\s*(-?\d+\.\d+)\r\n")


class Attitude:
    """A complementary filter: gyros for what is quick, gravity and compass for what is slow."""

    def __init__(self, gyro_bias_rad_s: tuple[float, float, float]) -> None:
        self.lock = threading.Lock()
        self.roll = self.pitch = self.yaw = 0.0
        self.heading: float | None = None
        self.tilt = {b"X": 0.0, b"Y": 0.0}
        self.last_s: float | None = None
        self.bias = gyro_bias_rad_s

    def imu(self, t_s: float, gx: float, gy: float, gz: float, ax: float, ay: float, az: float) -> None:
        with self.lock:
            last_s, self.last_s = self.last_s, t_s
            if last_s is None or not 0.0 < t_s - last_s < 0.1:
                return
            dt = t_s - last_s
            bx, by, bz = self.bias
            p, q, r = gx - bx, gy - by, gz - bz
            sin, cos, tan = math.sin(self.roll), math.cos(self.roll), math.tan(self.pitch)
            self.roll += (p + (q * sin + r * cos) * tan) * dt
            self.pitch += (q * cos - r * sin) * dt
            self.yaw += (q * sin + r * cos) / math.cos(self.pitch) * dt
            keep = dt / 3.0
            self.roll += keep * (math.atan2(-ay, -az) - self.roll)
            self.pitch += keep * (math.atan2(ax, math.hypot(ay, az)) - self.pitch)
            if self.heading is not None:
                self.yaw += keep * math.remainder(self.heading - self.yaw, 2.0 * math.pi)


class Reader(threading.Thread):
    """Reads one port: whatever has come, at least one byte (as pyserial's own ReaderThread does)."""

    def __init__(self, port: str, baud: int, attitude: Attitude, counts: Counter[str]) -> None:
        super().__init__(daemon=True)
        self.port = serial.Serial(port, baud, timeout=1.0)
        self.attitude, self.counts = attitude, counts
        self.buffer = b""

    def run(self) -> None:
        port = self.port
        while True:
            self.buffer += port.read(port.in_waiting or 1)
            self.parse()

    def parse(self) -> None:
        raise NotImplementedError


class VectorNav(Reader):
    def parse(self) -> None:
        while True:
            start = self.buffer.find(b"\xfa")
            if start < 0:
                self.buffer = b""
                return
            frame = self.buffer[start : start + _FRAME_BYTES]
            if len(frame) < _FRAME_BYTES:
                self.buffer = self.buffer[start:]
                return
            if frame[1:6] != b"\x05\x21\x01\x10\x00" or binascii.crc_hqx(frame[1:], 0) != 0:
                self.buffer = self.buffer[start + 1 :]
                continue
            self.buffer = self.buffer[start + _FRAME_BYTES :]
            startup_ns, gx, gy, gz, ax, ay, az, _ = _VECTORNAV.unpack_from(frame, 6)
            self.attitude.imu(startup_ns * 1e-9, gx, gy, gz, ax, ay, az)
            self.counts["imu"] += 1


class ImuLine(Reader):
    def parse(self) -> None:
        *lines, self.buffer = self.buffer.split(b"\r\n")
        for line in lines:
            body, _, digits = line[1:].rpartition(b"*")
            checksum = 0
            for byte in body:
                checksum ^= byte
            if not line.startswith(b"$IMU") or f"{checksum:02X}".encode() != digits:
                continue
            _, _, t_us, gx, gy, gz, ax, ay, az, _ = map(float, body.replace(b"IMU", b"0").split(b","))
            self.attitude.imu(t_us * 1e-6, gx, gy, gz, ax, ay, az)
            self.counts["imu"] += 1


class Gradienter(Reader):
    def parse(self) -> None:
        end = 0
        for match in _TILT.finditer(self.buffer):
            self.attitude.tilt[match[1]] = float(match[2])
            self.counts["tilt"] += 1
            end = match.end()
        self.buffer = self.buffer[end:]


class Compass(Reader):
    def parse(self) -> None:
        end = 0
        for match in _HEADING.finditer(self.buffer):
            self.attitude.heading = math.radians(float(match[1]))
            self.counts["heading"] += 1
            end = match.end()
        self.buffer = self.buffer[end:]


class Telemetry(threading.Thread):
    """Takes every message, and keeps the last of each kind."""

    def __init__(self, master: Any, counts: Counter[str]) -> None:
        super().__init__(daemon=True)
        self.master, self.counts = master, counts
        self.latest: dict[str, Any] = {}
        self.armed = False

    def run(self) -> None:
        while True:
            message = self.master.recv_match(blocking=True, timeout=1.0)
            if message is None:
                continue
            kind = message.get_type()
            self.latest[kind] = message
            if kind == "HEARTBEAT" and message.get_srcComponent() == 1:
                self.armed = bool(message.base_mode & 128)
            self.counts["mavlink"] += 1


def send(master: Any, attitude: Attitude, counts: Counter[str]) -> None:
    """The attitude, 50 times a second, and a heartbeat."""
    covariance = [0.0] * 21
    due_s = beat_s = time.monotonic()
    while True:
        with attitude.lock:
            roll, pitch, yaw = attitude.roll, attitude.pitch, attitude.yaw
        master.mav.vision_position_estimate_send(
            int(time.monotonic() * 1e6), 0.0, 0.0, 0.0, roll, pitch, yaw, covariance, 0
        )
        counts["sent"] += 1
        if due_s >= beat_s:
            master.mav.heartbeat_send(mavlink.MAV_TYPE_ONBOARD_CONTROLLER, 8, 0, 0, 4)
            beat_s += 1.0
        due_s += 1.0 / RATE_HZ
        time.sleep(max(due_s - time.monotonic(), 0.0))


def start(ports: dict[str, tuple[str, int]], imu: str, udp: str) -> Counter[str]:
    """Start all threads; what has come and gone is counted in the result."""
    counts: Counter[str] = Counter()
    attitude = Attitude((0.0003, 0.0006, 0.0005))
    connect: Any = mavutil.mavlink_connection
    master = connect(udp, source_system=1, source_component=191)
    master.wait_heartbeat()
    kinds = {"imu": VectorNav if imu == "vectornav" else ImuLine, "gradienter": Gradienter, "compass": Compass}
    for name, kind in kinds.items():
        kind(*ports[name], attitude, counts).start()
    Telemetry(master, counts).start()
    threading.Thread(target=send, args=(master, attitude, counts), daemon=True).start()
    return counts

"""Topics of a recording, their messages, and the queue to the thread that writes them.

Bytes received from a port are recorded unchanged; an empty message marks missing bytes. Calibration records are JSON.
All other messages are MessagePack, which preserves every float exactly, infinities included.
"""

from __future__ import annotations

from typing import Any, Final

import msgspec
import numpy as np

from companion.autopilot.firmware.imu_calibration import ImuCalibration
from companion.autopilot.firmware.imu_messages import EkfBiasReading
from companion.autopilot.parameters.change import FirmwareName
from companion.estimation.means.windows import ImuInput
from companion.estimation.solution.prior import Expectation
from companion.estimation.solution.site import Whereabouts
from companion.estimation.solution.truth import FallbackPose
from companion.estimation.turning.turn import Turn

FORMAT_VERSION: Final = "4"
METADATA: Final = "companion"  # name of the metadata record with versions and clocks
CONFIG: Final = "configuration.json"  # name of the attachment with the active configuration
SERIAL: Final = "/serial/"  # prefix of the topic for bytes from a serial port; the device's name follows
MAVLINK: Final = "/mavlink/in"
IMU: Final = "/autopilot/imu/"  # prefix of the topic for `ImuState`; the name of the IMU follows
EKF_BIAS: Final = "/autopilot/ekf_bias"
RAW_MEAN: Final = "/autopilot/raw_mean"
PLACE: Final = "/companion/place"
START: Final = "/companion/start"
TICK: Final = "/companion/tick"  # empty message: the sample collector was called at the message's time
MEASURED, SOLVED, RECORD = "/companion/measured", "/companion/solved", "/companion/record"

Message = tuple[str, float, bytes]  # topic, time on the daemon's clock, data


class Start(msgspec.Struct, frozen=True):
    """Message at the start of each recording file, and at a restart after a gap."""

    lost: int = 0  # messages dropped just before, because the disk was too slow
    continues: bool = False  # True: this file begins where the previous one of the ring ends


class ImuState(msgspec.Struct, frozen=True, kw_only=True):
    """State of one autopilot IMU from this message's time on: calibration, and name of the message with its samples."""

    sender: tuple[int, int]  # system and component id of the autopilot
    firmware: FirmwareName | None
    instance: int
    message: str | None  # name of the `ImuMessage` with its samples; None: no samples
    input: ImuInput
    calibration: ImuCalibration | None  # None: unknown, so its samples are not used


class RawOutput(msgspec.Struct, frozen=True):
    """Mean output of an IMU as floats, corrected by the active offsets; its single samples are only integers."""

    imu: str
    output: tuple[float, float, float, float, float, float]
    """Gyro x y z in rad/s, then accelerometer x y z in m/s^2, vehicle FRD."""
    temperature_degc: float | None


class Measured(msgspec.Struct, frozen=True, kw_only=True):
    """Measurement over a time window. All fields but start and end may depend on samples from before the recording."""

    start_s: float
    end_s: float
    wander_deg: float | None
    begun_s: dict[str, float]
    turn: Turn


class Solved(msgspec.Struct, frozen=True, kw_only=True):
    """Inputs of the bias estimator besides the latest window: recorded so that a replay gets the same result."""

    where: Whereabouts
    what: str
    alignment: tuple[float, float, float] | None  # zero of the gradienter: offset x and y, and sigma, in degrees
    otherwise: FallbackPose
    expectation: Expectation


_TYPES: Final[dict[str, Any]] = {
    EKF_BIAS: EkfBiasReading,
    RAW_MEAN: RawOutput,
    PLACE: Whereabouts,
    START: Start,
    MEASURED: Measured,
    SOLVED: Solved,
}
MOST_BYTES: Final = 1024 * 1024  # most bytes of one MessagePack message; usual ones have some thousand


def encoding(topic: str) -> str:
    if topic.startswith(SERIAL) or topic in (MAVLINK, TICK):
        return "bytes"
    return "json" if topic == RECORD else "msgpack"


def encode(message: Any) -> bytes:
    return msgspec.msgpack.encode(message, enc_hook=_plain)


def decode(topic: str, data: bytes) -> Any:
    if len(data) > MOST_BYTES:
        raise ValueError(f"found {len(data)} bytes; allowed: {MOST_BYTES}")
    kind = ImuState if topic.startswith(IMU) else _TYPES[topic]
    return msgspec.msgpack.decode(data, type=kind, dec_hook=lambda _kind, plain: np.array(plain, dtype=np.float64))


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"a {type(value).__name__} is not known to recordings")


MOST_MESSAGES: Final = 12_000
"""Most queued messages: 15 s of a 200 Hz IMU and 100 Hz telemetry, longer than a memory card stalls."""
MOST_WAITING_BYTES: Final = 2 * 1024 * 1024  # most queued bytes: 15 s of an IMU at 1 kHz have 1.4 MB


class Tape:
    """Queue of limited size to the writing thread. If full, it drops all messages: a replay cannot bridge a gap."""

    def __init__(self) -> None:
        self.is_on = False  # True: messages are queued. State messages are stored in any case
        self.lost = 0  # messages dropped since `begin`; once there is one, all further ones are dropped too
        self.lost_in_all = 0
        self._waiting: list[Message] = []
        self._bytes = 0
        self._states: dict[str, Message] = {}
        self._since_s = 0.0
        self._states_before: list[Message] = []

    def __len__(self) -> int:
        return len(self._waiting)

    def begin(self, t_s: float) -> None:
        self._waiting = [(START, t_s, encode(Start(lost=self.lost))), *self._states.values()]
        self.is_on, self.lost, self._bytes = True, 0, 0
        self._since_s, self._states_before = t_s, []

    def end(self) -> None:
        self.is_on, self.lost, self._bytes, self._waiting = False, 0, 0, []

    def drain(self, now_s: float) -> tuple[float, list[Message], list[Message]]:
        batch = self._since_s, self._states_before, self._waiting
        self._since_s, self._states_before = now_s, list(self._states.values())
        self._waiting, self._bytes = [], 0
        return batch

    def put(self, topic: str, t_s: float, data: bytes) -> None:
        if not self.is_on:
            return
        if self.lost:
            self._lose(1)
        elif len(self._waiting) >= MOST_MESSAGES or self._bytes + len(data) > MOST_WAITING_BYTES:
            self._lose(len(self._waiting) + 1)
            self._waiting, self._bytes = [], 0
        else:
            self._bytes += len(data)
            self._waiting.append((topic, t_s, data))

    def put_state(self, topic: str, t_s: float, data: bytes) -> None:
        """Add a state message. It applies until the topic's next one; later files begin with each topic's latest."""
        self._states[topic] = (topic, t_s, data)
        self.put(topic, t_s, data)

    def _lose(self, number: int) -> None:
        self.lost += number
        self.lost_in_all += number


_ID: Final = (256).to_bytes(3, "little")
"""Message id of SETUP_SIGNING (256) in a MAVLink 2 header; MAVLink 1 has no ids above 255."""
_ID_AT: Final = 7
_HEADER: Final = 10
_MARKER: Final = 0xFD


class KeyFilter:
    """Filter that zeroes the secret key in MAVLink's SETUP_SIGNING, because recordings may be given to others.

    Autopilots forward this message. Use one filter for each direction of each link, and pass it all bytes in order.
    """

    def __init__(self) -> None:
        self._before = b""
        self._left = 0  # bytes not received yet of a payload that has begun

    def __call__(self, data: bytes) -> bytes:
        known = self._before + data
        self._before = known[1 - _HEADER :]
        if not self._left and _ID not in known:
            return data
        return self._blank(known, len(known) - len(data))

    def restart(self) -> None:
        """Discard a partly received message; call this where bytes are missing."""
        self._before, self._left = b"", 0

    def _blank(self, known: bytes, behind: int) -> bytes:
        out = bytearray(known)
        end = behind + self._left
        out[behind:end] = bytes(min(self._left, len(out) - behind))
        place = known.find(_ID)
        while place >= 0:
            start = place - _ID_AT
            if start >= 0 and known[start] == _MARKER:
                payload, end_here = start + _HEADER, start + _HEADER + known[start + 1]
                out[payload:end_here] = bytes(max(0, min(end_here, len(out)) - payload))
                end = max(end, end_here)
            place = known.find(_ID, place + 1)
        self._left = max(0, end - len(known))
        return bytes(out[behind:])

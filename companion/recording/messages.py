"""Topics of a recording, and the messages on them.

Raw bytes are recorded as they came; an empty message means that bytes are missing there. Records are JSON. Everything
else is MessagePack, which keeps every float to the last bit, infinities included.
"""

from __future__ import annotations

from typing import Any, Final

import msgspec
import numpy as np

from companion.autopilot.firmware.imu_calibration import ImuCalibration
from companion.autopilot.firmware.imu_messages import EkfBiasReading
from companion.autopilot.parameters.reading import FirmwareName
from companion.estimation.means.windows import ImuInput
from companion.estimation.solution.prior import Expectation
from companion.estimation.solution.site import Whereabouts
from companion.estimation.solution.truth import Otherwise
from companion.estimation.turning.turn import Turn

FORMAT_VERSION: Final = "4"
METADATA: Final = "companion"
"""Name of the metadata record with versions and clocks."""
CONFIG: Final = "configuration.json"
"""Name of the attachment with the configuration in force."""
SERIAL: Final = "/serial/"
"""Prefix of the raw bytes of a port; the name of the device follows."""
MAVLINK: Final = "/mavlink/in"
IMU: Final = "/autopilot/imu/"
"""Prefix of `ImuState`; the name of the IMU follows."""
EKF_BIAS: Final = "/autopilot/ekf_bias"
RAW_MEAN: Final = "/autopilot/raw_mean"
PLACE: Final = "/companion/place"
START: Final = "/companion/start"
TICK: Final = "/companion/tick"
"""Empty: the collector was told the time."""
MEASURED, SOLVED, RECORD = "/companion/measured", "/companion/solved", "/companion/record"

Message = tuple[str, float, bytes]
"""Topic, time on the daemon's clock, data."""


class Start(msgspec.Struct, frozen=True):
    """A recording begins here, or begins anew after a gap."""

    lost: int = 0
    """Messages dropped right before, because the disk did not keep up."""
    continues: bool = False
    """True: the file before this one in the ring ends where this one begins."""


class ImuState(msgspec.Struct, frozen=True, kw_only=True):
    """One IMU of the autopilot from here on: its messages, and the parameters that correct it."""

    sender: tuple[int, int]
    """System and component id of the autopilot."""
    firmware: FirmwareName | None
    instance: int
    message: str | None
    """Name of the `ImuMessage` that its samples come in; None: none come."""
    input: ImuInput
    calibration: ImuCalibration | None
    """None: not known, so that its samples do not count."""


class RawOutput(msgspec.Struct, frozen=True):
    """A mean in floats beside an IMU's stream of integers, less the offsets in force."""

    imu: str
    output: tuple[float, float, float, float, float, float]
    """Gyro in rad/s, accelerometer in m/s^2, vehicle FRD."""
    temperature_degc: float | None


class Measured(msgspec.Struct, frozen=True, kw_only=True):
    """A window of the still stretch was taken.

    What is known besides its ends may go back to before the recording began.
    """

    start_s: float
    end_s: float
    wander_deg: float | None
    begun_s: dict[str, float]
    turn: Turn


class Solved(msgspec.Struct, frozen=True, kw_only=True):
    """A calibration was worked out from the latest window; everything else that it was made from."""

    where: Whereabouts
    what: str
    alignment: tuple[float, float, float] | None
    """The gradienter's zero: offset x and y, and sigma, in degrees."""
    otherwise: Otherwise
    expectation: Expectation


_TYPES: Final[dict[str, Any]] = {
    EKF_BIAS: EkfBiasReading,
    RAW_MEAN: RawOutput,
    PLACE: Whereabouts,
    START: Start,
    MEASURED: Measured,
    SOLVED: Solved,
}
MOST_BYTES: Final = 1024 * 1024
"""The most bytes of one of these messages; ours have some thousand."""


def encoding(topic: str) -> str:
    """Return the encoding of the messages on a topic, as MCAP calls it."""
    if topic.startswith(SERIAL) or topic in (MAVLINK, TICK):
        return "bytes"
    return "json" if topic == RECORD else "msgpack"


def encode(message: Any) -> bytes:
    """Encode one of the structs above."""
    return msgspec.msgpack.encode(message, enc_hook=_plain)


def decode(topic: str, data: bytes) -> Any:
    """Decode the struct of a topic."""
    if len(data) > MOST_BYTES:
        raise ValueError(f"found {len(data)} bytes; allowed: {MOST_BYTES}")
    kind = ImuState if topic.startswith(IMU) else _TYPES[topic]
    return msgspec.msgpack.decode(data, type=kind, dec_hook=_array)


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"a {type(value).__name__} is not known to recordings")


def _array(_kind: Any, plain: Any) -> Any:
    return np.array(plain, dtype=np.float64)

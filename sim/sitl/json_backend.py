"""The physics of an ArduPilot SITL: answers every servo packet with one frame of the virtual aircraft, over UDP.

The firmware sends its servo outputs, one packet a frame, and waits for one answer: a line of JSON with the physics time
and what the IMU feels (the interface's own description and autopilots 9.3). Its reader looks for names in the text,
takes the first match, and needs a newline on either side; it is no JSON parser, so the text has a fixed order and no
name that contains another.
"""

from __future__ import annotations

import asyncio
import contextlib
import socket
import struct
from typing import NamedTuple, Self

from sim.aircraft import VirtualAircraft
from sim.imu_model import ImuModel
from sim.sitl.samples import Sample, SampleBlocks

MAGIC_16, MAGIC_32 = 18458, 29569
_HEAD = struct.Struct("<HHI")
_CHANNELS = {MAGIC_16: struct.Struct("<16H"), MAGIC_32: struct.Struct("<32H")}


class ServoPacket(NamedTuple):
    """A frame of the firmware's servo outputs."""

    frame_rate_hz: int
    """Frame rate, the inverse of the step."""
    frame_count: int
    """Counter that grows by one with every answered frame and restarts with the firmware. Repeated: answer lost."""
    pwm_us: tuple[int, ...]
    """Pulse widths of 16 channels, or 32 with SERVO_32_ENABLE."""


def decode_servos(data: bytes) -> ServoPacket | None:
    """Decode a servo packet; None for anything else."""
    if len(data) < _HEAD.size:
        return None
    magic, rate, count = _HEAD.unpack_from(data)
    channels = _CHANNELS.get(magic)
    if channels is None or len(data) != _HEAD.size + channels.size or rate == 0:
        return None
    return ServoPacket(rate, count, channels.unpack_from(data, _HEAD.size))


def encode_frame(physics_s: float, sample: Sample) -> bytes:
    """Encode the answer: the sample's first IMU, the true attitude, and a vehicle that stays at its place."""
    return (
        b'\n{"timestamp":%.6f,"imu":{"gyro":[%.9g,%.9g,%.9g],"accel_body":[%.9g,%.9g,%.9g]},'
        b'"position":[0,0,0],"attitude":[%.8f,%.8f,%.8f],"velocity":[0,0,0]}\n'
        % (physics_s, *sample.readings[0], *sample.angles_rad)
    )


_LARGEST_PACKET = 256
_ASKS_AGAIN_S = 0.5
"""Time after our answer within which a repeated packet is ignored: the firmware repeats it only after a second."""


class JsonBackend:
    """Readings of one IMU for one firmware; all its IMU instances use them (autopilots 9.3).

    An async context manager on any real event loop. The firmware sets the pace by the wall clock, so nothing waits
    here. The reader is bare (no transport): at 1000 frames a second that halves the cost.

    Args:
        aircraft: the truth.
        imu: the model.
        port: UDP port on 127.0.0.1; 0 takes a free one, see `port`.
    """

    def __init__(self, aircraft: VirtualAircraft, imu: ImuModel, *, port: int = 0) -> None:
        self._aircraft = aircraft
        self.blocks = SampleBlocks(aircraft, [imu])
        self._wanted_port = port
        self._socket: socket.socket | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._peer: tuple[str, int] | None = None
        self._count = -1
        self.physics_s = 0.0
        self._last = b""
        self._last_s = 0.0
        self.port = 0
        self.boots = 0
        """Number of firmware starts seen."""
        self.frames = 0
        """Number of frames sent since the last boot."""

    async def __aenter__(self) -> Self:
        self._loop = asyncio.get_running_loop()
        self._aircraft.begin(self._loop.time())
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.setblocking(False)  # noqa: FBT003
            self._socket.bind(("127.0.0.1", self._wanted_port))
        except BaseException:
            self._socket.close()
            raise
        self.port = self._socket.getsockname()[1]
        self._loop.add_reader(self._socket.fileno(), self._readable)
        return self

    async def __aexit__(self, *exc_info: object) -> None:
        if self._socket is not None and self._loop is not None:
            self._loop.remove_reader(self._socket.fileno())
            self._socket.close()
            self._socket = None

    def _readable(self) -> None:
        assert self._socket is not None
        try:
            data, peer = self._socket.recvfrom(_LARGEST_PACKET)
        except OSError:  # nothing after all, or the firmware has gone: it is not our business here
            return
        answer = self.answer(data, peer)
        if answer:
            # A full buffer or a firmware that has gone: it asks again if it still wants to know.
            with contextlib.suppress(OSError):
                self._socket.sendto(answer, peer)

    def answer(self, data: bytes, peer: tuple[str, int]) -> bytes:
        """Return the answer to a packet, empty for an invalid packet; never raises."""
        packet = decode_servos(data)
        if packet is None:
            return b""
        if peer != self._peer or packet.frame_count < self._count:
            self._begin(peer)
        elif packet.frame_count == self._count:
            return self._again()
        return self._frame(packet)

    def _begin(self, peer: tuple[str, int]) -> None:
        """Handle a start of the firmware: reset our time to zero with the firmware's, which would leap otherwise."""
        self._peer, self._count, self.physics_s = peer, -1, 0.0
        self.blocks.restart()
        self.boots += 1
        self.frames = 0

    def _again(self) -> bytes:
        """Repeat the frame if the first answer was lost; a second answer to one packet would stay in the queue."""
        assert self._loop is not None
        now_s = self._loop.time()
        if now_s - self._last_s < _ASKS_AGAIN_S:
            return b""
        self._last_s = now_s
        return self._last

    def _frame(self, packet: ServoPacket) -> bytes:
        assert self._loop is not None
        interval_s = 1.0 / packet.frame_rate_hz
        self._count = packet.frame_count
        self.physics_s += interval_s
        self._last_s = self._loop.time()
        now_s = self._aircraft.time_at(self._last_s)
        self._last = encode_frame(self.physics_s, self.blocks.next(interval_s, now_s))
        self.frames += 1
        return self._last

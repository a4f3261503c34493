"""MAVLink 2 signing: sign each sent message, verify each received one, refuse old ones.

Specification: mavlink.io, Message Signing. A signature is 13 bytes after the checksum: link id, 48 bits of time in
units of 10 us since 2015, and the first 48 bits of SHA-256 over key, packet, link id and time. This module does not use
pymavlink's verification: pymavlink 2.4.50 adopts the time of a packet before it checks the signature. One forged packet
from the far future would then shut the genuine sender out. pymavlink also stores and logs every claimed sender.

A key file holds 32 raw bytes, 64 hexadecimal digits, or a passphrase. The key of a passphrase is SHA-256 of its UTF-8,
as in MAVProxy 1.8.75 (`passphrase_to_key`), Mission Planner (`MAVAuthKeys.AddKey`) and QGroundControl until early 2026
(`MAVLinkSigningKeys::addKey`). Later QGroundControls use PBKDF2 and accept the 64 digits as a raw key.
"""

from __future__ import annotations

import hashlib
import hmac
import os
import re
import stat
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Final, Literal

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.errors import LinkError
from companion.messages import message

EPOCH_S: Final = 1420070400
TICKS_PER_S: Final = 100_000
LAST: Final = 2**48 - 1
LATE_TICKS: Final = 60 * TICKS_PER_S
"""Largest lag of a sender's clock behind ours: one minute, as the specification allows for a sender's first message."""
BEHIND_ITSELF_TICKS: Final = 5 * TICKS_PER_S
"""Largest lag of a message behind the newest one of its sender, on any link; older ones were delayed or replayed."""
MAX_STREAMS: Final = 64
"""Maximum number of remembered streams (system, component, link id) signed with our key; later ones are refused."""
NEVER_SIGNED: Final = frozenset({mavlink.MAVLINK_MSG_ID_RADIO_STATUS, mavlink.MAVLINK_MSG_ID_RADIO})
"""Messages that a telemetry radio inserts by itself, so they are unsigned."""
EARLIEST_S: Final = 1577836800.0  # 2020: an earlier clock has not been set

_SIGNED: Final = mavlink.MAVLINK_IFLAG_SIGNED
_MARKER_1: Final = mavlink.PROTOCOL_MARKER_V1
_TAIL: Final = mavlink.MAVLINK_SIGNATURE_BLOCK_LEN
_HASH: Final = 6

Reason = Literal["unsigned", "other key", "old", "no key"]
"""Cause of a refusal. "old": repeated, late (`LATE_TICKS`, `BEHIND_ITSELF_TICKS`), or beyond `MAX_STREAMS`."""


def uptime_s() -> float:
    """Return the seconds since the board started, including sleep (monotonic)."""
    return time.clock_gettime(time.CLOCK_BOOTTIME)


def ticks_of(unix_s: float) -> int:
    """Convert Unix time to signature time; 0 for a clock that has not been set."""
    return int((unix_s - EPOCH_S) * TICKS_PER_S) if unix_s >= EARLIEST_S else 0


def sign(frame: bytes, crc_extra: int, key: bytes, link_id: int, ticks: int) -> bytes:
    """Sign an unsigned MAVLink 2 packet; its checksum changes, because it covers the flag that marks signed packets."""
    head = bytearray(frame[:-2])
    head[2] |= _SIGNED
    crc = mavlink.x25crc(head[1:])
    crc.accumulate(bytes([crc_extra]))
    head += crc.crc.to_bytes(2, "little") + bytes([link_id]) + ticks.to_bytes(6, "little")
    return bytes(head) + _digest(key, head)


def _digest(key: bytes, packet: bytes | bytearray) -> bytes:
    # The specification requires a plain hash, not an HMAC.
    return hashlib.sha256(key + packet).digest()[:_HASH]


class SigningClock:
    """Clock of signature time in ticks of 10 us: strictly increasing, whatever the system's clock does.

    The system's clock sets signature time once per boot. A later jump of the system's clock by more than a minute is
    refused. Otherwise one wrong clock would stay in the stored time and in every receiver, and genuine senders would
    look old for ever. A board without a battery-backed clock starts in 1970. Its signature time continues from `start`
    (ticks, later than any used before) and adopts the time of the first message signed with our key.
    """

    def __init__(
        self, start: int = 0, *, wall_s: Callable[[], float] = time.time, uptime: Callable[[], float] = uptime_s
    ) -> None:
        self._wall_s, self._uptime_s = wall_s, uptime
        self._base, self._base_s = start, uptime()
        self._used = 0
        self._is_set = False

    def resume(self, ticks: int, *, is_set: bool) -> None:
        """Continue from `ticks`, already used; `is_set`: set in this boot, so the system's clock cannot set it."""
        self._base, self._base_s, self._is_set = ticks, self._uptime_s(), is_set

    def now(self) -> int:
        now_s = self._uptime_s()
        ticks = self._base + int((now_s - self._base_s) * TICKS_PER_S)
        ahead = ticks_of(self._wall_s()) - ticks
        if ahead > 0 and not (self._is_set and ahead > LATE_TICKS):
            # A new base: if the system's clock then steps back, signature time does not.
            ticks += ahead
            self._base, self._base_s, self._is_set = ticks, now_s, True
        return min(max(ticks, self._used), LAST)

    def next(self) -> int:
        self._used = min(max(self.now(), self._used + 1), LAST)
        return self._used

    @property
    def ahead_of_wall_s(self) -> float:
        wall = ticks_of(self._wall_s())
        return max(0, self.now() - wall) / TICKS_PER_S if wall else 0.0

    def heard(self, ticks: int) -> None:
        if ticks > self.now():
            self._base, self._base_s, self._is_set = ticks, self._uptime_s(), True


class Signing:
    """Signing and verification of one link's messages. Refused ones are dropped if `required`, else only counted.

    Without a key every message is refused.
    """

    def __init__(self, *, required: bool, key: bytes | None = None, clock: SigningClock | None = None) -> None:
        self.required, self.key = required, key
        self.clock = clock or SigningClock()
        self.verified = 0
        self.doubted: Counter[Reason] = Counter()
        self.on_verified: Callable[[int, int], object] = lambda _system, _component: None
        self.on_refused: Callable[[Reason, int, int], object] = lambda _reason, _system, _component: None
        self._streams: dict[tuple[int, int, int], int] = {}
        self._newest: dict[tuple[int, int], int] = {}

    def __repr__(self) -> str:
        return f"Signing(required={self.required})"

    def sign(self, frame: bytes, crc_extra: int) -> bytes:
        if self.key is None:
            return frame
        return sign(frame, crc_extra, self.key, link_id=0, ticks=self.clock.next())

    def admits(self, frame: bytes | bytearray) -> bool:
        """Verify a whole packet whose checksum is correct; return True if the packet may have any effect."""
        first = frame[0] == _MARKER_1
        if (frame[5] if first else int.from_bytes(frame[7:10], "little")) in NEVER_SIGNED:
            return True
        reason = self._verify(frame)
        if reason is None:
            return True
        self.doubted[reason] += 1
        self.on_refused(reason, frame[3 if first else 5], frame[4 if first else 6])
        return not self.required

    def _verify(self, frame: bytes | bytearray) -> Reason | None:
        if self.key is None:
            return "no key"
        if frame[0] == _MARKER_1 or not frame[2] & _SIGNED:
            return "unsigned"
        if not self._is_ours(frame):
            return "other key"
        # Only a sender with the key gets here.
        ticks = int.from_bytes(frame[1 - _TAIL : -_HASH], "little")
        sender, stream = (frame[5], frame[6]), (frame[5], frame[6], frame[-_TAIL])
        newest, before = self._newest.get(sender, 0), self._streams.get(stream)
        if ticks + LATE_TICKS < self.clock.now() or ticks + BEHIND_ITSELF_TICKS < newest:
            return "old"
        if (before is None and len(self._streams) >= MAX_STREAMS) or (before is not None and ticks <= before):
            return "old"
        self._streams[stream] = ticks
        self._newest[sender] = max(ticks, newest)
        self.clock.heard(ticks)
        self.verified += 1
        self.on_verified(*sender)
        return None

    def link_id_of(self, frame: bytes | bytearray) -> int | None:
        signed = frame[0] != _MARKER_1 and frame[2] & _SIGNED
        return frame[-_TAIL] if signed and self._is_ours(frame) else None

    def _is_ours(self, frame: bytes | bytearray) -> bool:
        if self.key is None:
            return False
        return hmac.compare_digest(_digest(self.key, frame[:-_HASH]), bytes(frame[-_HASH:]))


KEY_BYTES: Final = 32
LEAST_PASSPHRASE: Final = 8
MAX_FILE_BYTES: Final = 1024


def read_key(path: Path) -> bytes:
    """Read a key of 32 bytes from a file; if it holds no usable key, raise LinkError, which never quotes the file."""
    try:
        with path.open("rb") as file:
            rights = os.fstat(file.fileno()).st_mode
            content = file.read(MAX_FILE_BYTES + 1)
    except OSError as error:
        raise _unusable(path, error.strerror or type(error).__name__) from None
    if rights & (stat.S_IROTH | stat.S_IWOTH):
        raise _unusable(path, f"everybody on this computer may open it: chmod 600 {path}")
    # The chance that 32 random bytes all look like typed text is 1 in 10^13.
    typed = all(32 <= byte < 127 or byte in b"\r\n" for byte in content)
    key = content if len(content) == KEY_BYTES and not typed else _from_text(content, path)
    if not any(key):
        # All zero means "no signing" in SETUP_SIGNING.
        raise _unusable(path, "the key is all zeros")
    return key


def _unusable(path: Path, fault: str) -> LinkError:
    return LinkError(message("signing_key_unusable", path=path, fault=fault))


def _from_text(content: bytes, path: Path) -> bytes:
    line = content.removesuffix(b"\n").removesuffix(b"\r")
    if re.fullmatch(rb"[0-9a-fA-F]{64}", line):
        return bytes.fromhex(line.decode("ascii"))
    try:
        passphrase = line.decode()
    except UnicodeDecodeError:
        passphrase = ""
    if len(content) > MAX_FILE_BYTES or len(passphrase) < LEAST_PASSPHRASE or not passphrase.isprintable():
        wanted = (
            f"32 bytes, 64 hexadecimal digits, or a passphrase of {LEAST_PASSPHRASE} characters or more on one line"
        )
        raise _unusable(path, f"found {len(content)} bytes; wanted: {wanted}")
    return hashlib.sha256(line).digest()

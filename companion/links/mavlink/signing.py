"""MAVLink 2 signing: who holds the key has sent this, and it is not an old message once more.

After the specification (mavlink.io, Message Signing): 13 bytes behind the checksum, link id, 48 bit of time in units of
10 us since 2015, and the first 48 bit of SHA-256 over key, packet, link id and time. Own code and not pymavlink's for
what comes in: pymavlink 2.4.50 takes over the time of a packet before it has looked at the signature (one forged packet
far in the future would shut the true sender out), keeps a place for every stranger that claims to be somebody, and logs
each.

A file holds the key: 32 bytes as they are, 64 hexadecimal digits, or a passphrase. Of a passphrase the key is SHA-256
of its UTF-8, as MAVProxy 1.8.75 (`passphrase_to_key`), Mission Planner (`MAVAuthKeys.AddKey`) and QGroundControl until
early 2026 (`MAVLinkSigningKeys::addKey`) make it; later QGroundControls use PBKDF2, and take the 64 digits as raw key.
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

EPOCH_S: Final = 1420070400
"""2015-01-01 UTC."""
TICKS_PER_S: Final = 100_000
LAST: Final = 2**48 - 1
LATE_TICKS: Final = 60 * TICKS_PER_S
"""How far behind our own time a sender may be (the specification's minute for one that is heard for the first time)."""
BEHIND_ITSELF_TICKS: Final = 5 * TICKS_PER_S
"""How far a sender may be behind the newest time heard from it on any of its links: more has been held back."""
MAX_STREAMS: Final = 64
"""Senders with the key that are remembered, by system, component and link; newcomers beyond are not believed."""
MAX_STRANGERS: Final = 16
NEVER_SIGNED: Final = frozenset({mavlink.MAVLINK_MSG_ID_RADIO_STATUS, mavlink.MAVLINK_MSG_ID_RADIO})
"""A telemetry radio adds these by itself and has no key."""
EARLIEST_S: Final = 1577836800.0
"""2020: a clock before that has not been set."""

_SIGNED: Final = mavlink.MAVLINK_IFLAG_SIGNED
_MARKER_1: Final = mavlink.PROTOCOL_MARKER_V1
_TAIL: Final = mavlink.MAVLINK_SIGNATURE_BLOCK_LEN
_HASH: Final = 6

Reason = Literal["unsigned", "other key", "old", "no key"]
"""Why a message is not believed. "old": it, or a much later one of the same sender, has been heard before."""


def uptime_s() -> float:
    """Seconds since the board was started, asleep or not; never goes back."""
    return time.clock_gettime(time.CLOCK_BOOTTIME)


def ticks_of(unix_s: float) -> int:
    """A time as signatures carry it; 0 for a clock that has not been set."""
    return int((unix_s - EPOCH_S) * TICKS_PER_S) if unix_s >= EARLIEST_S else 0


def sign(frame: bytes, crc_extra: int, key: bytes, link_id: int, ticks: int) -> bytes:
    """A MAVLink 2 packet that is not signed yet, signed; the checksum covers the flag that says so."""
    head = bytearray(frame[:-2])
    head[2] |= _SIGNED
    crc = mavlink.x25crc(head[1:])
    crc.accumulate(bytes([crc_extra]))
    head += crc.crc.to_bytes(2, "little") + bytes([link_id]) + ticks.to_bytes(6, "little")
    return bytes(head) + _digest(key, head)


def _digest(key: bytes, packet: bytes | bytearray) -> bytes:
    # Not an HMAC: the specification says so.
    return hashlib.sha256(key + packet).digest()[:_HASH]


class SigningClock:
    """Time for signatures: never the same twice, never back, whatever the system's clock does.

    The system's clock sets the time once a boot. A later jump of it by more than a minute is refused: one wrong clock
    would otherwise stay in the kept time and in every receiver, and true senders would look old for good. A board
    without a battery-backed clock starts in 1970: the time then goes on from `start` (ticks, later than all that was
    used before), and takes over the time of the first message that is signed with our key.
    """

    def __init__(
        self, start: int = 0, *, wall_s: Callable[[], float] = time.time, uptime: Callable[[], float] = uptime_s
    ) -> None:
        self._wall_s, self._uptime_s = wall_s, uptime
        self._base, self._base_s = start, uptime()
        self._used = 0
        self._is_set = False
        self.refused_s = 0.0
        """How far ahead of this time the system's clock is, where that is refused; else 0."""

    def resume(self, ticks: int, *, is_set: bool) -> None:
        """Go on behind time used before; `is_set`: it was set in this boot, and the system's clock sets it no more."""
        self._base, self._base_s, self._is_set = ticks, self._uptime_s(), is_set

    def now(self) -> int:
        """Ticks."""
        now_s = self._uptime_s()
        ticks = self._base + int((now_s - self._base_s) * TICKS_PER_S)
        ahead = ticks_of(self._wall_s()) - ticks
        self.refused_s = ahead / TICKS_PER_S if self._is_set and ahead > LATE_TICKS else 0.0
        if ahead > 0 and not self.refused_s:
            # Taken as the new beginning, so that a clock which then steps back does not take us with it.
            ticks += ahead
            self._base, self._base_s, self._is_set = ticks, now_s, True
        return min(max(ticks, self._used), LAST)

    def next(self) -> int:
        """Ticks for one message."""
        self._used = min(max(self.now(), self._used + 1), LAST)
        return self._used

    @property
    def ahead_of_wall_s(self) -> float:
        """How far ahead of the system's clock this time is; 0 where that clock has not been set."""
        wall = ticks_of(self._wall_s())
        return max(0, self.now() - wall) / TICKS_PER_S if wall else 0.0

    def heard(self, ticks: int) -> None:
        """Take over the time of a sender that has the key and is ahead."""
        if ticks > self.now():
            self._base, self._base_s, self._is_set = ticks, self._uptime_s(), True


class Signing:
    """Signs what one link sends and judges what it receives.

    Where a signature is `required`, what is not signed with the key (32 bytes) is dropped; else it is only counted.
    Without a key nothing can be signed or believed. The clock is that of all links that have the key.
    """

    def __init__(self, *, required: bool, key: bytes | None = None, clock: SigningClock | None = None) -> None:
        self.required, self.key = required, key
        self.clock = clock or SigningClock()
        self.verified = 0
        """Messages that were signed with our key."""
        self.doubted: Counter[Reason] = Counter()
        """Others, by what is wrong with them; those that are dropped where a signature is required."""
        self.strangers: Counter[tuple[Reason, int, int]] = Counter()
        """The same by system and component that they claim to be of: the first 16 of these."""
        self.believed: Counter[tuple[int, int]] = Counter()
        """What was signed with our key, by system and component."""
        self._streams: dict[tuple[int, int, int], int] = {}
        self._newest: dict[tuple[int, int], int] = {}

    def take_key(self, key: bytes) -> None:
        """Sign and judge with this key from now on; what was doubted before is forgotten."""
        self.key = key
        self.doubted.clear()
        self.strangers.clear()

    def __repr__(self) -> str:
        """Without the key."""
        return f"Signing(required={self.required})"

    def sign(self, frame: bytes, crc_extra: int) -> bytes:
        """What is to be sent for a MAVLink 2 packet; the packet itself as long as there is no key."""
        if self.key is None:
            return frame
        return sign(frame, crc_extra, self.key, link_id=0, ticks=self.clock.next())

    def admits(self, frame: bytes | bytearray) -> bool:
        """Whether a whole packet with a right checksum may have any effect."""
        reason = self._doubt(frame)
        if reason is None:
            return True
        self.doubted[reason] += 1
        first = frame[0] == _MARKER_1
        stranger = (reason, frame[3 if first else 5], frame[4 if first else 6])
        if stranger in self.strangers or len(self.strangers) < MAX_STRANGERS:
            self.strangers[stranger] += 1
        return not self.required

    def _doubt(self, frame: bytes | bytearray) -> Reason | None:
        first = frame[0] == _MARKER_1
        message_id = frame[5] if first else int.from_bytes(frame[7:10], "little")
        if message_id in NEVER_SIGNED:
            return None
        if self.key is None:
            return "no key"
        if first or not frame[2] & _SIGNED:
            return "unsigned"
        if not self._is_ours(frame):
            return "other key"
        # Only who has the key comes as far as this.
        ticks = int.from_bytes(frame[1 - _TAIL : -_HASH], "little")
        sender, stream = (frame[5], frame[6]), (frame[5], frame[6], frame[-_TAIL])
        newest = self._newest.get(sender, 0)
        if ticks + LATE_TICKS < self.clock.now() or ticks + BEHIND_ITSELF_TICKS < newest:
            return "old"
        before = self._streams.get(stream)
        if (before is None and len(self._streams) >= MAX_STREAMS) or (before is not None and ticks <= before):
            return "old"
        self._streams[stream] = ticks
        self._newest[sender] = max(ticks, newest)
        self.clock.heard(ticks)
        self.verified += 1
        self.believed[sender] += 1
        return None

    def link_id_of(self, frame: bytes | bytearray) -> int | None:
        """On which of its links the sender has signed a whole packet with our key; None: it has not."""
        signed = frame[0] != _MARKER_1 and frame[2] & _SIGNED
        return frame[-_TAIL] if signed and self._is_ours(frame) else None

    def _is_ours(self, frame: bytes | bytearray) -> bool:
        if self.key is None:
            return False
        return hmac.compare_digest(_digest(self.key, frame[:-_HASH]), bytes(frame[-_HASH:]))


KEY_BYTES: Final = 32
LEAST_PASSPHRASE: Final = 8
MAX_FILE_BYTES: Final = 1024
_HEX: Final = re.compile(rb"[0-9a-fA-F]{64}")
_WANTED: Final = (
    f"32 bytes, 64 hexadecimal digits, or a passphrase of {LEAST_PASSPHRASE} characters or more on one line"
)


def read_key(path: Path) -> bytes:
    """The 32 bytes of the key.

    Raises:
        LinkError: one line that names the file and what is wrong with it, and nothing of what is in it.
    """
    try:
        with path.open("rb") as file:
            rights = os.fstat(file.fileno()).st_mode
            content = file.read(MAX_FILE_BYTES + 1)
    except OSError as error:
        raise LinkError(f"signing key file {path}: {error.strerror or type(error).__name__}") from None
    if rights & (stat.S_IROTH | stat.S_IWOTH):
        raise LinkError(f"signing key file {path}: everybody on this computer may open it: chmod 600 {path}")
    is_raw = len(content) == KEY_BYTES and not _is_text(content)
    key = content if is_raw else _from_text(content, path)
    if not any(key):
        # All zero means "no signing" in SETUP_SIGNING.
        raise LinkError(f"signing key file {path}: a key of zeros is none")
    return key


def _is_text(content: bytes) -> bool:
    """Whether this could have been typed; 32 random bytes are so once in 10^13."""
    return all(32 <= byte < 127 or byte in b"\r\n" for byte in content)


def _from_text(content: bytes, path: Path) -> bytes:
    line = content.removesuffix(b"\n").removesuffix(b"\r")
    if _HEX.fullmatch(line):
        return bytes.fromhex(line.decode("ascii"))
    try:
        passphrase = line.decode()
    except UnicodeDecodeError:
        passphrase = ""
    if len(content) > MAX_FILE_BYTES or len(passphrase) < LEAST_PASSPHRASE or not passphrase.isprintable():
        raise LinkError(f"signing key file {path}: found {len(content)} bytes; wanted: {_WANTED}")
    return hashlib.sha256(line).digest()

"""Detection of faults in a stream of bytes and samples. Pure: the caller passes the time."""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from companion.messages import message
from companion.protocols.decoding.base import Decoder
from companion.protocols.guess import likeliest, plain_share, strangers
from companion.samples import CompassSample, ImuSample, Sample, TiltSample

SILENT: Final = "silent"
SILENT_AFTER_S: Final = 3.0
TAIL_BYTES: Final = 1024
SPAN_S: Final = 2.0
GUESS_EVERY_S: Final = 5.0
STUCK_S: Final = 1.0
STUCK_SAMPLES: Final = 20
"""Equal IMU readings in a row that prove a fault, as one of six channels always changes; tilt readings may repeat."""
NEAR_DEG: Final = 0.5
"""Largest change of a reading that `near_since_s` ignores, deg, as a sensor may hang just after a motion begins."""

_HARMLESS: Final = frozenset(
    {
        "calibrating",
        "command refused",
        "non-finite",
        "nothing of use",
        "out of range",
        "over range",
        "reply",
        "single axis",
        "unknown field",
        "unknown group",
        "unknown sentence",
    }
)
_MUCH_TEXT: Final = 0.9  # least share of plain text; with less, the line's baud rate or parity is wrong
_DAMAGED_SHARE: Final = 0.1
_DAMAGED_FRAMES: Final = 3
_MOST_DAMAGE_NAMED: Final = 3


@dataclass(frozen=True, slots=True)
class Trouble:
    """Fault of a stream: its key for counters, and one line of text for people."""

    key: str
    words: str
    implausible: bool = False


_Counts = tuple[int, Counter[str]]  # frames accepted, and rejected by reason


class StreamHealth:
    """Monitor of the bytes and samples of one sensor; `protocol`: its name in the configuration."""

    def __init__(self, protocol: str, decoder: Decoder) -> None:
        self._protocol, self._decoder = protocol, decoder
        self.last_sample_s: float | None = None
        self._marks: deque[tuple[float, _Counts]] = deque()
        self.opened()

    def opened(self) -> None:
        self._tail = b""
        self.last_byte_s: float | None = None
        self.unchanged_since_s: float | None = None
        self.near_since_s: float | None = None
        self._reading: tuple[object, ...] = ()
        self._near: tuple[float, ...] = ()
        self._same = 0
        self.speaks: str | None = None
        self._guess, self._guessed_s = "", -math.inf

    def excuse(self) -> None:
        self._marks.clear()

    def took(self, data: bytes, samples: Sequence[Sample], t_s: float) -> None:
        self.last_byte_s = t_s
        if not samples:
            self._tail = (self._tail + data)[-TAIL_BYTES:]
            return
        self._tail, self.last_sample_s = b"", t_s
        self._compare(samples[-1], len(samples), t_s)

    def _compare(self, sample: Sample, count: int, t_s: float) -> None:
        reading: tuple[object, ...]
        angles_deg: tuple[float, ...] = ()
        if isinstance(sample, ImuSample):
            reading = (sample.gyro_rad_s, sample.accel_m_s2)
        elif isinstance(sample, TiltSample):
            reading = angles_deg = (sample.x_deg, sample.y_deg)
        elif isinstance(sample, CompassSample):
            reading = (sample.heading_deg, sample.pitch_deg, sample.roll_deg)
            angles_deg = (sample.heading_deg,)
        else:
            return
        if angles_deg and not _are_near(self._near, angles_deg):
            self._near, self.near_since_s = angles_deg, t_s
        if reading == self._reading:
            self._same += count
            return
        self._reading, self._same, self.unchanged_since_s = reading, 0, t_s

    def trouble(self, now_s: float) -> Trouble | None:
        lately = self._lately(now_s)
        if self.last_sample_s is None or now_s - self.last_sample_s >= SILENT_AFTER_S:
            return self._without_samples(now_s, lately)
        self.speaks = None
        return self._stuck() or _valueless(lately) or _damaged(lately)

    def _without_samples(self, now_s: float, lately: _Counts) -> Trouble:
        if self.last_byte_s is None or now_s - self.last_byte_s >= SILENT_AFTER_S:
            return Trouble(SILENT, message("sensor_silent"))
        if (valueless := _valueless(lately)) is not None:
            return valueless
        if now_s - self._guessed_s >= GUESS_EVERY_S and len(self._tail) >= TAIL_BYTES // 8:
            self._guessed_s, self._guess = now_s, self._guesses()
        if self.speaks is not None:
            return Trouble("undecodable", self._guess)
        rejected = _named(self._decoder.rejected) or "none begun"
        guess = self._guess or "wrong baud or protocol?"
        return Trouble("undecodable", message("no_frames", protocol=self._protocol, rejected=rejected, guess=guess))

    def _guesses(self) -> str:
        found = likeliest(self._tail)
        self.speaks = found.protocol if found is not None and found.protocol != self._protocol else None
        if found is not None and self.speaks is not None:
            device = f"{found.protocol}, a device for {found.kinds[0]}"
            return message("other_device", found=device, wanted=self._protocol)
        if (stranger := strangers(self._tail)) is not None:
            return f"this is {stranger}"
        return "wrong baud or parity?" if plain_share(self._tail) < _MUCH_TEXT else ""

    def _stuck(self) -> Trouble | None:
        since_s, last_s = self.unchanged_since_s, self.last_sample_s
        if since_s is None or last_s is None or self._same < STUCK_SAMPLES or last_s - since_s < STUCK_S:
            return None
        if not isinstance(self._reading[0], tuple):
            return None  # not an IMU: a gradienter or compass at rest repeats its reading
        words = message("sensor_stuck", evidence=f"{self._same + 1} equal readings")
        return Trouble("stuck", words, implausible=True)

    def _lately(self, now_s: float) -> _Counts:
        marks, decoder = self._marks, self._decoder
        if not marks or now_s - marks[-1][0] >= SPAN_S / 4:
            marks.append((now_s, (decoder.accepted, Counter(decoder.rejected))))
        while len(marks) > 1 and now_s - marks[1][0] >= SPAN_S:
            marks.popleft()
        accepted, rejected = marks[0][1]
        return decoder.accepted - accepted, Counter(decoder.rejected) - rejected


def _are_near(ones_deg: tuple[float, ...], others_deg: tuple[float, ...]) -> bool:
    if len(ones_deg) != len(others_deg):
        return False
    pairs = zip(ones_deg, others_deg, strict=True)
    return all(abs(math.remainder(one - other, 360.0)) <= NEAR_DEG for one, other in pairs)


def _named(counts: Counter[str]) -> str:
    return ", ".join(f"{count} {why}" for why, count in counts.most_common(_MOST_DAMAGE_NAMED))


def _valueless(lately: _Counts) -> Trouble | None:
    accepted, rejected = lately
    least = _DAMAGED_SHARE * max(accepted, 1)
    if (count := rejected["non-finite"]) and count >= least:
        return Trouble("non-finite", message("readings_are_nan", count=count))
    if (count := rejected["over range"]) and count >= least:
        return Trouble("over range", message("readings_over_range", count=count))
    return None


def _damaged(lately: _Counts) -> Trouble | None:
    accepted, rejected = lately
    damage = Counter({why: n for why, n in rejected.items() if why not in _HARMLESS})
    damaged = damage.total()
    if damaged < _DAMAGED_FRAMES or damaged < _DAMAGED_SHARE * (accepted + damaged):
        return None
    percent = 100 * damaged // (accepted + damaged)
    return Trouble("damaged", message("frames_damaged", percent=percent, damage=_named(damage)))

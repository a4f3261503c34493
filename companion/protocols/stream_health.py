"""What is wrong with a stream of bytes and samples, as far as the stream itself tells.

Pure: time comes in. Fed with every chunk that was read and the samples it completed; asked now and then.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from companion.protocols.decoding import reasons
from companion.protocols.decoding.base import Decoder
from companion.protocols.guess import likeliest, looks_garbled, strangers
from companion.samples import CompassSample, ImuSample, Sample, TiltSample

SILENT: Final = "silent"
SILENT_AFTER_S: Final = 3.0
TAIL_BYTES: Final = 1024
SPAN_S: Final = 2.0
GUESS_EVERY_S: Final = 5.0
STUCK_S: Final = 1.0
STUCK_SAMPLES: Final = 20
"""Equal readings of an IMU that prove a fault: six channels always move. A still gradienter repeats its digits."""
NEAR_DEG: Final = 0.5
"""A reading this near the last counts as near; whoever moves the aircraft may be the cause of a hang."""

_HARMLESS: Final = frozenset(
    {
        reasons.CALIBRATING,
        reasons.COMMAND_REFUSED,
        reasons.NON_FINITE,
        reasons.NOTHING_OF_USE,
        reasons.OUT_OF_RANGE,
        reasons.OVER_RANGE,
        reasons.REPLY,
        reasons.SINGLE_AXIS,
    }
    | {reasons.UNKNOWN_FIELD, reasons.UNKNOWN_GROUP, reasons.UNKNOWN_SENTENCE}
)
_DAMAGED_SHARE: Final = 0.1
_DAMAGED_FRAMES: Final = 3
_MOST_DAMAGE_NAMED: Final = 3


@dataclass(frozen=True, slots=True)
class Trouble:
    """A fault: a key to count it under, and one line for people."""

    key: str
    words: str
    implausible: bool = False


@dataclass(frozen=True, slots=True)
class _Mark:
    t_s: float
    accepted: int
    rejected: Counter[str]


class StreamHealth:
    """Watches one stream; `protocol`: its name in the configuration."""

    def __init__(self, protocol: str, decoder: Decoder) -> None:
        self._protocol, self._decoder = protocol, decoder
        self.last_sample_s: float | None = None
        self.last_byte_s: float | None = None
        self.unchanged_since_s: float | None = None
        self.near_since_s: float | None = None
        self.speaks: str | None = None
        self._tail = b""
        self._reading: object = None
        self._near: tuple[float, ...] | None = None
        self._same = 0
        self._marks: deque[_Mark] = deque()
        self._guessed_s = -math.inf
        self._guess = ""

    def opened(self) -> None:
        """The port was opened (again): what came before has no continuation."""
        self._tail = b""
        self.last_byte_s = self.unchanged_since_s = self._reading = None
        self.near_since_s = self._near = None
        self._same = 0
        self.speaks, self._guess, self._guessed_s = None, "", -math.inf

    def excuse(self) -> None:
        """Forget the damage so far: its cause is known."""
        self._marks.clear()

    def took(self, data: bytes, samples: Sequence[Sample], t_s: float) -> None:
        """Bytes were read at `t_s` and have completed these samples."""
        self.last_byte_s = t_s
        if not samples:
            self._tail = (self._tail + data)[-TAIL_BYTES:]
            return
        self._tail, self.last_sample_s = b"", t_s
        self._compare(samples[-1], len(samples), t_s)

    def _compare(self, sample: Sample, count: int, t_s: float) -> None:
        reading: object
        if isinstance(sample, ImuSample):
            reading = (sample.gyro_rad_s, sample.accel_m_s2)
        elif isinstance(sample, TiltSample):
            reading = (sample.x_deg, sample.y_deg)
            self._look_whether_near(reading, t_s)
        elif isinstance(sample, CompassSample):
            reading = (sample.heading_deg, sample.pitch_deg, sample.roll_deg)
            self._look_whether_near((sample.heading_deg,), t_s)
        else:
            return
        if reading == self._reading:
            self._same += count
            return
        self._reading, self._same, self.unchanged_since_s = reading, 0, t_s

    def _look_whether_near(self, angles_deg: tuple[float, ...], t_s: float) -> None:
        near = self._near
        if (
            near is None
            or len(near) != len(angles_deg)
            or any(
                abs(math.remainder(one - other, 360.0)) > NEAR_DEG for one, other in zip(near, angles_deg, strict=True)
            )
        ):
            self._near, self.near_since_s = angles_deg, t_s

    def trouble(self, now_s: float) -> Trouble | None:
        """Return the present fault of an open port at `now_s`."""
        lately = self._lately(now_s)
        if self.last_sample_s is None or now_s - self.last_sample_s >= SILENT_AFTER_S:
            return self._without_samples(now_s, lately)
        self.speaks = None
        return self._lying() or self._in_part(lately)

    def _without_samples(self, now_s: float, lately: _Mark) -> Trouble:
        if self.last_byte_s is None or now_s - self.last_byte_s >= SILENT_AFTER_S:
            return Trouble(SILENT, "silent (power? wiring? told to stop?)")
        if (valueless := _valueless(lately)) is not None:
            return valueless
        if now_s - self._guessed_s >= GUESS_EVERY_S and len(self._tail) >= TAIL_BYTES // 8:
            self._guessed_s, self._guess = now_s, self._guesses()
        rejected = ", ".join(f"{count} {why}" for why, count in self._decoder.rejected.most_common(_MOST_DAMAGE_NAMED))
        guess = self._guess or "wrong baud or protocol?"
        return Trouble(
            "undecodable", f"bytes come, but no {self._protocol} frames ({rejected or 'none begun'}); {guess}"
        )

    def _guesses(self) -> str:
        found = likeliest(self._tail)
        self.speaks = found.protocol if found is not None and found.protocol != self._protocol else None
        if found is not None and self.speaks is not None:
            return f"this is {found.protocol} ({' or '.join(found.kinds)})"
        if (stranger := strangers(self._tail)) is not None:
            return f"this is {stranger}"
        if looks_garbled(self._tail):
            return "wrong baud or parity?"
        return ""

    def _lying(self) -> Trouble | None:
        since_s, last_s = self.unchanged_since_s, self.last_sample_s
        if since_s is None or last_s is None or self._same < STUCK_SAMPLES or last_s - since_s < STUCK_S:
            return None
        if isinstance(self._reading, tuple) and isinstance(self._reading[0], tuple):
            words = f"stuck: {self._same + 1} equal readings; switch its power off and on"
            return Trouble("stuck", words, implausible=True)
        return None

    def _in_part(self, lately: _Mark) -> Trouble | None:
        if (valueless := _valueless(lately)) is not None:
            return valueless
        damage = Counter({why: n for why, n in lately.rejected.items() if why not in _HARMLESS})
        damaged = damage.total()
        if damaged < _DAMAGED_FRAMES or damaged < _DAMAGED_SHARE * (lately.accepted + damaged):
            return None
        percent = 100 * damaged // (lately.accepted + damaged)
        named = ", ".join(f"{count} {why}" for why, count in damage.most_common(_MOST_DAMAGE_NAMED))
        return Trouble(
            "damaged", f"{percent} % of its frames are damaged ({named}): a second reader? wire, ground, levels?"
        )

    def _lately(self, now_s: float) -> _Mark:
        marks, decoder = self._marks, self._decoder
        if not marks or now_s - marks[-1].t_s >= SPAN_S / 4:
            marks.append(_Mark(now_s, decoder.accepted, Counter(decoder.rejected)))
        while len(marks) > 1 and now_s - marks[1].t_s >= SPAN_S:
            marks.popleft()
        oldest = marks[0]
        return _Mark(now_s, decoder.accepted - oldest.accepted, Counter(decoder.rejected) - oldest.rejected)


def _valueless(lately: _Mark) -> Trouble | None:
    least = _DAMAGED_SHARE * max(lately.accepted, 1)
    if (count := lately.rejected[reasons.NON_FINITE]) and count >= least:
        words = f"NaN in {count} whole frames: the device has no valid reading; switch its power off and on"
        return Trouble(reasons.NON_FINITE, words)
    if (count := lately.rejected[reasons.OVER_RANGE]) and count >= least:
        return Trouble(reasons.OVER_RANGE, f"{count} readings are over range: level it")
    return None

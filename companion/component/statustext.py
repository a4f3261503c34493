"""Messages for people: short STATUSTEXT lines, and tunes on the autopilot's buzzer.

Three limits protect a slow telemetry link. A text is not repeated within 3 s, unless the result of a job came between.
A token bucket limits the lines per second. The queue is bounded: a full queue drops the oldest text of the lowest
priority (`Weight`), so that news and refused commands never displace a result.

Texts must not begin with "[cal]": QGroundControl reads such lines as the progress of PX4's own calibration.

Tunes are for an operator without a screen in view. Both ArduPilot (`AP_Notify/ToneAlarm.cpp` and `MMLPlayer.cpp`) and
PX4 (`mavlink_receiver.cpp` and `lib/tunes`) accept PLAY_TUNE (258) in QBasic's notation. Neither acknowledges a tune.
Both would play a tune in flight too, so we send none in flight. PX4 garbles a tune that arrives during another tune.
"""

from __future__ import annotations

import asyncio
import enum
import itertools
import math
import re
import unicodedata
from collections import deque
from collections.abc import Callable
from operator import itemgetter
from typing import Final

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.autopilot.vehicle.heartbeats import ArmState
from companion.autopilot.vehicle.vehicle import Vehicle
from companion.links.mavlink.link import MavlinkLink
from companion.links.system.connection import Budget

LINE_BYTES = 50
MOST_LINES = 5
QUEUE_TEXTS = 16
LINES_PER_S = 2.0
BURST_LINES = 8.0
REPEAT_S = 3.0
GOES_ON = "... "  # Beginning of a line that continues the one before
SPOKEN = 4  # Number of spoken texts stored for the web page and `companion status --watch`
STALE_S = 20.0
"""Age at which a text that waits for the link is dropped; results of jobs are never dropped for age."""
RECENT_TEXTS = 32
_FULL_RETRY_S = 0.1
_FIGURE = re.compile(r"[-+]?\d+(\.\d| ?(%|mg\b|deg\b|K\b))")

_ASCII = str.maketrans(
    {"°": " deg", "σ": "sigma", "µ": "u", "μ": "u", "²": "^2", "±": "+-", "×": "x", "≤": "<=", "≥": ">=", "≠": "!=",
     "–": "-", "—": "-", "−": "-", "’": "'", "‘": "'", "“": '"', "”": '"', "…": "...", "·": "*", "→": "->"}
)  # fmt: skip


class Severity(enum.IntEnum):
    """Severity of a text, numbered as MAV_SEVERITY. INFO: a text to read. NOTICE: a short request, or a success.

    WARNING: a fault that the pilot must know. ERROR: a request has failed. CRITICAL: the pilot must act at once.
    QGroundControl and our web page speak NOTICE and worse (`Vehicle.cc`), and QGroundControl opens a window for ERROR
    and worse. Mission Planner speaks and shows WARNING and worse; its user can choose NOTICE (`MAVLinkInterface.cs`).
    """

    CRITICAL = 2
    ERROR = 3
    WARNING = 4
    NOTICE = 5
    INFO = 6


class Weight(enum.IntEnum):
    """Priority of a text when the queue is full or the link is slow; the highest number is sent first."""

    NEWS = 0
    REFUSAL = 1
    RESULT = 2


Say = Callable[[Severity, str, Weight], object]  # Sends a text to the ground stations


def to_ascii(text: str) -> str:
    # Ground stations do not agree on characters beyond ASCII.
    text = unicodedata.normalize("NFKD", " ".join(text.translate(_ASCII).split()))
    text = "".join(character for character in text if not unicodedata.combining(character))
    return "".join(character if " " <= character <= "~" else "?" for character in text)


def as_lines(severity: Severity, text: str) -> list[tuple[Severity, str]]:
    """Split a text into lines of one STATUSTEXT each; lines after the first are INFO, which is not spoken.

    A line ends at the last punctuation that fits, otherwise between two words. The first line of a NOTICE ends before
    the first figure, to keep figures unspoken. MAVLink's `chunk_seq` cuts words, and some receivers speak every chunk.
    """
    found: list[tuple[Severity, str]] = []
    rest = text
    while rest:
        end = _end_of_line(rest, figures=severity is not Severity.NOTICE)
        found.append((severity, rest[:end]))
        rest = f"{GOES_ON}{rest[end:].lstrip()}" if end < len(rest) else ""
        severity = max(severity, Severity.INFO)
        if rest and len(found) == MOST_LINES:
            found[-1] = (severity, f"{shortened(found[-1][1], LINE_BYTES - 4)} ...")
            break
    return found


def shortened(text: str, most: int) -> str:
    return text if len(text) <= most else text[: _end_of_line(text, figures=True, most=most)].rstrip(" :;,")


def _end_of_line(text: str, *, figures: bool, most: int = LINE_BYTES) -> int:
    blanks = [at for at, letter in enumerate(text[: most + 1]) if letter == " " and at >= len(GOES_ON)]
    pauses = [
        at
        for at in blanks
        if (text[at - 1] in ":;," or text[at + 1] == "(") and text.count("(", 0, at) == text.count(")", 0, at)
    ]
    if not figures and (figure := _FIGURE.search(text)) is not None:
        pauses = [at for at in pauses if at < figure.start()]
        if pauses:
            return pauses[-1]
    if len(text) <= most:
        return len(text)
    return (pauses or blanks or [most])[-1]


class StatusText:
    """Queue of texts for the ground stations; `step` sends as many as the rate limit allows."""

    def __init__(self, link: MavlinkLink) -> None:
        self.woken = asyncio.Event()  # Set when a new text waits, to wake the caller of `step`
        self._link = link
        self._waiting: list[tuple[Weight, float, Severity, str]] = []
        self._recent: deque[tuple[Severity, str, float]] = deque(maxlen=RECENT_TEXTS)
        self._sending: deque[mavlink.MAVLink_statustext_message] = deque()
        self._lines = Budget(LINES_PER_S, BURST_LINES)
        self.spoken: deque[dict[str, object]] = deque(maxlen=SPOKEN)
        """The latest texts that ground stations speak, for the web page: oldest first, numbered from 1 at start."""
        self._numbers = itertools.count(1)

    def say(self, severity: Severity, text: str, weight: Weight = Weight.NEWS) -> bool:
        """Queue a text; return False if an equal one was queued within 3 s, or if more important texts fill the queue.

        The result of a job is always queued. After a result, texts from before it can be queued again at once.
        """
        text = to_ascii(text)
        now_s = asyncio.get_running_loop().time()
        if weight is Weight.RESULT:
            self._recent.clear()
        if not text or any(said[:2] == (severity, text) and now_s - said[2] < REPEAT_S for said in self._recent):
            return False
        if len(self._waiting) >= QUEUE_TEXTS:
            lightest = min(self._waiting, key=itemgetter(0))
            if lightest[0] > weight:
                return False
            self._waiting.remove(lightest)
        self._recent.append((severity, text, now_s))
        self._waiting.append((weight, now_s, severity, text))
        if severity <= Severity.NOTICE:
            self.spoken.append({"number": next(self._numbers), "text": as_lines(severity, text)[0][1]})
        self.woken.set()
        return True

    def step(self, now_s: float) -> float:
        """Send as many lines as the rate limit allows; return the time of the next call, infinity if none is needed."""
        if not self._link.connected:
            # Texts stay pending: the loop calls `step` again with the first heartbeat on a new transport.
            return math.inf
        while self._lines.left(now_s) >= 1.0 - 1e-9:
            if not self._sending:
                self._take_next(now_s)
            if not self._sending:
                return math.inf
            if not self._link.send(self._sending[0]):
                return now_s + _FULL_RETRY_S
            self._sending.popleft()
            self._lines.spend(1, now_s)
        if not self._sending and not self._waiting:
            return math.inf
        return now_s + (1.0 - self._lines.left(now_s)) / LINES_PER_S

    def _take_next(self, now_s: float) -> None:
        self._waiting = [text for text in self._waiting if text[0] is Weight.RESULT or now_s - text[1] <= STALE_S]
        if self._waiting:
            heaviest = max(self._waiting, key=itemgetter(0))
            self._waiting.remove(heaviest)
            for severity, line in as_lines(*heaviest[2:]):
                self._sending.append(mavlink.MAVLink_statustext_message(severity, line.encode("ascii")))


TUNES_APART_S: Final = 1.5
"""Shortest time between the starts of two tunes; the longest tune takes 1.1 s."""
TUNE_STALE_S: Final = 3.0  # Age at which a tune that could not be sent is dropped


class Tune(enum.Enum):
    """Tunes, each with its notes for the first field of PLAY_TUNE, which holds 29 characters.

    HOLD_STILL: a long note. NEXT (this pose is done): rising notes. WRONG (not the requested pose): alternating notes.
    """

    HOLD_STILL = "MFT200O4A2"
    NEXT = "MFT200O4E8A8"
    WRONG = "MFT200O4E8C8E8C8E8C8"
    DONE = "MFT200O4C8E8G8>C4"
    FAILED = "MFT200O5C8<G8E8C2"


class Tunes:
    """Plays tunes on the buzzer of a disarmed autopilot, if `wanted` returns True. `step` sends the latest tune."""

    def __init__(self, link: MavlinkLink, vehicle: Vehicle, wanted: Callable[[], bool], woken: asyncio.Event) -> None:
        self._link, self._vehicle, self._wanted, self._woken = link, vehicle, wanted, woken
        self._waiting: tuple[Tune, float] | None = None  # The latest tune, and the time of its request
        self._free_s = -math.inf

    def play(self, tune: Tune) -> None:
        self._waiting = tune, asyncio.get_running_loop().time()
        self._woken.set()

    def step(self, now_s: float) -> float:
        if self._waiting is None:
            return math.inf
        if now_s < self._free_s:
            return self._free_s
        tune, asked_s = self._waiting
        self._waiting = None
        if now_s - asked_s < TUNE_STALE_S and self._wanted() and self._vehicle.arm_state is ArmState.DISARMED:
            assert self._vehicle.system_id is not None
            notes = tune.value.encode("ascii")
            target = self._vehicle.system_id, self._vehicle.component_id
            self._link.send(mavlink.MAVLink_play_tune_message(*target, notes, b""))
            self._free_s = now_s + TUNES_APART_S
        return math.inf

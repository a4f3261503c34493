"""STATUSTEXT: words for people, in few and short lines.

Three limits protect a slow telemetry link: the same text is not repeated within seconds unless a result came between
(who cancels and asks again wants to hear that it has started), a token bucket bounds the lines per second, and the
queue is bounded. What is dropped from a full queue is the least weighty text, and among those the oldest, so that a
stream of news or of refused commands can never push out a result.

Texts must not begin with "[cal]": QGroundControl takes such lines from any component of the vehicle as the progress
of PX4's own calibration.
"""

from __future__ import annotations

import asyncio
import enum
import math
import re
import unicodedata
from collections import OrderedDict, deque
from collections.abc import Callable
from typing import NamedTuple

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.links.mavlink.link import MavlinkLink
from companion.links.system.connection import Budget

LINE_BYTES = 50
"""What one STATUSTEXT holds."""
MOST_LINES = 5
"""Longer texts lose their tail."""
QUEUE_TEXTS = 16
LINES_PER_S = 2.0
BURST_LINES = 8.0
REPEAT_S = 3.0
GOES_ON = "... "
"""How a line begins that goes on with the one before it."""
SPOKEN = 4
"""How many of what was to be heard are kept for those who look on."""
STALE_S = 20.0
"""What could not be said for so long (no link) is no news any more; results are kept."""
_REMEMBERED_TEXTS = 32
_FULL_RETRY_S = 0.1
_FIGURE = re.compile(r"[-+]?\d+(\.\d| ?(%|mg\b|deg\b|K\b))")

_ASCII = str.maketrans(
    {"°": " deg", "σ": "sigma", "µ": "u", "μ": "u", "²": "^2", "±": "+-", "×": "x", "≤": "<=", "≥": ">=", "≠": "!=",
     "–": "-", "—": "-", "−": "-", "’": "'", "‘": "'", "“": '"', "”": '"', "…": "...", "·": "*", "→": "->"}
)  # fmt: skip


class Severity(enum.IntEnum):
    """MAV_SEVERITY, and what we use it for.

    QGroundControl speaks NOTICE and worse aloud (`Vehicle.cc`: `severity <= MAV_SEVERITY_NOTICE`), as our page does,
    and opens a window for ERROR and worse. Mission Planner speaks and shows on its HUD WARNING and worse, unless its
    user has chosen NOTICE (`MAVLinkInterface.cs`: setting "severity", 4 by default).
    """

    CRITICAL = 2
    """Somebody must act this second."""
    ERROR = 3
    """What was asked for has failed."""
    WARNING = 4
    """Something is wrong, and who flies has to know it."""
    NOTICE = 5
    """For who is at the aircraft and looks at no screen: what to do now, and that it is done. Short, to be heard."""
    INFO = 6
    """To be read."""


class Weight(enum.IntEnum):
    """What a text is worth when the queue is full or the link is slow; heavier texts go first."""

    NEWS = 0
    REFUSAL = 1
    RESULT = 2


Say = Callable[[Severity, str, Weight], object]
"""Tells people at the ground stations."""


def to_ascii(text: str) -> str:
    """One line of plain ASCII: ground stations disagree on everything else."""
    text = unicodedata.normalize("NFKD", " ".join(text.translate(_ASCII).split()))
    text = "".join(character for character in text if not unicodedata.combining(character))
    return "".join(character if " " <= character <= "~" else "?" for character in text)


def as_lines(severity: Severity, text: str) -> list[tuple[Severity, str]]:
    """A plain text as lines of one message each: what is heard of it, if anything is, is the first.

    Cut is at the last pause that leaves one line, else between any two words, and in good news before the first
    figure: that is for who reads. MAVLink's own way of longer texts (`chunk_seq`) is not taken: it cuts in the middle
    of words, many receivers show each part by itself, and what puts them together speaks all of it.
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
    """Beginning of a text in so many characters: up to its last pause, else up to its last whole word."""
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


class _Text(NamedTuple):
    severity: Severity
    text: str
    said_s: float


class Spoken(NamedTuple):
    """A text that is to be heard."""

    number: int
    """Counts from 1."""
    text: str


class StatusText:
    """The component's voice.

    `step` sends what may be sent now.
    """

    def __init__(self, link: MavlinkLink) -> None:
        self.woken = asyncio.Event()
        """Set when there is something new to send: whoever calls `step` waits for it."""
        self._link = link
        self._waiting: dict[Weight, deque[_Text]] = {weight: deque() for weight in reversed(Weight)}
        self._said_s: OrderedDict[tuple[Severity, str], float] = OrderedDict()
        self._sending: deque[mavlink.MAVLink_statustext_message] = deque()
        self._lines = Budget(LINES_PER_S, BURST_LINES)
        self._spoken: deque[Spoken] = deque(maxlen=SPOKEN)

    def say(self, severity: Severity, text: str, weight: Weight = Weight.NEWS) -> bool:
        """Queue a text; False when it repeats one said within the last seconds, or when the queue is full.

        Of what is to be heard only the first of its lines goes out as such, the rest to be read.
        A result is no repeat, whatever it says: each ends a request of its own. What was said before it belongs to that
        request, and may be said of the next at once.
        """
        text = to_ascii(text)
        now_s = asyncio.get_running_loop().time()
        if weight is Weight.RESULT:
            self._said_s.clear()
        if not text or self._is_repeat(severity, text, now_s):
            return False
        if sum(map(len, self._waiting.values())) >= QUEUE_TEXTS and not self._make_room(weight):
            return False
        self._remember(severity, text, now_s)
        self._waiting[weight].append(_Text(severity, text, now_s))
        if severity <= Severity.NOTICE:
            self._spoken.append(
                Spoken(self._spoken[-1].number + 1 if self._spoken else 1, as_lines(severity, text)[0][1])
            )
        self.woken.set()
        return True

    @property
    def spoken(self) -> tuple[Spoken, ...]:
        """The latest texts that are to be heard, the oldest first."""
        return tuple(self._spoken)

    def step(self, now_s: float) -> float:
        """Send what the bucket allows; return when there is more to do (infinity: nothing waits)."""
        if not self._link.connected:
            # Texts wait; the heartbeat, which is due as soon as there is a transport, brings us back here.
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
        if not self._sending and not any(self._waiting.values()):
            return math.inf
        return now_s + (1.0 - self._lines.left(now_s)) / LINES_PER_S

    def _take_next(self, now_s: float) -> None:
        for weight, waiting in self._waiting.items():
            while weight is not Weight.RESULT and waiting and now_s - waiting[0].said_s > STALE_S:
                waiting.popleft()
            if waiting:
                text = waiting.popleft()
                for severity, line in as_lines(text.severity, text.text):
                    self._sending.append(mavlink.MAVLink_statustext_message(severity, line.encode("ascii")))
                return

    def _make_room(self, weight: Weight) -> bool:
        """Drop the oldest of the lightest texts, unless all that waits is heavier than the new one."""
        for lighter in Weight:
            if lighter > weight:
                return False
            if self._waiting[lighter]:
                self._waiting[lighter].popleft()
                return True
        return False

    def _is_repeat(self, severity: Severity, text: str, now_s: float) -> bool:
        said_s = self._said_s.get((severity, text))
        return said_s is not None and now_s - said_s < REPEAT_S

    def _remember(self, severity: Severity, text: str, now_s: float) -> None:
        self._said_s[(severity, text)] = now_s
        self._said_s.move_to_end((severity, text))
        if len(self._said_s) > _REMEMBERED_TEXTS:
            self._said_s.popitem(last=False)

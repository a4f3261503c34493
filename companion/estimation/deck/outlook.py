"""When an estimate will be good enough: sigma falls by a law that is known beforehand, or that the estimates show."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import msgspec
import numpy as np

from companion.estimation.deck.deck import EVERY_S
from companion.estimation.deck.estimate import MAX_S, MIN_S, ByHeading, Known, followed_walk, wandered
from companion.estimation.means.windows import WHITE_SHARE

_FALLS: Final = 2.0
"""What more seconds take away of a variance falls with this power of the time, as long as nothing shows it: of a slope
through waves or white noise with the third, of a sensor's own white noise with the first."""
_FALLS_LEAST: Final = 1.0
_FALLS_MOST: Final = 3.0
_APART: Final = 1.15
"""So many times longer than the first is an estimate that shows the power."""
_STEP_S: Final = 20.0
_IN_MINUTES_S: Final = 90.0


class Past(msgspec.Struct, frozen=True):
    """How good the estimate of so many seconds was."""

    seconds: int
    known: tuple[Known, ...]


class Aim(msgspec.Struct, frozen=True):
    """What a triad is to be known to: the target, or all that more time can give."""

    sigma: float
    goal: float
    whole_s: int
    """Seconds of which an estimate will be that good, as far as can be told."""

    def in_words(self, unit: float, name: str) -> str:
        """'12 deg/h, goal 6.1'."""
        return f"{_figure(self.sigma / unit)} {name}, goal {_figure(self.goal / unit)}"


def aim(past: Sequence[Past], at: int, target: float) -> Aim:
    """For triad number `at`, by all estimates so far, the latest last."""
    latest, known = past[-1], past[-1].known[at]
    floor = known.use - known.white
    goal = max(target**2, floor * (1.0 + WHITE_SHARE))
    whole_s = latest.seconds
    if known.use > goal:
        wanted = (goal - floor) / known.white
        longer = (end_s for end_s in _ends_s() if end_s > latest.seconds and _left(past, at, end_s) <= wanted)
        whole_s = next(longer, MAX_S)
    return Aim(math.sqrt(known.use), math.sqrt(goal), whole_s)


def _ends_s() -> list[int]:
    """Of windows that are worked out, from the start on."""
    found, end_s = [], MIN_S
    while end_s < MAX_S:
        found.append(end_s)
        end_s += next(every for length, every in EVERY_S.items() if end_s < length)
    return [*found, MAX_S]


def _left(past: Sequence[Past], at: int, whole_s: int) -> float:
    """Share of what more seconds take away that is left after so many."""
    seconds, known = past[-1].seconds, past[-1].known[at]
    if (by := known.by_heading) is not None:
        own = known.white + wandered(by.gyro, seconds)
        own *= _slope_variance(whole_s, by) / _slope_variance(seconds, by)
        return (own - wandered(by.gyro, whole_s)) / known.white
    return math.pow(seconds / whole_s, _falls(past, at))


def _falls(past: Sequence[Past], at: int) -> float:
    first, latest = past[0], past[-1]
    was, white = first.known[at].white, latest.known[at].white
    if first.seconds * _APART > latest.seconds or white <= 0.0:
        return _FALLS
    fell = math.log(max(was, white) / white) / math.log(latest.seconds / first.seconds)
    return min(max(fell, _FALLS_LEAST), _FALLS_MOST)


def _slope_variance(whole_s: float, by: ByHeading) -> float:
    """Of a bias about the vertical as it is at the end, by headings over so many seconds.

    Iron turns with the heading: its sine and cosine are unknowns with a sigma, and where the platform turns by little
    a bias hides behind them. The bias walks: looking back from the end, its integral twice over.
    """
    count = math.ceil(whole_s / _STEP_S)
    times = (np.arange(count) + 0.5) * whole_s / count
    earlier, later = np.minimum(times[:, None], times), np.maximum(times[:, None], times)
    turned = by.turn_rad_s * times
    columns = np.column_stack([np.ones(count), times, by.iron_rad * np.sin(turned), by.iron_rad * np.cos(turned)])
    noise = by.gyro.white**2 * earlier
    noise += followed_walk(by.gyro, whole_s) ** 2 * earlier**2 * (3.0 * later - earlier) / 6.0
    noise += np.eye(count) * by.heading_white**2 * count / whole_s
    information = columns.T @ np.linalg.solve(noise, columns) + np.diag([0.0, 0.0, 1.0, 1.0])
    return float(np.linalg.inv(information)[1, 1])


def more(left_s: float) -> str:
    """As a pilot reads it."""
    if left_s < _IN_MINUTES_S:
        return f"some {math.ceil(left_s / 10.0) * 10} s more"
    return f"some {left_s / 60.0:.0f} min more"


def _figure(value: float) -> str:
    return f"{value:.{0 if value >= 9.95 else 1 if value >= 0.995 else 2}f}"

"""Does a noise profile keep its word? Every window of a recording at rest predicts the minute after it.

The windows go through the estimator that flies (`windows.estimates`): Huber's mean, the test for a ramp, the noise
that the window itself shows, and V(T, H) of the profile.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final, Self

import msgspec
import numpy as np

from companion.estimation.means.windows import ImuInput, estimates
from companion.estimation.noise.allan import NoiseProfile, allan_variance
from companion.estimation.seconds.batch import Batch
from companion.lab.profiling.profile_fit import CHANNELS, LEAST_STILL_S, MIN_SECONDS, Rest, fit_profile
from companion.physics.frames import Floats
from companion.samples import TRIADS, Triad, rows_of

MEANS_S: Final = (10, 30, 60)
NEXT_S: Final = 60
MOST_WINDOWS: Final = 400
"""Of one length and one recording: they overlap, so that more would only repeat what these say."""
SIGMAS: Final = 2.0
_AT_ONCE: Final = 100


class Held(msgspec.Struct, frozen=True, kw_only=True):
    """What was said of the time after windows (the median sigma_use), against what came (rms); rad/s or m/s^2."""

    sigma_use: float
    rms: float
    ratio: float
    """Rms of a miss over its sigma; 1 where sigma is right."""
    share: float
    """Within 2 sigma; that what comes after has white noise of its own is allowed for."""

    @classmethod
    def against(cls, miss: Floats, use: Floats, seen: Floats, **rest: Any) -> Self:
        """From misses, variances that were said, and variances of what was seen afterwards, all of one shape."""
        return cls(
            sigma_use=float(np.sqrt(np.median(np.ravel(use)))),
            rms=float(np.sqrt(np.square(miss).mean())),
            ratio=float(np.sqrt((np.square(miss) / (use + seen)).mean())),
            share=float((np.square(miss) <= SIGMAS**2 * (use + seen)).mean()),
            **rest,
        )


class Kept(Held, frozen=True, kw_only=True):
    """How often the minute after a window of T seconds came out as one triad had said."""

    triad: Triad
    mean_s: int
    windows: int
    minutes: float
    """How many windows fit beside one another: what the share is worth."""


class _Misses(msgspec.Struct):
    """One kind of window; (w, 6) each."""

    miss: list[Floats]
    use: list[Floats]
    seen: list[Floats]
    """Variance of what is seen of the next minute, about its bias."""
    minutes: float = 0.0


def coverage(recordings: Sequence[Sequence[Rest]], fallback: NoiseProfile) -> list[Kept]:
    """Fit on all recordings but one, predict in that one, in turn; of a single one, halves in the place of recordings.

    A line for each triad and length of window; none where no recording has room for a window and its minute.
    """
    parts = [list(each) for each in recordings if each]
    if len(parts) == 1:
        parts = list(_halves(parts[0]))
    tests = []
    for number, part in enumerate(parts):
        others = [rest for index, each in enumerate(parts) if index != number for rest in each]
        if sum(len(rest.slots) for rest in others) >= LEAST_STILL_S:
            tests.append((part, fit_profile("test", others, fallback).profile))
    return keeps(tests)


def keeps(
    tests: Sequence[tuple[Sequence[Rest], NoiseProfile]],
    means_s: Sequence[int] = MEANS_S,
    next_s: int = NEXT_S,
) -> list[Kept]:
    """How often the seconds after a window came out as profiles say."""
    found = {mean_s: _Misses([], [], []) for mean_s in means_s}
    for rests, profile in tests:
        for mean_s, misses in found.items():
            _predict(rests, profile, (mean_s, next_s), misses)
    return [_summary(triad, mean_s, misses) for triad in TRIADS for mean_s, misses in found.items() if misses.miss]


def _halves(rests: Sequence[Rest]) -> tuple[list[Rest], list[Rest]]:
    """The first half of the seconds at rest, and the second."""
    half = sum(len(rest.slots) for rest in rests) // 2
    first: list[Rest] = []
    second: list[Rest] = []
    for rest in rests:
        cut = min(max(half, 0), len(rest.slots))
        half -= len(rest.slots)
        for into, part in ((first, slice(0, cut)), (second, slice(cut, None))):
            if len(rest.slots[part]) >= MIN_SECONDS:
                into.append(Rest(rest.slots[part], rest.means[part], rest.temperature_degc[part], rest.batches[part]))
    return first, second


def _starts(rests: Sequence[Rest], mean_s: int, next_s: int) -> tuple[list[tuple[Rest, int]], float]:
    """Places without a hole where a window and what it predicts begin, and for how many there is room side by side."""
    length = mean_s + next_s
    room = sum(max(len(rest.slots) - length, 0) for rest in rests)
    stride = max(min(mean_s, next_s), room // MOST_WINDOWS)
    places = [
        (rest, at)
        for rest in rests
        for at in range(0, len(rest.slots) - length + 1, stride)
        if rest.slots[at + length - 1] - rest.slots[at] == length - 1
    ]
    return places, sum(len(rest.slots) // length for rest in rests) if places else 0.0


def _predict(rests: Sequence[Rest], profile: NoiseProfile, lengths_s: tuple[int, int], misses: _Misses) -> None:
    mean_s, next_s = lengths_s
    places, minutes = _starts(rests, mean_s, next_s)
    misses.minutes += minutes
    for at in range(0, len(places), _AT_ONCE):
        some = places[at : at + _AT_ONCE]
        past = [rest.batches[start : start + mean_s] for rest, start in some]
        mean, use = _estimated(past, profile, next_s)
        coming = np.stack([rest.means[start + mean_s : start + mean_s + next_s] for rest, start in some], axis=1)
        white = allan_variance(np.arange(next_s), coming.reshape(next_s, -1), 1)[0].reshape(-1, CHANNELS)
        misses.miss.append(mean - coming.mean(axis=0))
        misses.use.append(use)
        misses.seen.append(white / next_s)


def _estimated(windows: Sequence[Sequence[Batch]], profile: NoiseProfile, next_s: int) -> tuple[Floats, Floats]:
    """(w, 6) means and their use variances; every window goes in as if it were an IMU of its own."""
    imu = ImuInput(name="", rotation=np.eye(3), profile=profile)
    end_s = windows[0][-1].slot + 1.0
    found = estimates([imu] * len(windows), windows, end_s=end_s, horizon_s=float(next_s))
    return np.array([each.mean for each in found]), np.array([each.use_variance for each in found])


def _summary(triad: Triad, mean_s: int, misses: _Misses) -> Kept:
    all_of = (misses.miss, misses.use, misses.seen)
    miss, use, seen = (np.concatenate(each)[:, rows_of(triad)] for each in all_of)
    return Kept.against(miss, use, seen, triad=triad, mean_s=mean_s, windows=len(miss), minutes=misses.minutes)

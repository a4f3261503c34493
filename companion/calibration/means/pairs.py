"""A reading twice: in floats with a slowly moving bias taken off, and cut to integers with nothing taken off.

PX4 sends each sample of its IMU so (HIGHRES_IMU and SCALED_IMU, autopilots 10.3). Every pair bounds the bias b, for
the reading is float + b and lies in the integer's cell: 250 pairs a second leave 2 deg/h where an integer's step is
206. b stays the same from one publication of the estimator to the next, a second or less, and then wanders.

Its distribution is kept on a grid for each axis, as the bounds of readings near to one another are not independent:
where a sensor is quiet, or shows coarse steps of its own, they stop at the same place for ever, and no averaging takes
away what they leave open. A pair that contradicts does not exclude, it only counts against: one in some thousands is
of two samples, and b may step in the middle of a block. Everything here is in LSB and pure.
"""

from __future__ import annotations

from typing import Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from companion.calibration.means.quantised import truncation_edges
from companion.physics.frames import Floats

CELL: Final = 0.004
"""LSB: 0.8 deg/h, 4 micro-g."""
_CELLS: Final = 640
"""The cell of the integer 0 is two LSB wide, and b wanders."""
WALK: Final = 0.003
"""LSB that b wanders in one second: PX4's moves by 0.2 to 0.5 deg/h each second at rest, the accelerometers' by up to
10 micro-g in the first minute after a start."""
_WIDE_WALK: Final = 8.0
_WIDE_SHARE: Final = 0.01
_AGAINST: Final = 4.0
"""Logarithm of odds against a b by one pair that contradicts it."""
LEAST_PAIRS: Final = 4
_MOST_WRONG: Final = 0.05
_FEW_WRONG: Final = 3
"""Pairs of a block that may contradict the best b."""
_STEP, _STEP_SIGMAS = 0.05, 5.0
"""LSB, and of the sigma before: b has stepped, and some readings before that was seen were taken with the old one."""
_BAD_BLOCKS: Final = 2
_GOOD_BLOCKS: Final = 4
_WRONG_SEEN: Final = 20
"""Contradictions that neighbouring samples must have shown, were they taken for pairs: else nothing proves that the
pairs are of one sample, and of this IMU."""
_ON_LINES: Final = 0.995
"""Length of the mean of the readings' phases, from where on they lie on lines."""
_LINES: Final = (1, 2, 4, 8, 16)
"""Lines in one step of the sensor, at most, as its readings are meaned in the autopilot."""
_OFF_LINES: Final = 1e-3
KNOWN_TO: Final = 0.1
"""LSB, sigma: where the pairs tell less, the integers' own likelihood and its ways out are as good."""


class Grid(msgspec.Struct, frozen=True):
    """Coarse steps of the sensor itself, behind the telemetry; (6,) each, LSB."""

    step: Floats
    """0 where there are none, or they are not known."""
    anchor: Floats
    """A reading on which one of them lies."""


class BiasTrack:
    """What the pairs tell of b, six axes."""

    def __init__(self) -> None:
        self.grid: Grid | None = None
        """Where the sensor's steps are known, its readings lie on lines, and the floats' distance from these is b but
        for whole steps, among which the pairs choose."""
        self._origin: Floats | None = None
        """(6,) b of the first cell."""
        self._chance = np.empty((6, _CELLS))
        self._good = self._bad = self._wrong = 0
        self.restarts = 0
        """How often b stepped, or the pairs were no pairs."""
        self.bias = np.zeros(6)
        self.variance = np.full(6, np.inf)

    @property
    def known(self) -> bool:
        """Whether floats and `bias` are better than the integers."""
        return (
            self._good >= _GOOD_BLOCKS
            and self._bad == 0
            and self._wrong >= _WRONG_SEEN
            and float(self.variance.max()) <= KNOWN_TO**2
        )

    def add(self, floats: Floats, integers: NDArray[np.int64], others: Floats, seconds: float) -> None:
        """Take a block of pairs.

        Args:
            floats: (n, 6), n at least `LEAST_PAIRS`.
            integers: (n, 6) of the same samples.
            others: (m, 6) floats of samples next to those of the first m integers, for comparison.
            seconds: since the last block.
        """
        low, high = _bounds(floats, integers)
        if self._origin is None:
            self._begin(low, high)
        else:
            self._wander(seconds)
        assert self._origin is not None
        against = _contradictions(low, high, self._origin)
        least = against.min(axis=1)
        if (least > np.maximum(_MOST_WRONG * len(floats), _FEW_WRONG)).any():
            self._bad += 1
            if self._bad >= _BAD_BLOCKS:
                self.forget()
                self.restarts += 1
            return
        self._bad, self._good = 0, self._good + 1
        before, least_step = self.bias, np.maximum(_STEP, _STEP_SIGMAS * np.sqrt(self.variance))
        if self._wrong < _WRONG_SEEN:
            self._wrong += _seen_wrong(others, integers[: len(others)])
        chance = np.log(self._chance + 1e-12) - _AGAINST * against
        self._chance = np.exp(chance - chance.max(axis=1, keepdims=True))
        if self.grid is not None:
            self._chance *= _on_lines(self.grid, floats, self._origin)
        self._weigh()
        if (np.abs(self.bias - before) > least_step).any():
            self._good = 0
            self.restarts += 1

    def forget(self) -> None:
        """Start anew."""
        self._origin = None
        self._good = self._bad = self._wrong = 0
        self.variance = np.full(6, np.inf)

    def _begin(self, low: Floats, high: Floats) -> None:
        middle = (np.sort(low, axis=0)[-1 - len(low) // 20] + np.sort(high, axis=0)[len(high) // 20]) / 2.0
        self.bias = np.asarray(middle)
        self._origin = np.asarray(middle - _CELLS / 2 * CELL)
        self._chance = np.ones((6, _CELLS))

    def _wander(self, seconds: float) -> None:
        """Let b go on for so long; where it comes near to the end of the grid, move that."""
        assert self._origin is not None
        narrow = WALK * np.sqrt(seconds) / CELL
        near = _kernel(narrow)
        far = _kernel(_WIDE_WALK * narrow)
        self._chance = np.array(
            [
                (1.0 - _WIDE_SHARE) * np.convolve(row, near, "same") + _WIDE_SHARE * np.convolve(row, far, "same")
                for row in self._chance
            ]
        )
        off = np.rint((self.bias - self._origin) / CELL).astype(np.int64) - _CELLS // 2
        for axis in np.flatnonzero(np.abs(off) > _CELLS // 8):
            moved = np.zeros(_CELLS)
            kept = self._chance[axis][max(off[axis], 0) : _CELLS + min(off[axis], 0)]
            moved[max(-off[axis], 0) : max(-off[axis], 0) + len(kept)] = kept
            self._chance[axis], self._origin[axis] = moved, self._origin[axis] + off[axis] * CELL

    def _weigh(self) -> None:
        assert self._origin is not None
        share = self._chance / self._chance.sum(axis=1, keepdims=True)
        place = CELL * np.arange(_CELLS)
        mean = share @ place
        self.bias = self._origin + mean
        self.variance = share @ np.square(place) - np.square(mean) + CELL**2 / 12.0


def _bounds(floats: Floats, integers: NDArray[np.int64]) -> tuple[Floats, Floats]:
    edges = truncation_edges(integers.ravel(), 1).reshape(2, *integers.shape)
    return edges[0] - floats, edges[1] - floats


def _contradictions(low: Floats, high: Floats, origin: Floats) -> Floats:
    """(6, cells) how many pairs speak against each b."""
    grid = origin[:, None] + CELL * np.arange(_CELLS)
    below = [len(low) - np.searchsorted(np.sort(low[:, n]), grid[n], side="right") for n in range(6)]
    above = [np.searchsorted(np.sort(high[:, n]), grid[n], side="left") for n in range(6)]
    return np.asarray(np.add(below, above), dtype=np.float64)


def _on_lines(grid: Grid, floats: Floats, origin: Floats) -> Floats:
    """(6, cells) how well each b puts the readings on the sensor's lines."""
    found = np.ones((6, _CELLS))
    for axis in np.flatnonzero(grid.step > 0.0):
        for lines in _LINES:
            apart = float(grid.step[axis]) / lines
            phase = np.exp(2j * np.pi / apart * floats[:, axis]).mean()
            if abs(phase) >= _ON_LINES:
                b = grid.anchor[axis] - np.angle(phase) / (2.0 * np.pi) * apart
                off = origin[axis] + CELL * np.arange(_CELLS) - b
                off -= apart * np.rint(off / apart)
                found[axis] = np.exp(-np.square(off / CELL) / 2.0) + _OFF_LINES
                break
    return found


def _seen_wrong(others: Floats, integers: NDArray[np.int64]) -> int:
    """Contradictions with the best b of each axis, of what are no pairs."""
    if len(others) < LEAST_PAIRS:
        return 0
    low, high = _bounds(others, integers)
    middle = (np.sort(low, axis=0)[-1 - len(low) // 20] + np.sort(high, axis=0)[len(high) // 20]) / 2.0
    return int(_contradictions(low, high, middle - _CELLS / 2 * CELL).min(axis=1).sum())


def _kernel(sigma: float) -> Floats:
    reach = max(int(np.ceil(3.0 * sigma)), 1)
    bell = np.exp(-np.square(np.arange(-reach, reach + 1) / max(sigma, 1e-3)) / 2.0)
    return np.asarray(bell / bell.sum())

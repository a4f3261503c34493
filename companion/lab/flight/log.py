"""The parts of an autopilot's log that a flight is judged by, whichever firmware wrote it."""

from __future__ import annotations

import itertools
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from companion.autopilot.parameters.reading import FirmwareName
from companion.lab.flight.inertial import Navigation
from companion.lab.logs.autopilot_logs import DROPOUTS, PARAMETERS, Block
from companion.physics.frames import Floats

_MOST_PARAMETERS: Final = 1 << 16
_INSTANCES: Final = 16
"""Most instances: a larger number is damage."""


class BootMessages:
    """Messages of one start of the autopilot."""

    def __init__(self, fields: Mapping[str, int]) -> None:
        self._fields = fields
        self._chunks: dict[tuple[str, int], list[Floats]] = defaultdict(list)
        self.parameters: list[tuple[float, str, float]] = []
        self.gaps = 0
        """Gaps in which the autopilot could not write."""

    def take(self, block: Block) -> None:
        """Add a block of messages."""
        if block.name == PARAMETERS:
            found = zip(block.rows[:, 0].tolist(), block.texts, block.rows[:, 1].tolist(), strict=True)
            self.parameters += itertools.islice(found, _MOST_PARAMETERS - len(self.parameters))
        elif block.name == DROPOUTS:
            self.gaps += len(block.rows)
        elif 0 <= block.instance < _INSTANCES:
            self._chunks[block.name, block.instance].append(block.rows)

    def rows(self, name: str, instance: int = 0) -> Floats:
        """Return the rows of a message, (n, 1 + fields), the time in s first."""
        if (name, instance) not in self._chunks:
            return np.zeros((0, 1 + self._fields[name]))
        return ascending(np.concatenate(self._chunks[name, instance]))

    def instances(self, name: str) -> list[int]:
        """List the instances that have logged a message."""
        return sorted(instance for each, instance in self._chunks if each == name)


def starts(blocks: Iterable[Block | None], fields: Mapping[str, int]) -> Iterator[BootMessages]:
    """Give the starts in a file one after another: memory is that of one. `fields`: number of fields by message."""
    start = None
    for block in blocks:
        if block is not None:
            start = start or BootMessages(fields)
            start.take(block)
        elif start is not None:
            whole, start = start, None
            yield whole
    if start is not None:
        yield start


def ascending(rows: Floats) -> Floats:
    """Select rows in order of their time, the first column; a single one that is ahead of all others is damage."""
    rows = rows[np.isfinite(rows[:, 0])]
    if not len(rows):
        return rows
    times = rows[:, 0]
    ahead = (times[:-1] > times[1:]) & (times[1:] >= np.concatenate([[-np.inf], times[:-2]]))
    rows = rows[~np.append(ahead, [False])]
    return np.asarray(rows[np.concatenate([[True], rows[1:, 0] > np.maximum.accumulate(rows[:, 0])[:-1]])])


class Estimated(msgspec.Struct, frozen=True):
    """Biases as an EKF has them: values and sigmas are (n, 3), NaN where it says nothing."""

    t_s: Floats
    gyro_rad_s: Floats
    gyro_sigma_rad_s: Floats
    accel_m_s2: Floats
    accel_sigma_m_s2: Floats


class FlownImu(msgspec.Struct, frozen=True, kw_only=True):
    """One IMU in one log."""

    number: int
    """Number from 1, as in the configuration."""
    t_s: Floats
    readings: Floats
    """(n, 6) rad/s and m/s^2, corrected by the firmware, vehicle FRD."""
    means: bool
    """Each is the mean since the one before, not an instant."""
    gyro_id: int | None = None
    accel_id: int | None = None
    degc: Floats = np.zeros((0, 2))
    """Time and temperature."""
    vibration: Floats = np.zeros((0, 2))
    """Time and level, m/s^2."""
    estimated: Estimated | None = None
    failed_s: Floats = np.zeros(0)
    """Times at which the autopilot took it for failed; its readings then are left out."""

    @property
    def rate_hz(self) -> float:
        """Mean rate of the readings."""
        return (len(self.t_s) - 1) / float(self.t_s[-1] - self.t_s[0]) if len(self.t_s) > 1 else 0.0


class Boot(msgspec.Struct, frozen=True, kw_only=True):
    """Log of one start of the autopilot, whichever firmware wrote it; times in s on its clock."""

    firmware: FirmwareName
    imus: tuple[FlownImu, ...]
    solution: Navigation | None
    truth: Navigation | None = None
    """Truth of a simulator."""
    armed: tuple[tuple[float, bool], ...] = ()
    motors: tuple[tuple[float, bool], ...] = ()
    airborne: tuple[tuple[float, bool], ...] = ()
    parameters: tuple[tuple[float, str, float], ...] = ()
    unix_offset_s: float | None = None
    """UTC less its clock."""
    place: tuple[float, float] | None = None
    """Latitude in degrees, and height in m."""
    earth_turns: bool = True
    standard_gravity: bool = False
    notes: tuple[str, ...] = ()

    def parameters_at(self, t_s: float) -> dict[str, float]:
        """Return the parameters at a time; one that was logged only later has its first value."""
        found: dict[str, float] = {}
        for told_s, name, value in self.parameters:
            if told_s <= t_s or name not in found:
                found[name] = value
        return found


def changes(t_s: Sequence[float] | Floats, states: Sequence[bool] | NDArray[Any]) -> tuple[tuple[float, bool], ...]:
    """List the first state and each change after it."""
    found: list[tuple[float, bool]] = []
    for at_s, state in zip(t_s, states, strict=True):
        if not found or found[-1][1] != bool(state):
            found.append((float(at_s), bool(state)))
    return tuple(found)

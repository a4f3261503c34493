"""Readings of one IMU at rest, and a reader of CSV logs.

The names in `COLUMNS` are valid in the header of the file and in --columns. Nothing is guessed: a column with another
name is left out, with a note.
"""

from __future__ import annotations

import csv
import datetime
import itertools
import math
from array import array
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final, TextIO

import msgspec
import numpy as np
from numpy.typing import NDArray

from companion.config.sections import NoiseProfile
from companion.errors import StorageError
from companion.physics.frames import Floats
from companion.physics.units import DEG, DEG_H, MG, G

NAME: Final = "imu"

LAST_S: Final = 1e11
IMU: Final = ("gx", "gy", "gz", "ax", "ay", "az")
_UNITS: Final[tuple[tuple[tuple[str, ...], dict[str, float]], ...]] = (
    (("t",), {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}),
    (IMU[:3], {"rad_s": 1.0, "deg_s": DEG, "deg_h": DEG_H, "mdeg_s": 1e-3 * DEG}),
    (IMU[3:], {"m_s2": 1.0, "g": G, "mg": MG}),
    (("temperature",), {"degc": 1.0}),
)
COLUMNS: Final[dict[str, tuple[str, float]]] = {
    f"{what}_{unit}": (what, factor)
    for quantities, units in _UNITS
    for what in quantities
    for unit, factor in units.items()
}
"""Quantity by column name, and the factor from its unit to s, rad/s, m/s^2 or degrees Celsius."""
HEADER: Final = "t_s,gx_rad_s,gy_rad_s,gz_rad_s,ax_m_s2,ay_m_s2,az_m_s2"
GRAVITY_M_S2: Final = (7.0, 12.6)
"""Allowed median specific force of a log at rest; outside this range, a unit or a column has a wrong name."""

PASSED_OVER: Final = ("-", "_")  # Names in --columns of a column that is not read
_SEPARATORS: Final = (";", "\t", ",", " ")
_LONGEST: Final = 1 << 14
_NUMBERS: Final = 1e20
"""Limit of a number in any unit, above nanoseconds since 1970 (2e18); a larger one counts as missing."""
_WRAPS: Final = 2.0**32
"""Range of a 32-bit time counter: an Arduino's micros() restarts at zero every 71.6 min."""
_MOST_NAMED: Final = 12


class StillLog(msgspec.Struct, frozen=True, kw_only=True):
    """Readings of one IMU at rest in one run: a file, or several consecutive ones.

    Readings (n, 6) are in rad/s and m/s^2, axes as recorded; samples in integers are left out, so that n may be 0.
    `profile` is the noise profile configured for the recording. `clock_offset_s` is UTC minus the recording's clock.
    `breaks_s` are times of steps that are not noise, such as a write of offsets or a restart. `left_out` counts ignored
    lines by reason. `clock_from_start`: times count from the autopilot's power-on.
    """

    imu: str
    files: tuple[str, ...]
    t_s: Floats  # (n,) ascending
    readings: Floats
    temperature_degc: Floats  # (n,); NaN: unknown
    profile: str | NoiseProfile | None = None
    clock_offset_s: float | None = None
    breaks_s: tuple[float, ...] = ()

    notes: tuple[str, ...] = ()  # Assumptions and oddities, as text
    left_out: dict[str, int] = {}
    clock_from_start: bool = False

    @property
    def began_unix_s(self) -> float | None:
        return float(self.t_s[0]) + self.clock_offset_s if self.clock_offset_s is not None and len(self.t_s) else None

    @property
    def began_at(self) -> str | None:
        if self.began_unix_s is None:
            return None
        return datetime.datetime.fromtimestamp(self.began_unix_s, tz=datetime.UTC).isoformat(timespec="seconds")

    def pieces(self, skip_s: float = 0.0) -> list[slice]:
        """Return slices of the samples between the breaks, in order, without the first `skip_s` of the run."""
        first = int(np.searchsorted(self.t_s, self.t_s[0] + skip_s))
        cuts = [first, *(max(int(at), first) for at in np.searchsorted(self.t_s, sorted(self.breaks_s))), len(self.t_s)]
        return [slice(start, end) for start, end in itertools.pairwise(cuts) if end > start]


def unreadable(path: Path, error: OSError) -> StorageError:
    return StorageError(f"{path}: cannot be read: {error.strerror or error}")


def read_csv(path: Path, columns: str | None = None, rate_hz: float | None = None, name: str = NAME) -> StillLog:
    """Read a CSV file, separated by semicolons, tabs, commas or blanks; "#" starts a comment.

    `columns`, separated by commas, replace the file's header; `rate_hz` replaces its times.
    """
    try:
        with path.open(encoding="utf-8-sig", errors="replace") as file:
            names, where, lines = _header(path, file, columns)
            used = columns_of(names, where, timed=rate_hz is None)
            table, numbers = _numbers(path, lines, names, used, more=columns is not None)
    except OSError as error:
        raise unreadable(path, error) from None
    if rate_hz is not None:
        table[:, 0] = np.arange(len(table)) / rate_hz
    passed = [each for each in names if each not in COLUMNS and each not in PASSED_OVER]
    left_out: dict[str, int] = {}

    def keep(good: NDArray[np.bool_], why: str) -> None:
        nonlocal table, numbers
        if not good.all():
            left_out[why] = int((~good).sum())
            table, numbers = table[good], numbers[good]

    keep(np.all(np.isfinite(table[:, 1:7]), axis=1), "without a number in each of " + ", ".join(IMU))
    keep(np.isfinite(table[:, 0]), "without a time")
    if not len(table):
        raise StorageError(f"{path}: no line in it has a number for all of {', '.join(IMU)}")
    changed = np.any(np.diff(table[:, :7], axis=0) != 0.0, axis=1)
    keep(np.append([True], changed), "repeated: time and readings of the line before")
    t_s = table[:, 0] if rate_hz is not None else _times(path, table[:, 0], COLUMNS[used["t"]][1], numbers)
    readings = table[:, 1:7] * [COLUMNS[used[what]][1] for what in IMU]
    _check_gravity(path, readings[:, 3:], [used[what] for what in IMU[3:]])
    return StillLog(
        imu=name,
        files=(path.name,),
        t_s=t_s,
        readings=readings,
        temperature_degc=table[:, 7],
        notes=(f"columns skipped: {_some(passed)}",) if passed else (),
        left_out=left_out,
    )


def columns_of(names: Sequence[str], where: str, *, timed: bool) -> dict[str, str]:
    used: dict[str, str] = {}
    for name in names:
        if name in COLUMNS:
            what, _ = COLUMNS[name]
            if what in used:
                raise StorageError(f"{where}: two columns for {what}: {used[what]} and {name}")
            used[what] = name
    if not timed:
        used.pop("t", None)
    wanted = (*(("t",) if timed else ()), *IMU)
    if missing := [what for what in wanted if what not in used]:
        rate = "; a log without time: --rate HZ" if "t" in missing else ""
        raise StorageError(
            f"{where}: no column for {', '.join(missing)} in {_some(names)}{rate}; allowed: {HEADER} or other units"
            " (docs/recording.md), in the file or in --columns"
        )
    return used


def _some(names: Sequence[str]) -> str:
    more = f" and {len(names) - _MOST_NAMED} more" if len(names) > _MOST_NAMED else ""
    return ", ".join(name[:40] for name in names[:_MOST_NAMED]) + more


def _header(path: Path, file: TextIO, columns: str | None) -> tuple[list[str], str, Iterator[tuple[int, list[str]]]]:
    """Return the column names, their origin for messages, and the numbered lines as fields."""
    lines = _lines(file, path)
    number, first = next(lines, (0, ""))
    if not number:
        raise StorageError(f"{path}: the file is empty")
    if columns is None:
        names, where = [name.strip() for name in _fields(first, _separator(first))], f"{path}, line {number}"
        separator = _separator(first)
    else:
        names, where = columns.split(","), "--columns"
        # Text before the numbers is a second header, or a logger's preamble.
        lines = itertools.chain([(number, first)], lines)
        lines = itertools.dropwhile(lambda line: _is_text(line[1], len(names)), lines)
        found = next(lines, (0, ""))
        separator, lines = _separator(found[1]), itertools.chain([found] if found[0] else [], lines)
    while names and not names[-1]:
        names.pop()  # a separator at the end of the line
    return names, where, ((number, _fields(text, separator)) for number, text in lines)


def _lines(file: TextIO, path: Path) -> Iterator[tuple[int, str]]:
    """Yield the numbered lines of a file, without blank lines, comments, and a cut last line."""
    for number, line in enumerate(iter(lambda: file.readline(_LONGEST), ""), 1):
        if len(line) == _LONGEST:
            raise StorageError(f"{path}, line {number}: found no line end within {_LONGEST} characters")
        if number > 1 and not line.endswith("\n"):
            return  # cut, perhaps inside a number, which would still look like a number
        text = line.strip(" \n")
        if text.strip() and not text.startswith("#"):
            yield number, text


def _separator(text: str) -> str:
    return next((each for each in _SEPARATORS if each in text), ",")


def _fields(text: str, separator: str) -> list[str]:
    if '"' not in text:
        return text.split() if separator == " " else text.split(separator)
    try:
        return next(csv.reader((text,), delimiter=separator, skipinitialspace=separator == " "), [])
    except csv.Error:
        return [text]


def _is_text(line: str, width: int) -> bool:
    fields = _fields(line, _separator(line))
    return len(fields) < width or not any(map(_is_number, fields))


def _is_number(text: str) -> bool:
    try:
        return math.isfinite(float(text))
    except ValueError:
        return False


def _numbers(
    path: Path, lines: Iterator[tuple[int, list[str]]], names: Sequence[str], used: dict[str, str], *, more: bool
) -> tuple[Floats, Floats]:
    """Read time, readings and temperature, (n, 8), NaN if missing, and the number of each line, (n,).

    `more`: lines may have more fields than `names`.
    """
    places, width = [names.index(name) for name in used.values()], len(names)
    flat, numbers = array("d"), array("d")
    for number, fields in lines:
        if len(fields) < width or (not more and any(field.strip() for field in fields[width:])):
            raise StorageError(
                f"{path}, line {number}: found {len(fields)} fields; allowed: {width}, as many as columns"
            )
        for place in places:
            try:
                flat.append(float(fields[place].strip(' "\t\r\n') or "nan"))
            except ValueError:
                raise StorageError(
                    f"{path}, line {number}: found {fields[place]!r} in column {names[place]}; allowed: a number"
                ) from None
        numbers.append(number)
    if not numbers:
        raise StorageError(f"{path}: no line of numbers in it with {width} fields")
    table = np.full((len(numbers), 8), math.nan)
    table[:, [("t", *IMU, "temperature").index(what) for what in used]] = np.array(flat).reshape(-1, len(places))
    table[~(np.abs(table) < _NUMBERS)] = math.nan
    return table, np.array(numbers)


def _times(path: Path, stamps: Floats, factor: float, numbers: Floats) -> Floats:
    falls = np.diff(stamps) < -_WRAPS / 2.0
    if falls.any() and (np.abs(stamps) < _WRAPS).all():  # a counter of 32 bits
        stamps = stamps + _WRAPS * np.concatenate(([0], np.cumsum(falls)))
    t_s = stamps * factor
    if (latest_s := np.abs(t_s).max()) > LAST_S:
        line = numbers[np.abs(t_s).argmax()]
        raise StorageError(f"{path}, line {line:.0f}: time {latest_s:.3g} s; allowed: up to {LAST_S:g} s")
    if len(back := np.flatnonzero(np.diff(t_s) <= 0.0)):
        before, after = t_s[back[0] : back[0] + 2]
        raise StorageError(
            f"{path}, line {numbers[back[0] + 1]:.0f}: time {after:.6f} s after {before:.6f} s; allowed:"
            " growing times, or --rate HZ in their place"
        )
    return np.asarray(t_s)


def _check_gravity(path: Path, forces: Floats, names: Sequence[str]) -> None:
    """Refuse a log whose specific force at rest is not gravity: a wrong unit would also falsify the bias."""
    with np.errstate(over="ignore"):
        found_m_s2 = float(np.median(np.sqrt(np.square(forces).sum(axis=1))))
    low, high = GRAVITY_M_S2
    if not low <= found_m_s2 <= high:
        raise StorageError(
            f"{path}: {', '.join(names)} read {found_m_s2:.4g} m/s^2 in all; allowed: gravity, {low:g} to {high:g}:"
            " name their right unit, or log the accelerometer itself"
        )

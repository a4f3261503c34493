"""A CSV log of an IMU: names of columns that say quantity and unit, then a line for each sample.

There is one vocabulary of names (`COLUMNS`), for the header of the file and for --columns alike. Nothing is guessed: a
column of another name is passed over, and said.
"""

from __future__ import annotations

import csv
import itertools
import math
from array import array
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final, NamedTuple, TextIO

import numpy as np
from numpy.typing import NDArray

from companion.errors import StorageError
from companion.lab.logs.log import LAST_S, NAME, Poses, StillLog
from companion.physics.frames import Floats
from companion.physics.units import DEG, DEG_H, MG, G

IMU: Final = ("gx", "gy", "gz", "ax", "ay", "az")
TILT: Final = ("tilt_x", "tilt_y")
_UNITS: Final[tuple[tuple[tuple[str, ...], dict[str, float]], ...]] = (
    (("t",), {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}),
    (IMU[:3], {"rad_s": 1.0, "deg_s": DEG, "deg_h": DEG_H, "mdeg_s": 1e-3 * DEG}),
    (IMU[3:], {"m_s2": 1.0, "g": G, "mg": MG}),
    (("temperature",), {"degc": 1.0}),
    ((*TILT, "heading", "heading_magnetic"), {"deg": 1.0}),
)
COLUMNS: Final[dict[str, tuple[str, float]]] = {
    f"{what}_{unit}": (what, factor)
    for quantities, units in _UNITS
    for what in quantities
    for unit, factor in units.items()
}
"""Quantity by name of a column, and its factor to seconds, rad/s, m/s^2, degrees and degrees Celsius."""
HEADER: Final = "t_s,gx_rad_s,gy_rad_s,gz_rad_s,ax_m_s2,ay_m_s2,az_m_s2"
GRAVITY_M_S2: Final = (7.0, 12.6)
"""Median specific force of a log at rest or nearly so: beyond, the unit or the column is another one than named."""

_SEPARATORS: Final = (";", "\t", ",", " ")
_LONGEST: Final = 1 << 14
"""The most characters of a line: a hundred columns have a tenth of that."""
_AT_ONCE: Final = 4096
_NUMBERS: Final = 1e20
"""Limit of a number in any unit: nanoseconds since 1970 are 2e18."""
_WRAPS: Final = 2.0**32
"""Range of a counter of 32 bits: an Arduino's micros() begins anew every 71.6 min."""
_MOST_NAMED: Final = 12


class Column(NamedTuple):
    """One column that is read."""

    place: int
    """Number of the column, from 0."""
    factor: float
    name: str


def read(path: Path, columns: str | None = None, rate_hz: float | None = None, name: str = NAME) -> StillLog:
    """Read a CSV file: semicolons, tabs, commas or blanks; "#" begins a remark.

    `columns`, separated by commas, take the place of the file's header, and a rate that of its times.

    Raises:
        StorageError: one line with the number of the line, what was found and what is allowed.
    """
    try:
        with path.open(encoding="utf-8-sig", errors="replace") as file:
            return _Table(path, file, columns, timed=rate_hz is None).log(name, rate_hz)
    except OSError as error:
        raise StorageError(f"{path}: cannot be read as text: {error.strerror or error}") from None


def columns_of(names: Sequence[str], where: str, *, timed: bool) -> dict[str, Column]:
    """Map quantities to columns; one is time, if `timed`.

    Raises:
        StorageError: a quantity is missing, or is there twice.
    """
    used: dict[str, Column] = {}
    for place, name in enumerate(names):
        if (known := COLUMNS.get(name)) is not None:
            what, factor = known
            if what in used:
                raise StorageError(f"{where}: two columns for {what}: {used[what].name} and {name}")
            used[what] = Column(place, factor, name)
    if not timed:
        used.pop("t", None)
    wanted = (*(("t",) if timed else ()), *IMU, *(TILT if used.keys() & {*TILT} else ()))
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


def _lines(file: TextIO, path: Path) -> Iterator[tuple[int, str]]:
    """Give the lines of a file with their numbers; leave out blank ones, remarks, and a last one that is cut."""
    for number, line in enumerate(iter(lambda: file.readline(_LONGEST), ""), 1):
        if len(line) == _LONGEST:
            raise StorageError(f"{path}, line {number}: found no line end within {_LONGEST} characters")
        if number > 1 and not line.endswith("\n"):
            return  # in the middle of a number, perhaps, which then still looks like one
        text = line.strip(" \n")
        if text.strip() and not text.startswith("#"):
            yield number, text


def _fields(text: str, separator: str) -> list[str]:
    try:
        return next(csv.reader((text,), delimiter=separator, skipinitialspace=separator == " "), [])
    except csv.Error:
        return [text]


def _separator(text: str) -> str:
    return next((each for each in _SEPARATORS if each in text), ",")


def _is_number(text: str) -> bool:
    try:
        return math.isfinite(float(text))
    except ValueError:
        return False


class _Table:
    """One file while it is read."""

    def __init__(self, path: Path, file: TextIO, columns: str | None, *, timed: bool) -> None:
        self._path = path
        lines = _lines(file, path)
        number, first = next(lines, (0, ""))
        if not number:
            raise StorageError(f"{path}: the file is empty")
        self._separator = _separator(first)
        if columns is None:
            names, where = [name.strip() for name in _fields(first, self._separator)], f"{path}, line {number}"
        else:
            names, where = columns.split(","), "--columns"
            # Text before the numbers is another header, or a logger's preamble.
            lines = itertools.dropwhile(
                lambda line: _is_text(line[1], len(names)), itertools.chain([(number, first)], lines)
            )
            if (first_of_numbers := next(lines, None)) is not None:
                self._separator = _separator(first_of_numbers[1])
                lines = itertools.chain([first_of_numbers], lines)
        while names and not names[-1]:
            names.pop()  # a separator at the end of the line
        self._names, self._data = names, lines
        self._columns = columns_of(names, where, timed=timed)
        passed = [name for name in names if name not in COLUMNS and name != "-"]
        self._notes = [f"columns passed over: {_some(passed)}"] if passed else []
        self._left_out: Counter[str] = Counter()

    def log(self, name: str, rate_hz: float | None) -> StillLog:
        """Read it to its end."""
        order = [what for quantities, _ in _UNITS for what in quantities if what in self._columns]
        places = [self._columns[what].place for what in order]
        flat, numbers = array("d"), array("I")
        while some := list(itertools.islice(self._data, _AT_ONCE)):
            lines, block = self._block([text for _, text in some], [number for number, _ in some], places)
            block[~(np.abs(block) < _NUMBERS)] = math.nan
            flat.frombytes(np.ascontiguousarray(block).tobytes())
            numbers.extend(lines)
        if not flat:
            raise StorageError(f"{self._path}: no line of numbers in it with {len(self._names)} fields")
        table = np.frombuffer(flat).reshape(-1, len(order))
        values = {what: table[:, column] for column, what in enumerate(order)}
        first = order.index("gx")
        readings = table[:, first : first + 6]
        whole = np.asarray(np.isfinite(readings).all(axis=1))
        self._count("without a number in each of " + ", ".join(IMU), whole)
        if rate_hz is None:
            t_s, kept = self._times(values["t"], readings, whole, numbers)
        else:
            kept = np.flatnonzero(whole)
            t_s = kept / rate_hz
        if not len(kept):
            raise StorageError(f"{self._path}: no line in it has a number for all of {', '.join(IMU)}")
        if len(kept) < len(readings):
            readings = readings[kept]
            values = {what: column[kept] for what, column in values.items()}
        # In place: of a night it is the largest array.
        readings *= [self._columns[what].factor for what in IMU]
        self._check_gravity(readings[:, 3:])
        return StillLog(
            imu=name,
            files=(self._path.name,),
            began_unix_s=None,
            t_s=t_s,
            readings=readings,
            temperature_degc=values.get("temperature", np.full(len(t_s), math.nan)),
            poses=_poses(values),
            notes=tuple(self._notes),
            left_out=dict(self._left_out),
        )

    def _check_gravity(self, forces: Floats) -> None:
        """Refuse units that make gravity another one: they would make another bias, too."""
        with np.errstate(over="ignore"):
            found_m_s2 = float(np.median(np.sqrt(np.square(forces).sum(axis=1))))
        low, high = GRAVITY_M_S2
        if not low <= found_m_s2 <= high:
            names = ", ".join(self._columns[what].name for what in IMU[3:])
            raise StorageError(
                f"{self._path}: {names} read {found_m_s2:.4g} m/s^2 in all; allowed: gravity, {low:g} to {high:g}: name"
                " their right unit, or log the accelerometer itself"
            )

    def _block(self, texts: list[str], numbers: list[int], places: Sequence[int]) -> tuple[list[int], Floats]:
        """Read some thousand lines; return their numbers, and the values of the columns."""
        separator, width = self._separator, len(self._names)
        if separator != " " and all(text.count(separator) == width - 1 for text in texts):
            try:
                found = np.loadtxt(texts, delimiter=separator, usecols=places, comments=None, quotechar='"', ndmin=2)
            except ValueError:
                pass  # not all of it is numbers
            else:
                return numbers, found
        values, lines = [], []
        rows = csv.reader(texts, delimiter=separator, skipinitialspace=separator == " ")
        try:
            for row in rows:
                number = numbers[rows.line_num - 1]
                if len(row) < width or any(field.strip() for field in row[width:]):
                    raise StorageError(
                        f"{self._path}, line {number}: found {len(row)} fields; allowed: {width}, as many as columns"
                    )
                values.append([self._number(row[place], number, place) for place in places])
                lines.append(number)
        except csv.Error as error:
            raise StorageError(f"{self._path}, line {numbers[rows.line_num - 1]}: {error}") from None
        return lines, np.array(values).reshape(-1, len(places))

    def _number(self, field: str, line: int, place: int) -> float:
        try:
            return float(field.strip(' "\t\r\n') or "nan")
        except ValueError:
            raise StorageError(
                f"{self._path}, line {line}: found {field!r} in column {self._names[place]}; allowed: a number"
            ) from None

    def _times(
        self, stamps: Floats, readings: Floats, whole: NDArray[np.bool_], numbers: array[int]
    ) -> tuple[Floats, NDArray[np.intp]]:
        """Give the times of the lines that count, and which those are."""
        timed = np.isfinite(stamps)
        self._count("without a time", timed)
        kept = np.flatnonzero(whole & timed)
        stamps = stamps[kept]
        falls = np.diff(stamps) < -_WRAPS / 2.0
        if falls.any() and (np.abs(stamps) < _WRAPS).all():  # a counter of 32 bits
            stamps = stamps + _WRAPS * np.concatenate(([0], np.cumsum(falls)))
        t_s = stamps * self._columns["t"].factor
        if len(t_s) and np.abs(t_s).max() > LAST_S:
            line = numbers[int(kept[np.abs(t_s).argmax()])]
            raise StorageError(
                f"{self._path}, line {line}: time {np.abs(t_s).max():.3g} s; allowed: up to {LAST_S:g} s"
            )
        back = np.flatnonzero(np.diff(t_s) < 0.0)
        if len(back):
            line = numbers[int(kept[back[0] + 1])]
            raise StorageError(
                f"{self._path}, line {line}: time {t_s[back[0] + 1]:.6f} s after {t_s[back[0]]:.6f} s; allowed:"
                " growing times, or --rate HZ in their place"
            )
        again = np.zeros(len(kept), dtype=bool)
        equal = np.flatnonzero(np.diff(t_s) == 0.0) + 1
        again[equal] = (readings[kept[equal]] == readings[kept[equal - 1]]).all(axis=1)
        self._count("repeated: time and readings of the line before", ~again)
        kept, t_s = kept[~again], t_s[~again]
        return self._spread(t_s), kept

    def _count(self, why: str, good: NDArray[np.bool_]) -> None:
        if count := int((~good).sum()):
            self._left_out[why] += count

    def _spread(self, t_s: Floats) -> Floats:
        """Spread lines of one stamp evenly over the time to the next one: a logger's clock has coarse steps."""
        first = np.flatnonzero(np.diff(t_s, prepend=-math.inf) > 0.0)
        runs = np.diff(np.append(first, len(t_s)))
        if len(first) == len(t_s):
            return t_s
        self._notes.append(f"{len(t_s) - len(first)} lines with the time of the line before: spread evenly")
        steps = np.diff(t_s[first])
        usual = np.median(steps, axis=0) if len(steps) else 0.0
        steps = np.minimum(np.append(steps, usual), usual)
        within = np.arange(len(t_s)) - np.repeat(first, runs)
        return np.asarray(t_s + within * np.repeat(steps / runs, runs))


def _is_text(line: str, width: int) -> bool:
    fields = _fields(line, _separator(line))
    return len(fields) < width or not any(map(_is_number, fields))


def _poses(values: dict[str, Floats]) -> Poses | None:
    tilt = np.column_stack([values[what] for what in TILT]) if TILT[0] in values else None
    true, magnetic = values.get("heading"), values.get("heading_magnetic")
    heading = magnetic if true is None else true
    if tilt is None and heading is None:
        return None
    return Poses(tilt_deg=tilt, heading_deg=heading, magnetic=true is None and magnetic is not None)

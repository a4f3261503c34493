"""A table of text, as apps, loggers and other people's programs write them: its samples, and what was left out of it.

`columns` says what its columns mean, `sizes` in which units, where nothing says it.
"""

from __future__ import annotations

import codecs
import csv
import datetime
import itertools
import math
import re
from array import array
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final, TextIO

import numpy as np
from numpy.typing import NDArray

from companion.calibration.noise.robust import median
from companion.errors import StorageError
from companion.physics.frames import Floats
from companion.replay import sizes
from companion.replay.columns import (
    IMU,
    TILT,
    TIMES,
    UNITS,
    Columns,
    columns_of,
    looks_like_units,
    meaning,
)  # fmt: skip
from companion.replay.log import LAST_S, NAME, Poses, StillLog

_LONGEST: Final = 1 << 14
"""The most characters of a line: a hundred columns have a tenth of that."""
_REMARKS: Final = ("#", "//", "%")
_NO_NUMBER: Final = frozenset(("", "nan", "na", "n/a", "null", "none", "-", "--", "nil", "#n/a"))
_MOST_TEXTS: Final = 60
"""Lines of text before the numbers: a logger's preamble, the names, the units."""
_AT_ONCE: Final = 4096
_NUMBERS: Final = 1e20
"""What is larger is none, in any unit: nanoseconds since 1970 are 2e18."""
_WRAPS: Final = 2.0**32
"""A counter of 32 bits begins anew: an Arduino's micros() every 71.6 min."""
_DECIMAL_COMMA: Final = re.compile(r"[+-]?\d+,\d+(?:[eE][+-]?\d+)?")


def _lines(file: TextIO, path: Path) -> Iterator[tuple[int, str]]:
    """The lines of a file with their numbers; a last one that is cut is left out."""
    some, readline = False, lambda: file.readline(_LONGEST)
    for number, line in enumerate(iter(readline, ""), 1):
        if len(line) == _LONGEST:
            raise StorageError(f"{path}, line {number}: found no line end within {_LONGEST} characters")
        if some and not line.endswith(("\n", "\r")):
            return  # in the middle of a number, perhaps, which then still looks like one
        text = line.strip(" \r\n")
        if text[:1].isdigit() or (
            text.strip() and not text.startswith(_REMARKS) and not text.lower().startswith("sep=")
        ):
            some = True
            yield number, text


def read(path: Path, columns: str | None = None, rate_hz: float | None = None, name: str = NAME) -> StillLog:
    """All that is of use in a CSV file: semicolons, tabs, commas or blanks; "#", "//" and "%" begin a remark.

    `columns` in their order stand in place of the file's own, a rate in place of its times.

    Raises:
        StorageError: one line with the number of the line, what was found and what is allowed.
    """
    try:
        with path.open("rb") as file:
            wide = file.read(2) in {codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE}
        # Where it is Latin-1 instead, the degree sign still shows (`columns`).
        encoding, errors = ("utf-16", "strict") if wide else ("utf-8-sig", "surrogateescape")
        with path.open(encoding=encoding, errors=errors, newline="") as file:
            return _Table(path, file, columns, rate_hz).log(name)
    except UnicodeError as error:
        raise StorageError(f"{path}: cannot be read as text: {error}") from None
    except OSError as error:
        raise StorageError(f"{path}: cannot be read as text: {error.strerror or error}") from None


class _Table:
    """One file while it is read."""

    def __init__(self, path: Path, file: TextIO, names: str | None, rate_hz: float | None) -> None:
        self._path = path
        self._rate_hz = rate_hz
        self._left_out: Counter[str] = Counter()
        self._notes: list[str] = []
        lines = _lines(file, path)
        texts, (number, first) = self._beginning(lines)
        self._separator = _separator(first, [text for _, text in texts])
        self._comma = self._separator != "," and any(map(_DECIMAL_COMMA.fullmatch, self._split(first)))
        self._columns, self._again = self._named(texts, names, number)
        self._width = len(self._columns.names)
        self._dates = False
        self._data = itertools.chain(((number, first),), lines)

    # --- the beginning

    def _beginning(self, lines: Iterator[tuple[int, str]]) -> tuple[list[tuple[int, str]], tuple[int, str]]:
        """The lines of text before the first one of numbers, and that one."""
        texts: list[tuple[int, str]] = []
        for line in lines:
            if any(_is_data(_fields(line[1], separator)) for separator in _SEPARATORS):
                return texts, line
            texts.append(line)
            if len(texts) > _MOST_TEXTS:
                raise StorageError(f"{self._path}: no line of numbers among the first {_MOST_TEXTS}")
        if not texts:
            raise StorageError(f"{self._path}: the file is empty")
        return texts, (0, "")

    def _split(self, text: str) -> list[str]:
        return _fields(text, self._separator)

    def _named(self, texts: Sequence[tuple[int, str]], names: str | None, first: int) -> tuple[Columns, list[str]]:
        """The columns, and their names as they may come again further down; numbers begin in line `first`."""
        timed = self._rate_hz is None
        if names is not None:
            return columns_of(names.split(","), "--columns", timed=timed), []
        if not texts:
            raise StorageError(
                f"{self._path}, line {first}: no names of columns; name them: --columns t_s,gx_rad_s,..."
            )
        rows = [self._split(text) for _, text in texts]
        known = [sum(meaning(name) is not None for name in row) for row in rows]
        at = known.index(max(known)) if any(known) else len(rows) - 1
        head = rows[at]
        while len(head) > 1 and not head[-1].strip():
            head = head[:-1]
        units = next((row for row in rows[at + 1 :] if looks_like_units(row)), [])
        return columns_of(head, f"{self._path}, line {texts[at][0]}", units, timed=timed), head

    # --- the numbers

    def log(self, name: str) -> StillLog:
        """Read it to its end."""
        order = [what for what in UNITS if what in self._columns.used]
        flat, numbers = array("d"), array("I")
        for lines, block in self._blocks([self._columns.used[what].place for what in order]):
            block[~(np.abs(block) < _NUMBERS)] = math.nan
            flat.frombytes(np.ascontiguousarray(block).tobytes())
            numbers.extend(lines)
        if not flat:
            raise StorageError(f"{self._path}: no line of numbers in it")
        table = np.frombuffer(flat).reshape(-1, len(order))
        values = {what: table[:, column] for column, what in enumerate(order)}
        first = order.index("gx")
        readings = table[:, first : first + 6]
        t_s, kept = self._times(values.get("t"), readings, numbers)
        if not len(kept):
            raise StorageError(f"{self._path}: no line in it has a number for all of {', '.join(IMU)}")
        if len(kept) < len(readings):
            readings = readings[kept]
            values = {what: column[kept] for what, column in values.items()}
        units, notes = sizes.units_of(self._columns, t_s, readings, str(self._path))
        self._notes += notes
        # In place: of a night it is the largest thing there is.
        readings *= sizes.factors(units)
        return StillLog(
            imu=name,
            files=(self._path.name,),
            began_unix_s=None,
            t_s=t_s,
            readings=readings,
            temperature_degc=values.get("temperature", np.full(len(t_s), math.nan)),
            poses=self._poses(values),
            notes=tuple(self._notes),
            left_out=dict(self._left_out),
        )

    def _blocks(self, places: Sequence[int]) -> Iterator[tuple[list[int], Floats]]:
        """Some thousand lines at a time: their numbers, and what stands in the columns."""
        texts, numbers = [], []
        for number, text in self._data:
            texts.append(text)
            numbers.append(number)
            if len(texts) == _AT_ONCE:
                yield self._block(texts, numbers, places)
                texts, numbers = [], []
        if texts and texts != [""]:
            yield self._block(texts, numbers, places)

    def _block(self, texts: list[str], numbers: list[int], places: Sequence[int]) -> tuple[list[int], Floats]:
        separator, between = self._separator, self._width - 1
        if separator != " " and not self._comma and all(text.count(separator) == between for text in texts):
            try:
                found = np.loadtxt(texts, delimiter=separator, usecols=places, comments=None, quotechar='"', ndmin=2)
            except ValueError:
                pass  # not all of it is numbers
            else:
                return numbers, found
        return self._field_by_field(texts, numbers, places)

    def _field_by_field(self, texts: list[str], numbers: list[int], places: Sequence[int]) -> tuple[list[int], Floats]:
        values, lines = [], []
        rows = csv.reader(texts, delimiter=self._separator, skipinitialspace=self._separator == " ")
        try:
            for row in rows:
                number = numbers[rows.line_num - 1]
                if row == self._again:
                    self._left_out["names again"] += 1
                    continue
                self._check_width(number, row)
                values.append([self._number(row[place], number, place) for place in places])
                lines.append(number)
        except csv.Error as error:
            raise StorageError(f"{self._path}, line {numbers[rows.line_num - 1]}: {error}") from None
        return lines, np.array(values).reshape(-1, len(places))

    def _check_width(self, number: int, row: Sequence[str]) -> None:
        if len(row) < self._width or any(field.strip() for field in row[self._width :]):
            raise StorageError(
                f"{self._path}, line {number}: found {len(row)} fields; allowed: {self._width}, as many as columns"
            )

    def _number(self, field: str, line: int, place: int) -> float:
        text = field.strip(_AROUND)
        if self._comma:
            text = text.replace(",", ".")
        try:
            return float(text)
        except ValueError:
            if text.lower() in _NO_NUMBER:
                return math.nan
        if "t" in self._columns.used and place == self._columns.used["t"].place:
            try:
                found = datetime.datetime.fromisoformat(text)
            except ValueError:
                pass
            else:
                self._dates = True
                return (found if found.tzinfo else found.replace(tzinfo=datetime.UTC)).timestamp()
        raise StorageError(
            f"{self._path}, line {line}: found {field!r} in column {self._columns.names[place]}; allowed: a number"
        )

    # --- times

    def _times(self, stamps: Floats | None, readings: Floats, numbers: array[int]) -> tuple[Floats, NDArray[np.intp]]:
        """Times of the lines that count, and which those are."""
        whole = np.asarray(np.isfinite(readings).all(axis=1))
        self._count("without a number in each of " + ", ".join(IMU), whole)
        if stamps is None:
            assert self._rate_hz is not None
            kept = np.flatnonzero(whole)
            return kept / self._rate_hz, kept
        timed = np.isfinite(stamps)
        self._count("without a time", timed)
        kept = np.flatnonzero(whole & timed)
        raw = _unwrapped(stamps[kept])
        t_s = raw * TIMES[self._time_unit(raw)]
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
        if again.any():
            self._count("repeated: time and readings of the line before", ~again)
            kept, t_s = kept[~again], t_s[~again]
        return self._spread(t_s), kept

    def _count(self, why: str, good: NDArray[np.bool_]) -> None:
        if count := int((~good).sum()):
            self._left_out[why] += count

    def _time_unit(self, raw: Floats) -> str:
        column = self._columns.used["t"]
        if self._dates:
            return "s"
        if column.unit is not None:
            return column.unit
        unit = sizes.seconds_per(np.diff(raw))
        if unit is None:
            raise StorageError(
                f"{self._path}: column {column.name} says no unit, and its steps do not tell; name them: --columns"
                f" {self._columns.named({'t': 's'})}"
            )
        self._notes.append(f"{column.name}: taken for {unit}, by its steps")
        return unit

    def _spread(self, t_s: Floats) -> Floats:
        """Lines of one stamp evenly over the time to the next one: a logger's clock has coarse steps."""
        first = np.flatnonzero(np.diff(t_s, prepend=-math.inf) > 0.0)
        runs = np.diff(np.append(first, len(t_s)))
        if len(first) == len(t_s):
            return t_s
        self._notes.append(f"{len(t_s) - len(first)} lines with the time of the line before: spread evenly")
        steps = np.diff(t_s[first])
        usual = median(steps) if len(steps) else 0.0
        steps = np.minimum(np.append(steps, usual), usual)
        within = np.arange(len(t_s)) - np.repeat(first, runs)
        return np.asarray(t_s + within * np.repeat(steps / runs, runs))

    # --- what else there is

    def _poses(self, values: dict[str, Floats]) -> Poses | None:
        used = self._columns.used
        factor = {what: UNITS[what][column.unit] for what, column in used.items() if column.unit is not None}
        tilt = heading = None
        if TILT[0] in values:
            tilt = np.column_stack([values[what] * factor[what] for what in TILT])
        for what in ("heading_magnetic", "heading"):
            if what in values:
                heading, magnetic = values[what] * factor[what], what == "heading_magnetic"
        if tilt is None and heading is None:
            return None
        return Poses(tilt_deg=tilt, heading_deg=heading, magnetic=heading is not None and magnetic)


_SEPARATORS: Final = (";", "\t", ",", " ")
_AROUND: Final = ' "\t\r\n'


def _fields(text: str, separator: str) -> list[str]:
    try:
        return next(csv.reader((text,), delimiter=separator, skipinitialspace=separator == " "), [])
    except csv.Error:
        return [text]


def _separator(first: str, texts: Sequence[str]) -> str:
    """Of the first line of numbers; where that has but one field, of the texts before it."""
    for separator in _SEPARATORS:
        fields = _fields(first, separator)
        if len(fields) > 1 and _is_data(fields):
            return separator
    return max(_SEPARATORS, key=lambda separator: max((text.count(separator) for text in texts), default=0))


def _is_data(fields: Sequence[str]) -> bool:
    """Whether there are more numbers than words in a line."""
    texts = [text for field in fields if (text := field.strip(_AROUND)).lower() not in _NO_NUMBER]
    numbers = sum(_is_number(text) for text in texts)
    return numbers > len(texts) - numbers


def _is_number(text: str) -> bool:
    try:
        return math.isfinite(float(text))
    except ValueError:
        return _DECIMAL_COMMA.fullmatch(text) is not None


def _unwrapped(stamps: Floats) -> Floats:
    """The stamps of a counter of 32 bits, carried on over its end."""
    falls = np.diff(stamps) < -_WRAPS / 2.0
    if not falls.any() or not (np.abs(stamps) < _WRAPS).all():
        return stamps
    return stamps + _WRAPS * np.concatenate(([0], np.cumsum(falls)))

"""The columns of somebody's own log of an IMU: what is in them, and the samples that their lines are.

A column's name says what it holds and its unit: t_s, gx_deg_s, ax_g and so on. Axes are the sensor's own.

Nearly all lines of a log are plain numbers, as many as there are columns. Those are read many at once; where a line is
anything else, the lines around it are read one by one, with the same result, and the mistake is named with its place.
"""

from __future__ import annotations

import io
import math
import re
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Final

import msgspec
import numpy as np

from companion.errors import StorageError
from companion.physics.units import DEG, DEG_H, MG
from companion.protocols.bulk import Floats, ImuBlock
from companion.samples import ImuSample

_TIMES: Final = {"t_s": 1.0, "t_ms": 1e-3, "t_us": 1e-6, "t_ns": 1e-9}
_RATES: Final = {"rad_s": 1.0, "deg_s": DEG, "deg_h": DEG_H}
_FORCES: Final = {"m_s2": 1.0, "g": 1e3 * MG, "mg": MG}
_TEMPERATURE: Final = "temperature_degc"
ALLOWED: Final = (
    "t_s (or _ms, _us, _ns), gx gy gz each with _rad_s, _deg_s or _deg_h, ax ay az each with _m_s2, _g or _mg,"
    " temperature_degc"
)
_AT_ONCE: Final = 1 << 20
"""Bytes that are read at once; where a line among them is no plain row of numbers, ever smaller parts are looked at."""
_FEW: Final = 1 << 14
"""So many are read line by line then, and no line has more: a hundred columns have a tenth of that."""

_numbers: Final = msgspec.json.Decoder(list[float])


class _Columns:
    """Which column holds what, and the factors to SI units."""

    def __init__(self, names: Sequence[str], where: str) -> None:
        self.names = [name.strip().strip('"').lower() for name in names]
        self.time, self._time_factor = self._find("t", _TIMES, "", where)
        axes = [self._find(f"{kind}{axis}", units, "_", where) for kind, units in (("g", _RATES), ("a", _FORCES))
                for axis in "xyz"]  # fmt: skip
        self._axes = [column for column, _ in axes]
        self._factors = [factor for _, factor in axes]
        self._temperature = self.names.index(_TEMPERATURE) if _TEMPERATURE in self.names else None

    def _find(self, what: str, units: dict[str, float], joint: str, where: str) -> tuple[int, float]:
        names = {f"{what}{joint}{unit}" if joint else unit: factor for unit, factor in units.items()}
        found = [(column, names[name]) for column, name in enumerate(self.names) if name in names]
        if len(found) == 1:
            return found[0]
        wrong = f"two columns for {what}" if found else f"no column {' or '.join(names)}"
        raise StorageError(f"{where}: {wrong} in {', '.join(self.names)}; allowed: {ALLOWED}; or name them: --columns")

    def sample(self, fields: Sequence[str], where: str) -> ImuSample:
        """One line of the file; the time is its own.

        Raises:
            StorageError: it is none; says which field of which line.
        """
        if len(fields) != len(self.names):
            raise StorageError(f"{where}: found {len(fields)} fields; allowed: {len(self.names)}, as many as columns")
        t_s = self._number(fields, self.time, where) * self._time_factor
        gx, gy, gz, ax, ay, az = (
            self._number(fields, column, where) * factor
            for column, factor in zip(self._axes, self._factors, strict=True)
        )
        temperature = None
        if self._temperature is not None and fields[self._temperature].strip():
            temperature = self._number(fields, self._temperature, where)
        return ImuSample(t_s, (gx, gy, gz), (ax, ay, az), temperature)

    def _number(self, fields: Sequence[str], column: int, where: str) -> float:
        try:
            value = float(fields[column].strip().strip('"'))
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise StorageError(f"{where}: found {fields[column]!r} in column {self.names[column]}; allowed: a number")
        return value

    def block(self, lines: bytes, separator: str) -> ImuBlock | None:
        """The samples of many whole lines; None where one of them is not a plain row of finite numbers.

        What a plain number is, JSON says: stricter than `float`, and the same where it is one.
        """
        width, rows = len(self.names), lines.count(b"\n")
        plain = lines.replace(separator.encode(), b",").replace(b"\n", b",")
        try:
            flat = _numbers.decode(b"[" + plain[:-1] + b"]")
        except (msgspec.MsgspecError, UnicodeDecodeError):
            return None
        if rows == 0 or len(flat) != rows * width:
            return None
        octets = np.frombuffer(lines, np.uint8)
        ends = np.flatnonzero(octets == ord("\n"))
        places = np.flatnonzero(octets == ord(separator))
        if len(places) != rows * (width - 1):
            return None
        between = places.reshape(rows, width - 1)
        if not ((between[:, -1] < ends).all() and (between[1:, 0] > ends[:-1]).all()):
            return None
        table = np.array(flat).reshape(rows, width)
        # Row by row in memory, as sums go by that.
        values = np.ascontiguousarray(table[:, self._axes]) * np.array(self._factors)
        if not np.isfinite(table).all() or not np.isfinite(values).all():
            return None
        return ImuBlock(
            t_s=table[:, self.time] * self._time_factor,
            rows=values,
            temperature_degc=None if self._temperature is None else table[:, self._temperature].copy(),
            stamps=None,
            breaks=0,
            reads=np.arange(rows),
        )


def read(path: Path, columns: str | None = None) -> Iterator[ImuBlock]:
    """The samples of a CSV file; comma, semicolon or tab between fields, "#" begins a remark.

    Args:
        path: the file.
        columns: names of the columns, where the file has none of its own.

    A last line that does not end is left out: the log may have been cut there.

    Raises:
        StorageError: one line with the number of the line, what was found and what is allowed.
    """
    log = _Log(path, columns)
    try:
        with path.open("rb") as file:
            data = b""
            while more := file.read(_AT_ONCE):
                data += more
                end = data.rfind(b"\n") + 1
                yield from log.blocks(data[:end])
                data = data[end:]
                if len(data) > _FEW:
                    raise log.too_long()
            if log.empty:
                yield from log.blocks(data)
            # Else the last line may be cut in the middle of a number, which then still looks like one.
    except (OSError, UnicodeDecodeError) as error:
        raise StorageError(f"{path}: cannot be read as text: {getattr(error, 'strerror', None) or error}") from None
    if log.empty:
        raise StorageError(f"{path}: the file is empty")


def read_arrays(path: Path, columns: str | None = None) -> tuple[Floats, Floats, Floats]:
    """All samples of a CSV file at once.

    Returns:
        (n,) times in s; (n, 6) gyro in rad/s and accelerometer in m/s^2; (n,) degC, NaN where unknown.

    Raises:
        StorageError: as `read`.
    """
    blocks = list(read(path, columns))
    if not blocks:
        return np.empty(0), np.empty((0, 6)), np.empty(0)
    temperatures = [
        np.full(len(block), math.nan) if block.temperature_degc is None else block.temperature_degc for block in blocks
    ]
    return (
        np.concatenate([block.t_s for block in blocks]),
        np.concatenate([block.rows for block in blocks]),
        np.concatenate(temperatures),
    )


class _Log:
    """One pass over a file: what is known of it from the lines before."""

    def __init__(self, path: Path, names: str | None) -> None:
        self.empty = True
        """Whether there was nothing but remarks."""
        self._path = path
        self._columns = None if names is None else _Columns(names.split(","), "--columns")
        self._separator = ","
        self._lines = 0
        self._before_s = -math.inf
        self._cut = False

    def blocks(self, data: bytes) -> Iterator[ImuBlock]:
        """The samples of the next lines; only the last of a file may have no end."""
        if not data or self._cut:
            return
        block = None
        if self._columns is not None and not self.empty and data.endswith(b"\n"):
            block = self._columns.block(data, self._separator)
        if block is not None and (np.diff(block.t_s, prepend=self._before_s) > 0.0).all():
            self._lines += len(block)
            self._before_s = float(block.t_s[-1])
            yield block
        elif len(data) <= _FEW:
            yield from _in_blocks(self._one_by_one(data))
        else:
            half = data.rfind(b"\n", 0, len(data) // 2) + 1 or data.find(b"\n") + 1 or len(data)
            first, rest = data[:half], data[half:]
            if not rest:
                raise self.too_long()
            yield from self.blocks(first)
            yield from self.blocks(rest)

    def too_long(self) -> StorageError:
        """Of the next line."""
        return StorageError(f"{self._path}, line {self._lines + 1}: found no line end within {_FEW} bytes")

    def _one_by_one(self, data: bytes) -> Iterator[ImuSample]:
        text = data.decode("utf-8-sig" if self._lines == 0 else "utf-8")
        for line in io.StringIO(text, newline=""):
            self._lines += 1
            sample = self._sample(line)
            if self._cut:
                return
            if sample is not None:
                yield sample

    def _sample(self, line: str) -> ImuSample | None:
        """What a line holds; None where that is no sample."""
        text = line.strip()
        if not text or text.startswith("#"):
            return None
        where = f"{self._path}, line {self._lines}"
        if self.empty:
            self._separator = max(",;\t", key=text.count)
            self.empty = False
            if self._columns is None:
                if not re.search("[A-Za-z]{2}", text):
                    raise StorageError(f"{where}: no names of columns; name them: --columns t_s,gx_rad_s,...")
                self._columns = _Columns(text.split(self._separator), where)
                return None
            if re.search("[A-DF-Za-df-z_]{2}", text):
                return None  # names of its own, which --columns replaces
        try:
            assert self._columns is not None
            sample = self._columns.sample(text.split(self._separator), where)
        except StorageError:
            if not line.endswith("\n"):
                self._cut = True  # the log was cut in the middle of its last line
                return None
            raise
        if sample.t_s <= self._before_s:
            raise StorageError(f"{where}: time {sample.t_s:.6f} s after {self._before_s:.6f} s; allowed: growing times")
        self._before_s = sample.t_s
        return sample


def _in_blocks(samples: Iterable[ImuSample]) -> Iterator[ImuBlock]:
    """Samples put together; those with a temperature and those without are not mixed."""
    kept: list[ImuSample] = []
    for sample in samples:
        if kept and (sample.temperature_degc is None) != (kept[0].temperature_degc is None):
            yield _block(kept)
            kept = []
        kept.append(sample)
    if kept:
        yield _block(kept)


def _block(samples: Sequence[ImuSample]) -> ImuBlock:
    temperatures = [sample.temperature_degc for sample in samples if sample.temperature_degc is not None]
    return ImuBlock(
        t_s=np.array([sample.t_s for sample in samples]),
        rows=np.array([sample.gyro_rad_s + sample.accel_m_s2 for sample in samples]),
        temperature_degc=np.array(temperatures) if temperatures else None,
        stamps=None,
        breaks=0,
        reads=np.arange(len(samples)),
    )

"""What the columns of a table mean: by our own names (t_s, gx_deg_s), or by those that apps and loggers write.

A name says which quantity it is and, in a suffix, in brackets or in a row of units below, in which unit. Where nothing
says the unit, it is left to the size of the readings (`sizes`). Angles that an attitude filter worked out (roll, pitch,
yaw) are not taken: they come from the very sensors that are to be calibrated.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Sequence
from typing import Final

import msgspec

from companion.errors import StorageError
from companion.physics.units import DEG, DEG_H, MG, G

IMU: Final = ("gx", "gy", "gz", "ax", "ay", "az")
TILT: Final = ("tilt_x", "tilt_y")

TIMES: Final = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
RATES: Final = {"rad_s": 1.0, "deg_s": DEG, "deg_h": DEG_H, "mdeg_s": 1e-3 * DEG, "mrad_s": 1e-3}
FORCES: Final = {"m_s2": 1.0, "g": G, "mg": MG, "gal": 1e-2, "ft_s2": 0.3048}
DEGREES: Final = {"deg": 1.0, "rad": 1.0 / DEG}
_DEGC: Final = {"degc": 1.0, "c": 1.0}
UNITS: Final[dict[str, dict[str, float]]] = {
    "t": TIMES,
    **dict.fromkeys(IMU[:3], RATES),
    **dict.fromkeys(IMU[3:], FORCES),
    **dict.fromkeys((*TILT, "heading", "heading_magnetic"), DEGREES),
    "temperature": _DEGC,
}
"""By quantity, each unit with its factor to SI; of angles and temperatures to degrees."""
_BY_SIZE: Final = frozenset(("t", *IMU))
"""Quantities whose unit the size of the readings can tell; the others are in degrees where nothing is said."""

ALLOWED: Final = (
    "t_s (or _ms, _us, _ns), gx gy gz each with _rad_s, _deg_s or _deg_h, ax ay az each with _m_s2, _g or _mg; if"
    " there: temperature_degc, tilt_x_deg tilt_y_deg, heading_deg or heading_magnetic_deg"
)

_STEMS: Final[dict[str, tuple[str, ...]]] = {
    "g": ("g", "gyr", "gyro", "gyroscope", "w", "omega", "angular_velocity", "rate", "gyro_rate", "rotation_rate"),
    "a": ("a", "acc", "accel", "acceleration", "accelerometer", "specific_force"),
}
_ALIASES: Final[dict[str, str]] = {
    **{
        f"{stem}{joint}{axis}": f"{kind}{axis}"
        for kind, stems in _STEMS.items()
        for stem in stems
        for joint in ("_", "")
        for axis in "xyz"
    },
    **dict.fromkeys(("t", "time", "timestamp", "time_stamp", "seconds", "seconds_elapsed", "elapsed"), "t"),
    **dict.fromkeys(("temperature", "temp", "imu_temperature", "imu_temp", "sensor_temperature"), "temperature"),
    **dict.fromkeys(("heading", "true_heading", "heading_true"), "heading"),
    **dict.fromkeys(("heading_magnetic", "magnetic_heading"), "heading_magnetic"),
    **{name: name for name in TILT},
}
_TIME_NAMES: Final = {"millis": "ms", "micros": "us", "timeus": "us", "time_usec": "us", "millisecond": "ms"}
_UNIT_WORDS: Final = {
    "rad/s": "rad_s", "rads": "rad_s", "rad/sec": "rad_s", "radps": "rad_s", "rad_s": "rad_s",
    "deg/s": "deg_s", "deg/sec": "deg_s", "degs": "deg_s", "dps": "deg_s", "deg_s": "deg_s", "degree/s": "deg_s",
    "degrees/s": "deg_s", "degree_per_second": "deg_s",
    "deg/h": "deg_h", "deg/hr": "deg_h", "deg_h": "deg_h", "dph": "deg_h",
    "mdps": "mdeg_s", "mdeg/s": "mdeg_s", "mdeg_s": "mdeg_s", "mrad/s": "mrad_s", "mrad_s": "mrad_s",
    "m/s^2": "m_s2", "m/s2": "m_s2", "m/s/s": "m_s2", "m/sec^2": "m_s2", "m_s2": "m_s2", "mps2": "m_s2",
    "m/s**2": "m_s2", "ms^-2": "m_s2", "ms2": "m_s2", "ms-2": "m_s2",
    "g": "g", "gee": "g", "g0": "g", "mg": "mg", "gal": "gal", "cm/s^2": "gal", "cm/s2": "gal",
    "ft/s^2": "ft_s2", "ft/s2": "ft_s2", "ft_s2": "ft_s2",
    "s": "s", "sec": "s", "secs": "s", "second": "s", "seconds": "s", "ms": "ms", "msec": "ms", "us": "us",
    "usec": "us", "ns": "ns", "nsec": "ns",
    "deg": "deg", "degrees": "deg", "degree": "deg", "rad": "rad",
    "degc": "degc", "c": "c", "celsius": "degc",
}  # fmt: skip
_NO_UNIT: Final = frozenset(("", "-", "1", "n/a", "none", "a.u.", "raw", "lsb", "counts"))
_ODD_LETTERS: Final = (
    ("²", "^2"), ("°", "deg"), ("µ", "u"), ("μ", "u"), ("·", ""), (" / ", "/"),
    # The same in Latin-1, read as UTF-8 with surrogates.
    ("\udcb2", "^2"), ("\udcb0", "deg"), ("\udcb5", "u"),
)  # fmt: skip
_BRACKETS: Final = re.compile(r"\s*[\[(](?P<unit>[^\])]*)[\])]\s*$")


class Column(msgspec.Struct, frozen=True, kw_only=True):
    """One column that is used."""

    place: int
    """From 0."""
    what: str
    """The quantity, as in `UNITS`."""
    name: str
    unit: str | None
    """None: nothing says it."""


class Columns(msgspec.Struct, frozen=True, kw_only=True):
    """The columns of one table."""

    names: tuple[str, ...]
    """All, as they stand in the file."""
    used: dict[str, Column]

    def named(self, units: dict[str, str]) -> str:
        """The table's columns by our own names, as --columns takes them; `units` of quantities replace theirs."""
        by_place = {column.place: column for column in self.used.values()}
        words = []
        for place in range(len(self.names)):
            column = by_place.get(place)
            unit = None if column is None else units.get(column.what, column.unit)
            words.append("-" if column is None else column.what if unit is None else f"{column.what}_{unit}")
        return ",".join(words)


def columns_of(names: Sequence[str], where: str, units: Sequence[str] = (), *, timed: bool = True) -> Columns:
    """Which column holds what, by the names of all and a row of units below them, or nothing; one is time, if `timed`.

    Raises:
        StorageError: a quantity is missing, is there twice, or is in a unit that is none of its.
    """
    used: dict[str, Column] = {}
    for place, (name, below) in enumerate(itertools.zip_longest(names[: len(names)], units, fillvalue="")):
        found = meaning(name, below) if place < len(names) else None
        if found is None:
            continue
        what, unit = found
        if what == "t" and what in used:
            continue
        if what in used:
            raise StorageError(f"{where}: two columns for {what}: {used[what].name} and {name}; name them: --columns")
        if unit is not None and unit not in UNITS[what]:
            allowed = ", ".join(UNITS[what])
            raise StorageError(f"{where}: found unit {unit!r} of column {name}; allowed: {allowed}")
        if unit is None and what not in _BY_SIZE:
            unit = next(iter(UNITS[what]))
        used[what] = Column(place=place, what=what, name=name, unit=unit)
    if not timed:
        used.pop("t", None)
    missing = [what for what in (*(("t",) if timed else ()), *IMU) if what not in used]
    if missing:
        rate = "; a log without time: --rate HZ" if missing[0] == "t" else ""
        raise StorageError(
            f"{where}: no column for {', '.join(missing)} in {', '.join(names)}{rate}; allowed: {ALLOWED}; or name"
            " them: --columns"
        )
    if not all(what in used for what in TILT):
        for what in TILT:
            used.pop(what, None)
    return Columns(names=tuple(names), used=used)


def meaning(name: str, below: str = "") -> tuple[str, str | None] | None:
    """Quantity and unit (None: not said) of a column by its name and what stands below it; None: not of use."""
    text = _plain(name)
    bracket = _BRACKETS.search(text)
    written = bracket["unit"] if bracket is not None else _plain(below)
    text = re.sub(r"[^a-z0-9]+", "_", text[: bracket.start()] if bracket is not None else text).strip("_")
    if text in _TIME_NAMES:
        return "t", _TIME_NAMES[text]
    if text in _ALIASES:
        what = _ALIASES[text]
        return what, _unit(what, written)
    # Our own way: the unit is the name's end.
    parts = text.split("_")
    for at in range(len(parts) - 1, 0, -1):
        what = _ALIASES.get("_".join(parts[:at]), "")
        tail = "_".join(parts[at:])
        if what and _UNIT_WORDS.get(tail, tail) in UNITS[what]:
            return what, _unit(what, tail)
    return None


def _plain(text: str) -> str:
    text = text.strip().strip('"').strip().lower()
    for odd, usual in _ODD_LETTERS:
        text = text.replace(odd, usual)
    return text


def _unit(what: str, text: str) -> str | None:
    """The unit as `UNITS` has it; a word that is none stays as it is, for whoever refuses it."""
    text = text.strip("[]() ")
    if text in _NO_UNIT:
        return None
    return _UNIT_WORDS.get(text.replace(" ", ""), text)


def looks_like_units(fields: Sequence[str]) -> bool:
    """Whether a row below the names holds units: at least one, and nothing else."""
    words = [_plain(field).strip("[]()").strip() for field in fields]
    known = [word for word in words if word not in _NO_UNIT]
    return bool(known) and all(word.replace(" ", "") in _UNIT_WORDS for word in known)

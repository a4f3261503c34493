"""Somebody's own log of an IMU at rest, as comma separated values, through the estimator.

A column's name says what it holds and its unit: t_s, gx_deg_s, ax_g and so on. Axes are the sensor's own; the mounting
turns them into the vehicle's (x forward, y right, z down).
"""

from __future__ import annotations

import datetime
import io
import math
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from companion.calibration.allan import noise_profile
from companion.calibration.pose_windows import HeadingWindow, TiltWindow
from companion.calibration.record import Record
from companion.calibration.request import What
from companion.calibration.rolling import RollingCollector, Settings, Window
from companion.calibration.site import Whereabouts
from companion.calibration.solve import CompassModel, GradienterModel, solve_at
from companion.calibration.windows import ImuInput
from companion.config import Mounting
from companion.daemon.course import in_words
from companion.daemon.report import Draft
from companion.errors import CalibrationRefusedError, StorageError
from companion.physics.frames import rotation_matrix
from companion.physics.units import DEG, DEG_H, MG
from companion.samples import ImuSample

Floats = NDArray[np.float64]

_TIMES: Final = {"t_s": 1.0, "t_ms": 1e-3, "t_us": 1e-6, "t_ns": 1e-9}
_RATES: Final = {"rad_s": 1.0, "deg_s": DEG, "deg_h": DEG_H}
_FORCES: Final = {"m_s2": 1.0, "g": 1e3 * MG, "mg": MG}
_TEMPERATURE: Final = "temperature_degc"
ALLOWED: Final = (
    "t_s (or _ms, _us, _ns), gx gy gz each with _rad_s, _deg_s or _deg_h, ax ay az each with _m_s2, _g or _mg,"
    " temperature_degc"
)
MIN_STILL_S: Final = 5.0
MAX_STILL_S: Final = 3600.0
NAME: Final = "imu"
# The collector drops the second in which a stream begins: here that is its first millisecond.
_FIRST_S: Final = 999.999
_IN_OPTIONS: Final = (
    ("set vehicle.latitude_deg or wait for GPS", "say --latitude-deg"),
    ("set vehicle.height_m or wait for GPS", "say --height-m"),
    ("no compass:", "no --heading-deg:"),
)
"""Warnings of the estimator that speak of the daemon's configuration, in the words of the command line."""
_LONGER: Final = 1.1
"""A window is worked out again when the stretch has grown by so much."""


class PoseGiven(msgspec.Struct, frozen=True, kw_only=True):
    """How the IMU stood while it was logged, and where; None: not known, which widens the sigmas."""

    pitch_deg: float | None = None
    roll_deg: float | None = None
    heading_deg: float | None = None
    """True."""
    sigma_deg: float = 0.05
    heading_sigma_deg: float = 3.0
    latitude_deg: float | None = None
    height_m: float | None = None


class _Columns:
    """Which column holds what, and the factors to SI units."""

    def __init__(self, names: Sequence[str], where: str) -> None:
        self.names = [name.strip().strip('"').lower() for name in names]
        self.time, self.time_factor = self._find("t", _TIMES, "", where)
        axes = [self._find(f"{kind}{axis}", units, "_", where) for kind, units in (("g", _RATES), ("a", _FORCES))
                for axis in "xyz"]  # fmt: skip
        self.axes = [column for column, _ in axes]
        self.factors = [factor for _, factor in axes]
        self.temperature = self.names.index(_TEMPERATURE) if _TEMPERATURE in self.names else None

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
        t_s = self._number(fields, self.time, where) * self.time_factor
        gx, gy, gz, ax, ay, az = (
            self._number(fields, column, where) * factor for column, factor in zip(self.axes, self.factors, strict=True)
        )
        temperature = None
        if self.temperature is not None and fields[self.temperature].strip():
            temperature = self._number(fields, self.temperature, where)
        return ImuSample(t_s, (gx, gy, gz), (ax, ay, az), temperature)

    def _number(self, fields: Sequence[str], column: int, where: str) -> float:
        try:
            value = float(fields[column].strip().strip('"'))
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise StorageError(f"{where}: found {fields[column]!r} in column {self.names[column]}; allowed: a number")
        return value


def read(path: Path, columns: str | None = None) -> Iterator[ImuSample]:
    """The samples of a CSV file; comma, semicolon or tab between fields, "#" begins a remark.

    Args:
        path: the file.
        columns: names of the columns, where the file has none of its own.

    Raises:
        StorageError: one line with the number of the line, what was found and what is allowed.
    """
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            yield from _read(file, path, columns)
    except (OSError, UnicodeDecodeError) as error:
        raise StorageError(f"{path}: cannot be read as text: {getattr(error, 'strerror', None) or error}") from None


def read_arrays(path: Path, columns: str | None = None) -> tuple[Floats, Floats, Floats]:
    """All samples of a CSV file at once: as `read`, by numpy's own reader, ten times as fast.

    Returns:
        (n,) times in s; (n, 6) gyro in rad/s and accelerometer in m/s^2; (n,) degC, NaN where unknown.

    Raises:
        StorageError: as `read`, which has the last word on whatever is not a plain table of numbers.
    """
    found = _table(path, columns)
    if found is None:
        samples = list(read(path, columns))
        nan = math.nan
        return (
            np.array([sample.t_s for sample in samples]),
            np.array([(*sample.gyro_rad_s, *sample.accel_m_s2) for sample in samples]).reshape(-1, 6),
            np.array([nan if sample.temperature_degc is None else sample.temperature_degc for sample in samples]),
        )
    return found


def _table(path: Path, names: str | None) -> tuple[Floats, Floats, Floats] | None:
    """The file as a table; None where `read` has to look at it line by line."""
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            skip = 0
            for line in file:
                text = line.strip()
                if text and not text.startswith("#"):
                    break
                skip += 1
            else:
                return None
            separator = max(",;\t", key=text.count)
            named = names is None or re.search("[A-DF-Za-df-z_]{2}", text) is not None
            columns = _Columns(text.split(separator) if names is None else names.split(","), str(path))
        source: Path | io.BytesIO = path
        with path.open("rb") as raw:
            raw.seek(-1, io.SEEK_END)
            if raw.read(1) != b"\n":
                # Perhaps cut in the middle of a number, which then still looks like one: without its last line.
                raw.seek(0)
                data = raw.read()
                source = io.BytesIO(data[: data.rfind(b"\n") + 1])
        temperature = columns.temperature
        wanted = [columns.time, *columns.axes, *([] if temperature is None else [temperature])]
        rows = np.loadtxt(
            source, delimiter=separator, comments="#", quotechar='"', encoding="utf-8-sig", ndmin=2,
            skiprows=skip + named, usecols=wanted,
        )  # fmt: skip
    except (OSError, ValueError, StorageError):
        return None
    t_s = rows[:, 0] * columns.time_factor
    if not np.isfinite(rows).all() or not (np.diff(t_s) > 0.0).all():
        return None
    degc = rows[:, 7] if temperature is not None else np.full(len(rows), math.nan)
    return t_s, rows[:, 1:7] * columns.factors, degc


def _read(file: Iterator[str], path: Path, names: str | None) -> Iterator[ImuSample]:
    columns = None if names is None else _Columns(names.split(","), "--columns")
    separator = ","
    before_s, empty = -math.inf, True
    for number, line in enumerate(file, 1):
        text = line.strip()
        if not text or text.startswith("#"):
            continue
        where = f"{path}, line {number}"
        if empty:
            separator = max(",;\t", key=text.count)
            empty = False
            if columns is None:
                if not re.search("[A-Za-z]{2}", text):
                    raise StorageError(f"{where}: no names of columns; name them: --columns t_s,gx_rad_s,...")
                columns = _Columns(text.split(separator), where)
                continue
            if re.search("[A-DF-Za-df-z_]{2}", text):
                continue  # names of its own, which --columns replaces
        try:
            assert columns is not None
            sample = columns.sample(text.split(separator), where)
        except StorageError:
            if not line.endswith("\n"):
                return  # the log was cut in the middle of its last line
            raise
        if sample.t_s <= before_s:
            raise StorageError(f"{where}: time {sample.t_s:.6f} s after {before_s:.6f} s; allowed: growing times")
        before_s = sample.t_s
        yield sample
    if empty:
        raise StorageError(f"{path}: the file is empty")


def estimate(
    samples: Iterator[ImuSample], pose: PoseGiven, *, mounting: Mounting = "ROTATION_NONE", profile: str | None = None
) -> Record:
    """The biases from the longest still stretch of a log.

    Args:
        samples: in order of time.
        pose: how it stood.
        mounting: sensor to vehicle FRD.
        profile: the sensor's model, for its Allan figures.

    Raises:
        StorageError: as `read`.
    """
    settings = Settings(
        min_still_s=MIN_STILL_S, max_s=MAX_STILL_S, target_gyro_sigma_rad_s=0.0, target_accel_sigma_m_s2=0.0
    )
    imu = ImuInput(name=NAME, rotation=rotation_matrix(mounting), profile=noise_profile(profile))
    collector = RollingCollector(settings, [imu], gradienter=False, compass=False)
    draft = Draft(datetime.datetime.now(tz=datetime.UTC))
    best: Window | None = None
    still_s, obstacle, refused = 0.0, "no samples", ""
    offset_s: float | None = None
    now_s = looked_s = _FIRST_S
    for sample in samples:
        if offset_s is None:
            offset_s = _FIRST_S - sample.t_s
        now_s = sample.t_s + offset_s
        if now_s - looked_s >= 1.0:
            looked_s = math.floor(now_s)
            glance = collector.glance(now_s)
            obstacle = glance.obstacle or obstacle
            if glance.obstacle is None and glance.still_s >= max(MIN_STILL_S, _LONGER * still_s):
                best, refused = _window(collector, now_s, best)
                still_s = glance.still_s
        collector.add_imu(NAME, msgspec.structs.replace(sample, t_s=now_s))
    glance = collector.glance(now_s + 0.3)
    if glance.obstacle is None and glance.still_s > max(still_s, MIN_STILL_S - 1.0):
        best, refused = _window(collector, now_s + 0.3, best)
    seconds = now_s - _FIRST_S
    if best is None:
        return draft.record("failed", refused or f"no {MIN_STILL_S:.0f} s at rest in it: {obstacle}", seconds)
    tilt_known = pose.pitch_deg is not None and pose.roll_deg is not None
    if not tilt_known:
        draft.warnings.append("no accelerometer biases without --pitch-deg and --roll-deg")
    try:
        draft.solution = solve_at(*_posed(best, pose), What.BOTH if tilt_known else What.GYROS)
    except CalibrationRefusedError as error:
        return draft.record("failed", str(error), seconds)
    record = draft.record("done", in_words(draft.solution), seconds)
    return msgspec.structs.replace(record, warnings=tuple(map(_in_options, record.warnings)))


def _in_options(words: str) -> str:
    for of_the_daemon, of_the_command in _IN_OPTIONS:
        words = words.replace(of_the_daemon, of_the_command)
    return words


def _window(collector: RollingCollector, now_s: float, best: Window | None) -> tuple[Window | None, str]:
    try:
        return collector.window(now_s), ""
    except CalibrationRefusedError as error:
        return best, str(error)


def _posed(window: Window, pose: PoseGiven) -> tuple[Window, Whereabouts, GradienterModel | None, CompassModel | None]:
    """The window with the pose in the place of gradienter and compass."""
    level, north = np.eye(3), np.eye(3)
    tilt = heading = None
    gradienter = compass = None
    if pose.pitch_deg is not None and pose.roll_deg is not None:
        tilt = TiltWindow(
            samples=0,
            x_deg=pose.roll_deg,
            y_deg=pose.pitch_deg,
            x_sigma_deg=0.0,
            y_sigma_deg=0.0,
            temperature_degc=None,
        )
        gradienter = GradienterModel("euler", level, (0.0, 0.0), pose.sigma_deg)
    if pose.heading_deg is not None:
        heading = HeadingWindow(samples=0, heading_deg=pose.heading_deg, sigma_deg=0.0)
        compass = CompassModel(
            magnetic=False, vehicle_from_sensor=north, offset_deg=0.0, sigma_deg=pose.heading_sigma_deg
        )
    source = None if pose.latitude_deg is None and pose.height_m is None else "command line"
    where = Whereabouts(pose.latitude_deg, None, pose.height_m, source, None)
    return msgspec.structs.replace(window, tilt=tilt, heading=heading), where, gradienter, compass

"""Somebody's own log of an IMU at rest, as comma separated values: its samples, and what the estimator makes of them.

A column's name says what it holds and its unit: t_s, gx_deg_s, ax_g and so on. Axes are the sensor's own; the mounting
turns them into the vehicle's (x forward, y right, z down).
"""

from __future__ import annotations

import datetime
import math
import re
from array import array
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Final

import msgspec
import numpy as np

from companion.calibration.collector.measurement import Measurement
from companion.calibration.collector.outlook import Settings
from companion.calibration.collector.rolling import RollingCollector
from companion.calibration.means.pose import CompassModel, GradienterModel, HeadingWindow, TiltWindow
from companion.calibration.means.windows import ImuInput, Window
from companion.calibration.noise.allan import noise_profile
from companion.calibration.request import What
from companion.calibration.solution.draft import Draft, in_words
from companion.calibration.solution.record import Record
from companion.calibration.solution.site import Remedies, Whereabouts, local_earth
from companion.calibration.solution.solve import solve
from companion.config.sections import Mounting, Noise
from companion.errors import CalibrationRefusedError, StorageError
from companion.physics.frames import Floats, rotation_matrix
from companion.physics.units import DEG, DEG_H, MG
from companion.samples import ImuSample

_TIMES: Final = {"t_s": 1.0, "t_ms": 1e-3, "t_us": 1e-6, "t_ns": 1e-9}
_RATES: Final = {"rad_s": 1.0, "deg_s": DEG, "deg_h": DEG_H}
_FORCES: Final = {"m_s2": 1.0, "g": 1e3 * MG, "mg": MG}
_TEMPERATURE: Final = "temperature_degc"
ALLOWED: Final = (
    "t_s (or _ms, _us, _ns), gx gy gz each with _rad_s, _deg_s or _deg_h, ax ay az each with _m_s2, _g or _mg,"
    " temperature_degc"
)
_LONGEST: Final = 1 << 14
"""The most characters of a line: a hundred columns have a tenth of that."""
_AROUND: Final = ' "\t\r\n'
"""What may stand around a number."""


class _Columns:
    """Which column holds what, and the factors to SI units."""

    def __init__(self, names: Sequence[str], where: str) -> None:
        self.names = [name.strip().strip('"').lower() for name in names]
        self._wanted = [self._find("t", _TIMES, "", where)]
        for kind, units in (("g", _RATES), ("a", _FORCES)):
            self._wanted += [self._find(f"{kind}{axis}", units, "_", where) for axis in "xyz"]
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
        wanted = self._wanted
        if self._temperature is not None and fields[self._temperature].strip(_AROUND):
            wanted = [*wanted, (self._temperature, 1.0)]
        values = []
        for column, factor in wanted:
            try:
                value = float(fields[column].strip(_AROUND)) * factor
            except ValueError:
                value = math.nan
            if not math.isfinite(value):
                raise StorageError(
                    f"{where}: found {fields[column]!r} in column {self.names[column]}; allowed: a number"
                )
            values.append(value)
        t_s, gx, gy, gz, ax, ay, az, *temperature = values
        return ImuSample(t_s, (gx, gy, gz), (ax, ay, az), temperature[0] if temperature else None)


def read(path: Path, columns: str | None = None) -> Iterator[ImuSample]:
    """The samples of a CSV file; comma, semicolon or tab between fields, "#" begins a remark.

    A last line that does not end is left out: the log may have been cut there.

    Raises:
        StorageError: one line with the number of the line, what was found and what is allowed.
    """
    table = None if columns is None else _Columns(columns.split(","), "--columns")
    separator, before_s = "", -math.inf
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            for number, line in enumerate(iter(lambda: file.readline(_LONGEST), ""), 1):
                where, text = f"{path}, line {number}", line.strip()
                if len(line) == _LONGEST:
                    raise StorageError(f"{where}: found no line end within {_LONGEST} characters")
                if separator and not line.endswith(("\n", "\r")):
                    break  # in the middle of a number, perhaps, which then still looks like one
                if not text or text.startswith("#"):
                    continue
                if not separator:
                    separator = max(",;\t", key=text.count)
                    if table is None:
                        if not re.search("[A-Za-z]{2}", text):
                            raise StorageError(f"{where}: no names of columns; name them: --columns t_s,gx_rad_s,...")
                        table = _Columns(text.split(separator), where)
                        continue
                    if re.search("[A-DF-Za-df-z_]{2}", text):
                        continue  # names of its own, which --columns replaces
                assert table is not None
                sample = table.sample(text.split(separator), where)
                if sample.t_s <= before_s:
                    raise StorageError(
                        f"{where}: time {sample.t_s:.6f} s after {before_s:.6f} s; allowed: growing times"
                    )
                before_s = sample.t_s
                yield sample
    except (OSError, UnicodeDecodeError) as error:
        raise StorageError(f"{path}: cannot be read as text: {getattr(error, 'strerror', None) or error}") from None
    if not separator:
        raise StorageError(f"{path}: the file is empty")


def read_arrays(path: Path, columns: str | None = None) -> tuple[Floats, Floats, Floats]:
    """All samples of a CSV file at once.

    Returns:
        (n,) times in s; (n, 6) gyro in rad/s and accelerometer in m/s^2; (n,) degC, NaN where unknown.

    Raises:
        StorageError: as `read`.
    """
    flat = array("d")
    for sample in read(path, columns):
        temperature_degc = math.nan if sample.temperature_degc is None else sample.temperature_degc
        flat.extend((sample.t_s, *sample.gyro_rad_s, *sample.accel_m_s2, temperature_degc))
    table = np.frombuffer(flat).reshape(-1, 8)
    return table[:, 0].copy(), table[:, 1:7].copy(), table[:, 7].copy()


MIN_STILL_S: Final = 5.0
MAX_STILL_S: Final = 3600.0
NAME: Final = "imu"
# The collector drops the second in which a stream begins: here that is its first millisecond.
_FIRST_S: Final = 999.999
_REMEDIES: Final = Remedies("say --latitude-deg", "say --height-m", no_heading="no --heading-deg")
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


def estimate(
    samples: Iterable[ImuSample],
    pose: PoseGiven,
    *,
    mounting: Mounting = "ROTATION_NONE",
    profile: str | Noise | None = None,
) -> Record:
    """The biases from the longest still stretch of a log.

    Args:
        samples: in order of time, by any clock in seconds.
        pose: how it stood.
        mounting: sensor to vehicle FRD.
        profile: the sensor's model, or figures learned, for its Allan figures.

    Raises:
        StorageError: as `read`, where the samples are its.
    """
    settings = Settings(
        min_still_s=MIN_STILL_S, max_s=MAX_STILL_S, target_gyro_sigma_rad_s=0.0, target_accel_sigma_m_s2=0.0
    )
    imu = ImuInput(name=NAME, rotation=rotation_matrix(mounting), profile=noise_profile(profile))
    collector = RollingCollector(settings, [imu], gradienter=False, compass=False)
    draft = Draft(datetime.datetime.now(tz=datetime.UTC))
    found: list[Measurement] = []
    still_s, obstacle = 0.0, "no samples"
    offset_s: float | None = None
    now_s = looked_s = _FIRST_S
    for sample in samples:
        if offset_s is None:
            offset_s = _FIRST_S - sample.t_s
        now_s = sample.t_s + offset_s
        # Whoever looks has not seen the sample yet that tells him that it is time to.
        if now_s - looked_s >= 1.0:
            looked_s = math.floor(now_s)
            collector.tick(now_s)
            glance = collector.glance(now_s)
            obstacle = obstacle if glance.obstacle is None else glance.obstacle.words
            if glance.obstacle is None and glance.still_s >= max(MIN_STILL_S, _LONGER * still_s):
                found.append(collector.measurement(now_s))
                still_s = glance.still_s
        collector.add_imu(NAME, ImuSample(now_s, sample.gyro_rad_s, sample.accel_m_s2, sample.temperature_degc))
    collector.tick(now_s + 0.3)
    glance = collector.glance(now_s + 0.3)
    if glance.obstacle is None and glance.still_s > max(still_s, MIN_STILL_S - 1.0):
        found.append(collector.measurement(now_s + 0.3))
    best, refused = _latest(found)
    seconds = now_s - _FIRST_S
    if best is None:
        return draft.record("failed", refused or f"no {MIN_STILL_S:.0f} s at rest in it: {obstacle}", seconds)
    tilt_known = pose.pitch_deg is not None and pose.roll_deg is not None
    if not tilt_known:
        draft.warnings.append("no accelerometer biases without --pitch-deg and --roll-deg")
    try:
        window, where, gradienter, compass = _posed(best, pose)
        what = What.BOTH if tilt_known else What.GYROS
        draft.solution = solve(window, local_earth(where, _REMEDIES), gradienter, compass, what)
    except CalibrationRefusedError as error:
        return draft.record("failed", str(error), seconds)
    return draft.record("done", in_words(draft.solution), seconds)


def _latest(found: list[Measurement]) -> tuple[Window | None, str]:
    """The window of the latest that gives one; where none does, why the very latest gives none."""
    refused = ""
    for each in reversed(found):
        try:
            return each.window(), ""
        except CalibrationRefusedError as error:
            refused = refused or str(error)
    return None, refused


def _posed(window: Window, pose: PoseGiven) -> tuple[Window, Whereabouts, GradienterModel | None, CompassModel | None]:
    """The window with the pose in the place of gradienter and compass."""
    level, north = np.eye(3), np.eye(3)
    tilt = heading = None
    gradienter = compass = None
    if pose.pitch_deg is not None and pose.roll_deg is not None:
        tilt = TiltWindow(
            x_deg=pose.roll_deg,
            y_deg=pose.pitch_deg,
            x_sigma_deg=0.0,
            y_sigma_deg=0.0,
            temperature_degc=None,
        )
        gradienter = GradienterModel("euler", level, (0.0, 0.0), pose.sigma_deg)
    if pose.heading_deg is not None:
        heading = HeadingWindow(heading_deg=pose.heading_deg, sigma_deg=0.0)
        compass = CompassModel(
            magnetic=False, vehicle_from_sensor=north, offset_deg=0.0, sigma_deg=pose.heading_sigma_deg
        )
    source = None if pose.latitude_deg is None and pose.height_m is None else "command line"
    where = Whereabouts(pose.latitude_deg, None, pose.height_m, source, None)
    return msgspec.structs.replace(window, tilt=tilt, heading=heading), where, gradienter, compass

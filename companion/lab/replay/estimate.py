"""Biases in a log, estimated from its longest still stretch; and which stretch that was."""

from __future__ import annotations

import datetime
import math
from collections.abc import Iterator
from typing import Final

import msgspec
import numpy as np

from companion.config.sections import Mounting, Noise, Platform
from companion.errors import CalibrationRefusedError
from companion.estimation.collector.measurement import Measurement
from companion.estimation.collector.outlook import Settings
from companion.estimation.collector.rolling import RollingCollector
from companion.estimation.deck.estimate import MIN_S
from companion.estimation.means.pose import CompassModel, GradienterModel, HeadingWindow, TiltWindow
from companion.estimation.means.windows import ImuInput, Window
from companion.estimation.noise.allan import noise_profile
from companion.estimation.records.record import Record
from companion.estimation.request import What
from companion.estimation.solution.results import record_of
from companion.estimation.solution.site import Remedies, Whereabouts, local_earth
from companion.estimation.solution.solve import solve
from companion.lab.logs.log import Poses, StillLog
from companion.physics.frames import Floats, rotation_matrix
from companion.physics.gradienter import Law
from companion.samples import CompassSample, ImuSample, TiltSample, Vector

MIN_STILL_S: Final = 5.0
MAX_STILL_S: Final = 3600.0
# The collector drops the second in which a stream begins: here that is its first millisecond.
_FIRST_S: Final = 999.999
_REMEDIES: Final = Remedies(
    "say --latitude-deg",
    "say --height-m",
    no_heading="no --heading-deg",
    part="say its part (--profile), or learn it (companion profile)",
    mounting="--mounting {}",
    any_bias="--any-bias takes it",
)
_LONGER: Final[dict[Platform, float]] = {"ground": 1.02, "deck": 1.1}
"""A window is chosen again when the stretch has grown by so much."""
_AT_REST: Final[dict[Platform, str]] = {"ground": "at rest", "deck": "without a gap"}
_AT_ONCE: Final = 4096


class Given(msgspec.Struct, frozen=True, kw_only=True):
    """Pose and place of the IMU, which the log does not contain; None: not known, which widens the sigmas."""

    pitch_deg: float | None = None
    """Before a tilt in the log, as the heading likewise."""
    roll_deg: float | None = None
    heading_deg: float | None = None
    """True."""
    sigma_deg: float = 0.05
    heading_sigma_deg: float = 3.0
    latitude_deg: float | None = None
    longitude_deg: float | None = None
    height_m: float | None = None
    powered_s: float = 0.0
    """For so long the IMU had been switched on when the log began, at least."""
    law: Law = "axis"
    """Law of a tilt in the log."""
    tilt_lag_s: float = 0.0
    """Delay of the tilt in the log."""
    platform: Platform = "ground"
    mounting: Mounting = "ROTATION_NONE"
    """IMU to vehicle FRD."""
    profile: str | Noise | None = None
    """The IMU's model, or figures learned, for its Allan figures."""
    any_bias: bool = False
    """True: accept biases beyond those of any part."""


class Used(msgspec.Struct, frozen=True, kw_only=True):
    """Part of a log that went into the means; times from its first sample on."""

    files: tuple[str, ...]
    seconds: float
    from_s: float | None
    """None: nothing was of use."""
    to_s: float | None
    still_s: int
    """Seconds between them that count."""
    left_out: dict[str, int]
    """Lines, by reason."""
    notes: tuple[str, ...]
    """Assumptions, in words."""


class LogEstimate(msgspec.Struct, frozen=True):
    """Record and used part of a log."""

    record: Record
    used: Used


def estimate(log: StillLog, given: Given, *, max_still_s: float = MAX_STILL_S) -> LogEstimate:
    """Estimate the biases from the longest still stretch of a log."""
    return _Pass(log, given, max_still_s).run()


class _Streams:
    """Tilt and heading for the collector, and their models.

    A value of the command line holds for the whole log; a column of the same quantity is then left out.
    """

    def __init__(self, log: StillLog, given: Given) -> None:
        poses = log.poses or Poses()
        self.notes: list[str] = []
        tilt_given = given.pitch_deg is not None and given.roll_deg is not None
        heading_given = given.heading_deg is not None
        self.tilt = self._unless("tilt", poses.tilt_deg, given=tilt_given)
        self.heading = self._unless("heading", poses.heading_deg, given=heading_given)
        self.gradienter = self.compass = None
        if tilt_given or self.tilt is not None:
            law: Law = "euler" if tilt_given else given.law
            self.gradienter = GradienterModel(law, np.eye(3), (0.0, 0.0), given.sigma_deg, given.tilt_lag_s)
        if heading_given or self.heading is not None:
            self.compass = CompassModel(
                magnetic=not heading_given and poses.magnetic,
                vehicle_from_sensor=np.eye(3),
                offset_deg=0.0,
                sigma_deg=given.heading_sigma_deg,
            )

    def _unless(self, what: str, values: Floats | None, *, given: bool) -> Floats | None:
        if given and values is not None:
            self.notes.append(f"{what} in the log left out: it is given on the command line")
            return None
        return values

    def feed(self, collector: RollingCollector, at: int, now_s: float) -> None:
        """Add the tilt and the heading in line `at` of the log."""
        if self.tilt is not None:
            x_deg, y_deg = self.tilt[at].tolist()
            if x_deg == x_deg and y_deg == y_deg:
                collector.add_tilt(TiltSample(now_s, x_deg, y_deg))
        if self.heading is not None and (heading_deg := float(self.heading[at])) == heading_deg:
            collector.add_compass(CompassSample(now_s, heading_deg % 360.0))


class _Pass:
    """One log through one collector."""

    def __init__(self, log: StillLog, given: Given, max_still_s: float) -> None:
        self._log, self._given, self._max_still_s = log, given, max_still_s
        rotation = rotation_matrix(given.mounting)
        self._streams = _Streams(log, given)
        settings = Settings(
            min_still_s=MIN_STILL_S,
            max_s=max_still_s,
            target_gyro_sigma_rad_s=0.0,
            target_accel_sigma_m_s2=0.0,
            on_a_boat="--platform deck",
        )
        self._least_s = MIN_STILL_S if given.platform == "ground" else float(MIN_S)
        imu = ImuInput(name=log.imu, rotation=rotation, profile=noise_profile(given.profile or log.profile))
        tilt, compass = self._streams.gradienter, self._streams.compass
        self._collector = RollingCollector(settings, [imu], tilt, compass, on_deck=given.platform == "deck")
        self._collector.expect(gradienter=self._streams.tilt is not None, compass=self._streams.heading is not None)
        self._found: list[Measurement] = []
        self._still_s = 0.0
        self._obstacle = ""
        self._longest_s = 0.0

    def run(self) -> LogEstimate:
        """Run from the first sample to the last."""
        log, collector = self._log, self._collector
        began_at = datetime.datetime.now(tz=datetime.UTC)
        offset_s = _FIRST_S - float(log.t_s[0])
        end_s = float(log.t_s[-1]) + offset_s
        looked_s = _FIRST_S
        add, feed, name = collector.add_imu, self._streams.feed if log.poses is not None else None, log.imu
        for at, (now_s, gyro, accel, degc) in enumerate(_rows(log, offset_s)):
            # Whoever looks has not seen the sample yet that tells him that it is time to.
            if now_s - looked_s >= 1.0:
                looked_s = math.floor(now_s)
                collector.tick(now_s)
                self._look(now_s)
            add(name, ImuSample(now_s, gyro, accel, degc))
            if feed is not None:
                feed(collector, at, now_s)
        collector.tick(end_s + 0.3)
        self._look(end_s + 0.3, last=True)
        best, refused = _latest(self._found)
        seconds = end_s - _FIRST_S
        if best is None:
            why = self._obstacle or self._unusable(seconds)
            least = f"no {self._least_s:.0f} s {_AT_REST[self._given.platform]} in it"
            record = record_of(None, began_at, seconds, state="failed", reason=refused or f"{least}: {why}")
            return LogEstimate(record, self._used(None, seconds))
        record = self._solved(began_at, best[1], seconds)
        return LogEstimate(record, self._used(best[0], seconds))

    def _look(self, now_s: float, *, last: bool = False) -> None:
        """Measure at the end of a second if the stretch has grown enough."""
        collector = self._collector
        glance = collector.glance(now_s)
        self._longest_s = max(self._longest_s, glance.still_s)
        if glance.obstacle is not None:
            if glance.obstacle.hold_still_s is None:
                self._obstacle = glance.obstacle.words
        elif glance.still_s >= self._least_s and glance.still_s > self._still_s * (
            1.0 if last else _LONGER[self._given.platform]
        ):
            try:
                self._found.append(self._aged(collector.measurement(now_s)))
            except CalibrationRefusedError:
                return  # seconds of a deck end in tens
            self._still_s = glance.still_s

    def _unusable(self, seconds: float) -> str:
        """Give the reason where no second could be judged."""
        (imu, *_) = self._collector.status(seconds + _FIRST_S).sources
        worst = max(imu.dropped, key=lambda why: imu.dropped[why], default="")
        if worst:
            return f"{imu.dropped[worst]} samples dropped: {worst}"
        if self._given.platform == "deck":
            return f"the longest is {self._longest_s:.0f} s, without its first"
        return f"it is {seconds:.1f} s long"

    def _aged(self, measurement: Measurement) -> Measurement:
        """Add the time for which the IMU had been on before the log, unless it was silent since."""
        begun_s = measurement.begun_s.get(self._log.imu, math.inf)
        powered_s = self._given.powered_s
        if self._log.clock_from_start:
            powered_s = max(powered_s, float(self._log.t_s[0]))
        if not powered_s or begun_s > math.ceil(_FIRST_S):
            return measurement
        return msgspec.structs.replace(measurement, begun_s={self._log.imu: begun_s - powered_s})

    def _solved(self, began_at: datetime.datetime, window: Window, seconds: float) -> Record:
        given, streams = self._given, self._streams
        warnings: list[str] = []
        if streams.gradienter is None:
            tilt = "a tilt in the log" if given.platform == "deck" else "--pitch-deg and --roll-deg"
            warnings.append(f"no accelerometer biases without {tilt}")
        source = None if given.latitude_deg is None and given.height_m is None else "command line"
        date = began_at.date()
        where = Whereabouts(given.latitude_deg, given.longitude_deg, given.height_m, source, date)
        what = What.GYROS if streams.gradienter is None else What.BOTH
        try:
            earth = local_earth(where, _REMEDIES)
            posed, poses = _posed(window, given), (streams.gradienter, streams.compass)
            solution = solve(posed, earth, *poses, what, given.platform, any_bias=given.any_bias)
        except CalibrationRefusedError as error:
            return record_of(None, began_at, seconds, state="failed", reason=str(error), warnings=warnings)
        return record_of(solution, began_at, seconds, warnings=warnings)

    def _used(self, measurement: Measurement | None, seconds: float) -> Used:
        slots = [] if measurement is None else measurement.slots
        first = math.ceil(_FIRST_S)
        return Used(
            files=self._log.files,
            seconds=seconds,
            from_s=float(slots[0] - first) if slots else None,
            to_s=float(slots[-1] + 1 - first) if slots else None,
            still_s=len(slots),
            left_out=self._log.left_out,
            notes=(*self._log.notes, *self._streams.notes),
        )


def _rows(log: StillLog, offset_s: float) -> Iterator[tuple[float, Vector, Vector, float | None]]:
    """Give time, rates, forces and temperature of each sample."""
    for at in range(0, len(log.t_s), _AT_ONCE):
        part = slice(at, at + _AT_ONCE)
        times = (log.t_s[part] + offset_s).tolist()
        degrees = log.temperature_degc[part].tolist()
        for now_s, (gx, gy, gz, ax, ay, az), degc in zip(times, log.readings[part].tolist(), degrees, strict=True):
            yield now_s, (gx, gy, gz), (ax, ay, az), None if degc != degc else degc


def _latest(found: list[Measurement]) -> tuple[tuple[Measurement, Window] | None, str]:
    """Find the latest measurement that gives a window; without one, the reason of the very latest."""
    refused = ""
    for each in reversed(found):
        try:
            return (each, each.window()), ""
        except CalibrationRefusedError as error:
            refused = refused or str(error)
    return None, refused


def _posed(window: Window, given: Given) -> Window:
    """Replace gradienter and compass of a window by the given pose."""
    tilt, heading = window.tilt, window.heading
    if given.pitch_deg is not None and given.roll_deg is not None:
        tilt = TiltWindow(
            x_deg=given.roll_deg, y_deg=given.pitch_deg, x_sigma_deg=0.0, y_sigma_deg=0.0, temperature_degc=None
        )
    if given.heading_deg is not None:
        heading = HeadingWindow(heading_deg=given.heading_deg, sigma_deg=0.0)
    return msgspec.structs.replace(window, tilt=tilt, heading=heading)

"""Estimation of biases from a log: from its longest time at rest, or from adjacent windows to check sigma."""

from __future__ import annotations

import datetime
import itertools
import math
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Final, NamedTuple

import msgspec
import numpy as np

from companion.config.sections import Mounting, NoiseProfile
from companion.errors import CalibrationRefusedError, StorageError
from companion.estimation.collector.intake import Settings
from companion.estimation.collector.measurement import Measurement
from companion.estimation.collector.rolling import RollingCollector
from companion.estimation.machine import What
from companion.estimation.means.pose import CompassModel, GradienterModel, HeadingWindow, TiltWindow
from companion.estimation.means.windows import ImuInput, Window
from companion.estimation.noise.allan import noise_profile
from companion.estimation.records.record import ImuRecord, Record
from companion.estimation.solution.results import record_of
from companion.estimation.solution.site import Remedies, Whereabouts, local_earth
from companion.estimation.solution.solve import Solution, solve
from companion.formats import Object
from companion.lab.still_log import StillLog
from companion.physics import earth
from companion.physics.frames import Floats, body_from_ned, roll_pitch_from_up, rotation_matrix
from companion.physics.units import DEG
from companion.samples import ImuSample, Vector

MIN_STILL_S: Final = 5.0
MAX_STILL_S: Final = 3600.0
# The collector drops the second in which a stream begins: times are shifted so that it has only one millisecond.
_FIRST_S: Final = 999.999
_REMEDIES: Final = Remedies(
    "say --latitude-deg",
    "say --height-m",
    no_heading="no --heading-deg",
    part="name its part (--profile), or learn it (companion log profile)",
    mounting="--mounting {}",
    any_bias="--any-bias takes it",
)
_LONGER: Final = 1.02  # Growth of the stretch after which a new window is chosen
_AT_ONCE: Final = 4096

MOST_WINDOWS: Final = 100_000
"""Largest number of windows: eleven days of the shortest ones; more mean that the log's clock jumped."""
PAUSE_S: Final = 3.0
"""Longest gap between samples, s, in which the sensor was certainly not powered off."""
HORIZON_S: Final = 180.0
_AXES: Final = ("gyro x", "gyro y", "gyro z", "accel x", "accel y", "accel z")
_SAME_RAD: Final = 1.0 * DEG
"""Largest rotation of the measured gravity, rad, for an unmoved sensor: a drift of the bias rotates gravity less."""
_EXACT_DEG: Final = 1e-4
_LATITUDE_DEG: Final = 45.0
"""Substitute for an unknown latitude; its value does not matter, because the Earth's rate cancels between windows."""


class Given(msgspec.Struct, frozen=True, kw_only=True):
    """Pose, place and sensor model of an IMU, which its log does not contain; None (unknown) widens the sigmas.

    `powered` is the least time in s from power-on to the log's beginning. `mounting` rotates from IMU to vehicle axes
    (FRD). `profile` is the IMU's model, or learned noise figures. `any_bias` accepts larger biases than sensors have.
    """

    pitch_deg: float | None = None
    roll_deg: float | None = None
    heading_deg: float | None = None  # From true north
    sigma_deg: float = 0.05
    heading_sigma_deg: float = 3.0
    latitude_deg: float | None = None
    height_m: float | None = None
    powered: float = 0.0
    mounting: Mounting = "ROTATION_NONE"
    profile: str | NoiseProfile | None = None
    any_bias: bool = False


def estimate(log: StillLog, given: Given, *, max_still_s: float = MAX_STILL_S) -> tuple[Record, Object]:
    """Estimate the biases from a log's longest time at rest; return the record, and that time as a JSON object."""
    return _Pass(log, given, max_still_s).run()


class _Pass:
    def __init__(self, log: StillLog, given: Given, max_still_s: float) -> None:
        self._log, self._given = log, given
        self._gradienter = self._compass = None
        if given.pitch_deg is not None and given.roll_deg is not None:
            self._gradienter = GradienterModel("euler", np.eye(3), (0.0, 0.0), given.sigma_deg, 0.0)
        if given.heading_deg is not None:
            self._compass = CompassModel(
                magnetic=False, vehicle_from_sensor=np.eye(3), offset_deg=0.0, sigma_deg=given.heading_sigma_deg
            )
        settings = Settings(
            min_still_s=MIN_STILL_S,
            max_s=max_still_s,
            target_gyro_sigma_rad_s=0.0,
            target_accel_sigma_m_s2=0.0,
        )
        profile = noise_profile(given.profile or log.profile)
        imu = ImuInput(name=log.imu, rotation=rotation_matrix(given.mounting), profile=profile)
        self._collector = RollingCollector(settings, [imu], self._gradienter, self._compass)
        self._collector.expect(gradienter=False, compass=False)
        self._found: list[Measurement] = []
        self._still_s = 0.0
        self._obstacle = ""

    def run(self) -> tuple[Record, Object]:
        log, collector = self._log, self._collector
        began_at = datetime.datetime.now(tz=datetime.UTC)
        offset_s = _FIRST_S - float(log.t_s[0])
        end_s = float(log.t_s[-1]) + offset_s
        looked_s = _FIRST_S
        for now_s, gyro, accel, degc in _rows(log, offset_s):
            # Check before the sample is added, as in the daemon: the first sample of a second ends the previous one.
            if now_s - looked_s >= 1.0:
                looked_s = math.floor(now_s)
                collector.tick(now_s)
                self._look(now_s)
            collector.add_imu(log.imu, ImuSample(now_s, gyro, accel, degc))
        collector.tick(end_s + 0.3)
        self._look(end_s + 0.3, longer=1.0)
        seconds = end_s - _FIRST_S
        slots: Sequence[int] = ()
        warnings = (
            [] if self._gradienter is not None else ["no accelerometer biases without --pitch-deg and --roll-deg"]
        )
        try:
            measurement, window = self._latest(seconds)
            slots = measurement.slots
            solution = self._solve(window, began_at.date())
        except CalibrationRefusedError as error:
            record = record_of(None, began_at, seconds, state="failed", reason=str(error), warnings=warnings)
        else:
            record = record_of(solution, began_at, seconds, warnings=warnings)
        return record, self._used(slots, seconds)

    def _look(self, now_s: float, longer: float = _LONGER) -> None:
        glance = self._collector.glance(now_s)
        if glance.obstacle is not None:
            if glance.obstacle.hold_still_s is None:
                self._obstacle = glance.obstacle.words
        elif glance.still_s >= MIN_STILL_S and glance.still_s > self._still_s * longer:
            self._found.append(self._aged(self._collector.measurement(now_s)))
            self._still_s = glance.still_s

    def _latest(self, seconds: float) -> tuple[Measurement, Window]:
        """Return the latest measurement that gives a window, and the window; if none does, raise the latest refusal."""
        refusals = []
        for each in reversed(self._found):
            try:
                return each, each.window()
            except CalibrationRefusedError as error:
                refusals.append(error)
        if refusals:
            raise refusals[0]
        raise CalibrationRefusedError(
            f"no {MIN_STILL_S:.0f} s at rest in it: {self._obstacle or self._unusable(seconds)}"
        )

    def _unusable(self, seconds: float) -> str:
        (imu, *_) = self._collector.status(seconds + _FIRST_S).sources
        worst = max(imu.dropped, key=lambda why: imu.dropped[why], default="")
        return f"{imu.dropped[worst]} samples dropped: {worst}" if worst else f"it is {seconds:.1f} s long"

    def _aged(self, measurement: Measurement) -> Measurement:
        """Count the time powered before the log too, unless a pause separates the measurement from the log's start."""
        begun_s = measurement.begun_s.get(self._log.imu, math.inf)
        powered = self._given.powered
        if self._log.clock_from_start:
            powered = max(powered, float(self._log.t_s[0]))
        if not powered or begun_s > math.ceil(_FIRST_S):
            return measurement
        return msgspec.structs.replace(measurement, begun_s={self._log.imu: begun_s - powered})

    def _solve(self, window: Window, today: datetime.date) -> Solution:
        given = self._given
        source = None if given.latitude_deg is None and given.height_m is None else "command line"
        earth = local_earth(Whereabouts(given.latitude_deg, None, given.height_m, source, today), _REMEDIES)
        what = What.GYROS if self._gradienter is None else What.BOTH
        window = _posed(window, given)
        return solve(window, earth, self._gradienter, self._compass, what, any_bias=given.any_bias)

    def _used(self, slots: Sequence[int], seconds: float) -> Object:
        first = math.ceil(_FIRST_S)
        return {
            "files": self._log.files,
            "seconds": seconds,
            "from_s": float(slots[0] - first) if slots else None,
            "to_s": float(slots[-1] + 1 - first) if slots else None,
            "still_s": len(slots),
            "left_out": self._log.left_out,
            "notes": self._log.notes,
        }


def _rows(log: StillLog, offset_s: float) -> Iterator[tuple[float, Vector, Vector, float | None]]:
    for at in range(0, len(log.t_s), _AT_ONCE):
        part = slice(at, at + _AT_ONCE)
        times = (log.t_s[part] + offset_s).tolist()
        degrees = log.temperature_degc[part].tolist()
        for now_s, (gx, gy, gz, ax, ay, az), degc in zip(times, log.readings[part].tolist(), degrees, strict=True):
            yield now_s, (gx, gy, gz), (ax, ay, az), None if degc != degc else degc


def _posed(window: Window, given: Given) -> Window:
    tilt, heading = window.tilt, window.heading
    if given.pitch_deg is not None and given.roll_deg is not None:
        tilt = TiltWindow(
            x_deg=given.roll_deg, y_deg=given.pitch_deg, x_sigma_deg=0.0, y_sigma_deg=0.0, temperature_degc=None
        )
    if given.heading_deg is not None:
        heading = HeadingWindow(heading_deg=given.heading_deg, sigma_deg=0.0)
    return msgspec.structs.replace(window, tilt=tilt, heading=heading)


# --- windows


class WindowResult(NamedTuple):
    """Result of one window of a log, samples `start` to `end`, calibrated by itself.

    `biases` (3, 6) are bias, sigma after averaging, stated sigma; None: the calibration was refused, for reason `why`.
    `by_pose` (6,) is the reading of a bias-free sensor in this pose; it is constant between two moves.
    """

    start: int
    end: int
    biases: Floats | None
    why: str
    by_pose: Floats
    moved: bool  # The attitude differs from that of the previous window


def calibrated(log: StillLog, given: Given, length_s: float) -> Iterator[WindowResult]:
    """Calibrate every window of `length_s` seconds independently, as if the sensor had just been started.

    A pose that is not given is computed from the window's mean and counts as exact: sigma has the sensor's errors only.

    Raises:
        StorageError: the log has more than `MOST_WINDOWS` windows.
    """
    posed, force = given, np.zeros(3)
    begin_s = float(log.t_s[0])
    starts_s = np.concatenate(([begin_s], log.t_s[1:][np.diff(log.t_s) > PAUSE_S]))
    count = math.floor((float(log.t_s[-1]) - begin_s) / length_s + 1e-6)
    if count > MOST_WINDOWS:
        raise StorageError(f"{log.files[0]}: {count} windows from its first to its last time; allowed: {MOST_WINDOWS}")
    edges = np.searchsorted(log.t_s, begin_s + length_s * np.arange(count + 1))
    by_pose = np.zeros(6)
    for start, end in itertools.pairwise(edges.tolist()):
        if end - start < 2:
            yield WindowResult(start, end, None, "no samples", by_pose, moved=False)
            continue
        part = msgspec.structs.replace(
            log, t_s=log.t_s[start:end], readings=log.readings[start:end],
            temperature_degc=log.temperature_degc[start:end],
        )  # fmt: skip
        here = part.readings[:, 3:].mean(axis=0)
        moved = not here @ force >= math.cos(_SAME_RAD) * np.linalg.norm(here) * np.linalg.norm(force) > 0.0
        if moved:
            posed, force = _posed_by(here, given), here
            by_pose = _without_bias(posed)
        # The time since power-on bounds the warm-up that is still to come.
        at = int(np.searchsorted(starts_s, log.t_s[start], side="right")) - 1
        powered_s = float(log.t_s[start] - starts_s[at]) + (posed.powered if at == 0 else 0.0)
        record, _ = estimate(part, msgspec.structs.replace(posed, powered=powered_s), max_still_s=length_s)
        imu = record.imus[0] if record.imus else None
        biases = None if imu is None else _figures(imu)
        why = "" if biases is not None else record.reason if imu is None else "; ".join(imu.warnings)
        yield WindowResult(start, end, biases, why, by_pose, moved)


def _without_bias(given: Given) -> Floats:
    """Return the reading (6,) of a bias-free sensor at the given pose and place, in vehicle axes."""
    roll, pitch, heading = ((angle or 0.0) * DEG for angle in (given.roll_deg, given.pitch_deg, given.heading_deg))
    turn = body_from_ned(roll, pitch, heading)
    latitude_deg, height_m = given.latitude_deg or 0.0, given.height_m or 0.0
    force = turn @ (0.0, 0.0, -earth.gravity_m_s2(latitude_deg, height_m))
    return np.concatenate([turn @ earth.earth_rate_ned_rad_s(latitude_deg), force])


def windows(log: StillLog, given: Given, length_s: float) -> tuple[int, dict[str, int], list[Object]]:
    """Check a sensor's stated sigma: compare the biases of each window with those of the windows after it.

    If sigma is right, 95 of 100 differences stay within 2 sigma. Errors of the pose cancel; no comparison spans a move.

    Returns:
        Number of windows; number of failed windows by reason (figures in it are ignored), the commonest reason first;
        comparisons by axis, empty if no two consecutive windows gave a result.
    """
    results = list(calibrated(log, given, length_s))
    found = [each for one in results for each in ([None] if one.moved else []) + [one.biases]]
    whys = Counter(uncounted(one.why) for one in results if one.biases is None)
    spans = sorted({1, math.ceil(HORIZON_S / length_s)})
    first = {uncounted(one.why): one.why for one in reversed(results)}
    refused = {first[kind]: count for kind, count in whys.most_common()}
    return len(results), refused, [each for span in spans for each in _kept(found, span, span * length_s)]


def uncounted(why: str) -> str:
    """Replace the figures in a reason, so that equal reasons can be counted."""
    return re.sub(r"\d+(\.\d+)?", "…", why)


def _posed_by(force: Floats, given: Given) -> Given:
    """Fill in unknown values: the pose from the specific force (3,), and a place; pose and place count as exact."""
    mean = rotation_matrix(given.mounting) @ force
    roll_rad, pitch_rad = roll_pitch_from_up(mean / np.linalg.norm(mean))
    return msgspec.structs.replace(
        given,
        pitch_deg=pitch_rad / DEG if given.pitch_deg is None else given.pitch_deg,
        roll_deg=roll_rad / DEG if given.roll_deg is None else given.roll_deg,
        heading_deg=given.heading_deg or 0.0,
        sigma_deg=_EXACT_DEG,
        heading_sigma_deg=_EXACT_DEG,
        latitude_deg=_LATITUDE_DEG if given.latitude_deg is None else given.latitude_deg,
        height_m=given.height_m or 0.0,
    )


def _figures(imu: ImuRecord) -> Floats | None:
    gyro = (imu.gyro_bias_rad_s, imu.gyro_sigma_stat_rad_s, imu.gyro_sigma_use_rad_s)
    accel = (imu.accel_bias_m_s2, imu.accel_sigma_stat_m_s2, imu.accel_sigma_use_m_s2)
    return None if None in gyro or None in accel else np.hstack([np.array(gyro), np.array(accel)])


def _kept(found: Sequence[Floats | None], span: int, next_s: float) -> list[Object]:
    """Compare each window's biases with the mean of the `span` windows after it; one result per axis, SI units.

    `rms` is the rms difference, `sigma_use` the median of the stated sigmas. `ratio` is the rms of difference over
    sigma (1: sigma is right), `share` the fraction within 2 sigma; here sigma includes the later windows' white noise.
    """
    misses, uses, seen = [], [], []
    for at, one in enumerate(found):
        after = [each for each in found[at + 1 : at + 1 + span] if each is not None]
        if one is None or len(after) < span:
            continue
        bias, stat, _ = np.moveaxis(np.array(after), 1, 0)
        misses.append(one[0] - bias.mean(axis=0))
        uses.append(np.square(one[2]))
        seen.append(np.square(stat).mean(axis=0) / span)
    if not misses:
        return []
    columns = zip(_AXES, *(np.array(each).T for each in (misses, uses, seen)), strict=True)
    return [
        {
            "axis": axis,
            "next_s": next_s,
            "pairs": len(misses),
            "sigma_use": float(np.sqrt(np.median(use))),
            "rms": float(np.sqrt(np.square(miss).mean())),
            "ratio": float(np.sqrt((np.square(miss) / (use + own)).mean())),
            "share": float((np.square(miss) <= 4.0 * (use + own)).mean()),
        }
        for axis, miss, use, own in columns
    ]

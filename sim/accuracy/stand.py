"""One motionless aircraft: a simulated IMU read sample by sample into the flying collector, and its solution.

Nothing of the estimator is copied or shortened: samples go into `RollingCollector` (seconds, stillness, robust means,
ramps, sigmas), the collector's windows into `solve` (pose, Earth, biases, covariance). Truth, noise, Earth and
gradienter are the simulator's own.
"""

from __future__ import annotations

import dataclasses
import datetime
import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from companion.estimation.collector.intake import Settings
from companion.estimation.collector.rolling import RollingCollector
from companion.estimation.machine import What
from companion.estimation.means.pose import CompassModel, GradienterModel
from companion.estimation.means.windows import ImuInput, Window
from companion.estimation.solution.site import LocalEarth, Whereabouts, local_earth
from companion.estimation.solution.solve import ImuSolution, Solution, solve
from companion.physics.gradienter import Law
from companion.samples import CompassSample, ImuSample, TiltSample
from sim.aircraft import Pose, Site, VirtualAircraft
from sim.devices import Gradienter
from sim.earth import Array
from sim.imu_model import DEG_H, MG, ImuModel, ImuSpec
from sim.scenario import site_at
from sim.thermal import Curve

BEGIN_S: Final = 0.5
"""Start of the readings in the first second, which is not counted; the windows begin at 1 s."""
NEXT_S: Final = 180.0
RATE_HZ: Final = 100
GYRO_BIAS_RAD_S: Final = 100.0 * DEG_H
"""Sigma of the gyro bias at power-up, from the scatter in the paper's tables (method 1.3)."""
ACCEL_BIAS_M_S2: Final = 2.0 * MG
GRAVITY_ANOMALY_M_S2: Final = 3.0e-4
"""Sigma of the error of the formula for normal gravity, 30 mGal (method 2.1)."""
STEADY_DEGC: Final = 25.0
THERMOMETER_K: Final = 0.02
"""Noise of one reading of the IMU's own thermometer."""
_CLOSE_S: Final = 0.3
_TILT_HZ: Final = 10.0
_TILT_NOISE_DEG: Final = 1e-4
_HEADING_HZ: Final = 8.0
_HEADING_NOISE_DEG: Final = 0.05


@dataclass(frozen=True, slots=True)
class Posture:
    """Pose of the aircraft in degrees, law of the gradienter, mounting of the IMU."""

    name: str
    pitch_deg: float
    roll_deg: float
    law: Law = "axis"
    mounting_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    by_eye_deg: float = 0.0
    """Sigma of pitch and roll if a person levels the aircraft by eye; added to the pose."""


POSTURES: Final = (
    Posture("level", 0.0, 0.0),
    Posture("by eye", 0.0, 0.0, "slope", by_eye_deg=0.5),
    Posture("5/-3", 5.0, -3.0),
    Posture("20/15", 20.0, 15.0, "slope", (180.0, 0.0, 90.0)),
    Posture("inverted", 10.0, 170.0, "euler"),
)
"""Postures to simulate. "20/15" has its IMU upside down; "inverted" lies on its back, for law "euler" only."""


@functools.cache
def sites() -> tuple[Site, ...]:
    """Return sites at the equator, 45 N, 60 N and in the south, each with its magnetic field."""
    places = ((0.0, -78.0, 2800.0), (45.0, 10.0, 100.0), (60.0, 25.0, 20.0), (-35.0, 149.0, 580.0))
    return tuple(site_at(*place) for place in places)


@functools.cache
def local(site: Site) -> LocalEarth:
    """Return gravity, Earth rate and declination at `site` as the companion computes them."""
    return local_earth(
        Whereabouts(site.latitude_deg, site.longitude_deg, site.height_m, "configuration", datetime.date(2026, 11, 21))
    )


@dataclass(frozen=True, slots=True)
class AnomalousSite(Site):
    """A place where gravity differs from the formula."""

    anomaly_m_s2: float = 0.0

    @property
    def gravity_m_s2(self) -> float:
        """True gravity at this place, with the anomaly."""
        return super(AnomalousSite, self).gravity_m_s2 + self.anomaly_m_s2


@dataclass(frozen=True, slots=True, eq=False)
class Stand:
    posture: Posture
    site: Site
    """Place with gravity by the formula; at the aircraft's own site, gravity can have an anomaly."""
    imu: ImuModel
    random: np.random.Generator

    @property
    def heading_deg(self) -> float:
        return self.imu.aircraft.pose.heading_deg

    def in_vehicle(self, rows: Array) -> Array:
        """Rotate readings (…, 6) from sensor axes to the vehicle's axes."""
        turn = self.imu.mounting.T
        return np.concatenate([rows[..., :3] @ turn, rows[..., 3:] @ turn], axis=-1)

    def bias(self, start_s: float, end_s: float) -> Array:
        """Return the true mean bias (6) from `start_s` to `end_s`, in vehicle FRD."""
        return self.in_vehicle(np.concatenate(self.imu.mean_bias(start_s, end_s)))


def stand(
    spec: ImuSpec | str,
    posture: Posture,
    site: Site,
    seed: Sequence[int],
    *,
    anomaly_m_s2: float = 0.0,
    gyro_bias_rad_s: Array | None = None,
    accel_bias_m_s2: Array | None = None,
    temperature_degc: float | Callable[[float], float] = STEADY_DEGC,
    curve: Curve | None = None,
) -> Stand:
    """Make a stand: heading, biases (unless given, in sensor axes) and noise come from the seed."""
    random = np.random.default_rng([*seed, 21])
    tilt = random.normal(size=2) * posture.by_eye_deg
    heading_deg = float(random.uniform(0.0, 360.0))
    pose = Pose(posture.pitch_deg + float(tilt[0]), posture.roll_deg + float(tilt[1]), heading_deg)
    here = AnomalousSite(**dataclasses.asdict(site), anomaly_m_s2=float(random.normal() * anomaly_m_s2))
    gyro, accel = random.normal(size=3) * GYRO_BIAS_RAD_S, random.normal(size=3) * ACCEL_BIAS_M_S2
    imu = ImuModel(
        VirtualAircraft(pose, here, temperature_degc=temperature_degc),
        spec,
        seed=int(random.integers(2**62)),
        gyro_bias_rad_s=(gyro if gyro_bias_rad_s is None else gyro_bias_rad_s).tolist(),
        accel_bias_m_s2=(accel if accel_bias_m_s2 is None else accel_bias_m_s2).tolist(),
        mounting_deg=posture.mounting_deg,
        curve=curve,
    )
    return Stand(posture, site, imu, random)


def samples(standing: Stand, seconds: float, rate_hz: int = RATE_HZ) -> tuple[Array, Array]:
    """Read the IMU from `BEGIN_S` on, for `seconds` whole seconds: times (n) and readings (n, 6) in sensor axes."""
    times = BEGIN_S + (np.arange(round((1.0 - BEGIN_S + seconds) * rate_hz)) + 0.5) / rate_hz
    return times, standing.imu.read(times, 1.0 / rate_hz)


def collected(
    standing: Stand,
    taken: ImuInput,
    times: Array,
    rows: Array,
    spans_s: Sequence[int],
    *,
    horizon_s: float = NEXT_S,
    thermometer: bool = True,
) -> list[Window]:
    """Return the windows after each span (ascending), fed sample by sample in the order of time.

    Gradienter and compass are read without error; `solved` adds the errors of the references.
    """
    wanted = Settings(
        min_still_s=float(spans_s[0]),
        max_s=float(spans_s[-1]),
        target_gyro_sigma_rad_s=0.0,
        target_accel_sigma_m_s2=0.0,
        horizon_s=horizon_s,
    )
    collector = RollingCollector(wanted, [taken], *_models(standing, EXACT))
    tilts, headings = _tilts(standing, float(times[-1])), _headings(standing, float(times[-1]))
    found: list[Window] = []
    spans = list(spans_s)
    warm = _temperatures(standing, times) if thermometer else [None] * len(times)
    for t_s, (p, q, r, x, y, z), degc in zip(times.tolist(), rows.tolist(), warm, strict=True):
        if spans and t_s >= 1.0 + spans[0]:
            found.append(_window(collector, 1.0 + spans.pop(0) + _CLOSE_S))
        while tilts and tilts[-1].t_s <= t_s:
            collector.add_tilt(tilts.pop())
        while headings and headings[-1].t_s <= t_s:
            collector.add_compass(headings.pop())
        collector.add_imu(taken.name, ImuSample(t_s, (p, q, r), (x, y, z), degc))
    return found + [_window(collector, 1.0 + span + _CLOSE_S) for span in spans]


def _temperatures(standing: Stand, times: Array) -> list[float | None]:
    """Return thermometer readings at the given times; the temperature is interpolated on a grid of 0.1 s."""
    noise = np.random.default_rng(round(1e6 * standing.heading_deg))
    coarse = np.linspace(times[0], times[-1], max(2, round(float(times[-1] - times[0]) * 10.0)))
    smooth = np.interp(times, coarse, [standing.imu.temperature_degc(float(t_s)) for t_s in coarse])
    return list((smooth + noise.normal(size=len(times)) * THERMOMETER_K).tolist())


def _window(collector: RollingCollector, now_s: float) -> Window:
    collector.tick(now_s)
    return collector.window(now_s)


def _tilts(standing: Stand, until_s: float) -> list[TiltSample]:
    """Return the gradienter's readings until a time, the latest first."""
    times = np.arange(BEGIN_S, until_s, 1.0 / _TILT_HZ)
    device = Gradienter(standing.imu.aircraft, law=standing.posture.law, range_deg=360.0)
    readings = device.tilt_deg(times) + standing.random.normal(size=(len(times), 2)) * _TILT_NOISE_DEG
    return [TiltSample(t_s, x, y) for t_s, (x, y) in zip(times.tolist(), readings.tolist(), strict=True)][::-1]


def _headings(standing: Stand, until_s: float) -> list[CompassSample]:
    """Return the compass headings until a time, the latest first."""
    times = np.arange(BEGIN_S, until_s, 1.0 / _HEADING_HZ)
    noise = standing.random.normal(size=len(times)) * _HEADING_NOISE_DEG
    readings = np.mod(standing.heading_deg - standing.site.declination_deg + noise, 360.0)
    return [CompassSample(t_s, heading) for t_s, heading in zip(times.tolist(), readings.tolist(), strict=True)][::-1]


@dataclass(frozen=True, slots=True, kw_only=True)
class References:
    """Stated sigmas of tilt and heading, and their errors; degrees."""

    tilt_sigma_deg: float = 0.0
    tilt_error_deg: tuple[float, float] = (0.0, 0.0)
    heading_sigma_deg: float = 0.0
    heading_error_deg: float = 0.0

    @classmethod
    def drawn(cls, tilt_sigma_deg: float, heading_sigma_deg: float, random: np.random.Generator) -> References:
        """Draw errors from the stated sigmas."""
        x, y, heading = (random.normal(size=3) * [tilt_sigma_deg, tilt_sigma_deg, heading_sigma_deg]).tolist()
        return cls(
            tilt_sigma_deg=tilt_sigma_deg,
            tilt_error_deg=(x, y),
            heading_sigma_deg=heading_sigma_deg,
            heading_error_deg=heading,
        )


EXACT: Final = References()


def solved(standing: Stand, window: Window, references: References = EXACT) -> Solution:
    return solve(window, local(standing.site), *_models(standing, references), What.BOTH)


def _models(standing: Stand, references: References) -> tuple[GradienterModel, CompassModel]:
    """Return models with an offset of -e, which have the effect of readings that are wrong by e."""
    x, y = references.tilt_error_deg
    tilt = GradienterModel(standing.posture.law, np.eye(3), (-x, -y), references.tilt_sigma_deg)
    heading = CompassModel(
        magnetic=True,
        vehicle_from_sensor=np.eye(3),
        offset_deg=references.heading_error_deg,
        sigma_deg=references.heading_sigma_deg,
    )
    return tilt, heading


def biases(found: ImuSolution) -> Array:
    """Return the estimated biases (6,) in vehicle FRD; NaN: the triad was refused."""
    refused = np.full(3, math.nan)
    return np.concatenate(
        [
            refused if found.gyro_rad_s is None else found.gyro_rad_s,
            refused if found.accel_m_s2 is None else found.accel_m_s2,
        ]
    )


def sigmas_use(found: ImuSolution) -> Array:
    return np.sqrt(np.diag(found.use_covariance))

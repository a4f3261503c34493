"""Calibrations on a deck in waves: their errors and stated sigmas.

The simulator makes the readings sample by sample; the seconds go into `Deck` as in the daemon, the
windows of `Deck` into `solve`.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from companion.errors import CalibrationRefusedError
from companion.estimation.deck.deck import Deck
from companion.estimation.machine import What
from companion.estimation.means.pose import CompassModel, GradienterModel
from companion.estimation.means.windows import ImuInput, Window
from companion.estimation.noise.allan import PROFILES, floor_variance, noise_profile
from companion.estimation.seconds.batch import summary, unrolled
from companion.estimation.solution.solve import solve
from sim.accuracy.experiments import many
from sim.accuracy.figures import Claim, Errors, Figure, Section, covered, rms, stack
from sim.accuracy.stand import ACCEL_BIAS_M_S2, GRAVITY_ANOMALY_M_S2, GYRO_BIAS_RAD_S, NEXT_S, AnomalousSite, local
from sim.aircraft import Pose, VirtualAircraft
from sim.devices import Gradienter
from sim.earth import Array
from sim.imu_model import DEG_H, MG, ImuModel
from sim.motions import DAY_S, SWELL, Motion, Sea, SlowTurn, Wave
from sim.scenario import site_at

RATE_HZ: Final = 200
TILT_HZ: Final = 10
HEADING_HZ: Final = 8
TILT_SIGMA_DEG: Final = 0.01
TILT_NOISE_DEG: Final = 0.001
LAG_S: Final = 0.4
COMPASS_SIGMA_DEG: Final = 1.0
COMPASS_NOISE_DEG: Final = 0.5
_BEFORE_S: Final = 20.0
_CHUNK_S: Final = 30


@dataclass(frozen=True, slots=True)
class Voyage:
    """Conditions of an aircraft on a deck."""

    waves: tuple[Wave, ...] = SWELL
    turn_deg_s: float = 0.3
    part: str = "icm42688p"
    latitude_deg: float = 45.0
    compass_sigma_deg: float = COMPASS_SIGMA_DEG
    gyro_axes_sigma: float = 0.0029
    """Sigma of the gyros' scale and cross-axis errors, as for a uniform distribution up to 0.5 %."""
    gyro_bias_rad_s: float = GYRO_BIAS_RAD_S
    """Sigma of the gyro biases."""

    def motions(self, seed: int) -> list[Motion]:
        """Return the motions of the deck, which begin before the calibration and end after it."""
        found: list[Motion] = []
        if self.waves:
            found.append(Sea(start_s=-_BEFORE_S, waves=self.waves, seed=seed))
        if self.turn_deg_s:
            found.append(SlowTurn(start_s=-_BEFORE_S, duration_s=DAY_S, rate_deg_s=self.turn_deg_s))
        return found


def sail(
    voyage: Voyage, spans_s: Sequence[int], seed: int, made: Callable[[GradienterModel, CompassModel], Deck] = Deck
) -> Errors:
    """Calibrate one aircraft with one IMU after each span (ascending), with the deck that `made` creates.

    Errors (spans, 6) are against the mean bias of the next minutes: rad/s, m/s^2, vehicle FRD.
    """
    random = np.random.default_rng([seed, 51])
    pitch, roll = random.normal(size=2) * 2.0
    pose = Pose(float(pitch), float(roll), float(random.uniform(0.0, 360.0)))
    anomaly = float(np.random.default_rng([seed, 52]).normal()) * GRAVITY_ANOMALY_M_S2
    site = AnomalousSite(**dataclasses.asdict(site_at(voyage.latitude_deg, 10.0, 100.0)), anomaly_m_s2=anomaly)
    aircraft = VirtualAircraft(pose, site, motions=voyage.motions(seed))
    axes = random.normal(size=6) * voyage.gyro_axes_sigma
    imu = ImuModel(
        aircraft,
        voyage.part,
        seed=int(random.integers(2**62)),
        gyro_bias_rad_s=(random.normal(size=3) * voyage.gyro_bias_rad_s).tolist(),
        accel_bias_m_s2=(random.normal(size=3) * ACCEL_BIAS_M_S2).tolist(),
        gyro_scale=axes[:3].tolist(),
        gyro_misalignment_rad=axes[3:].tolist(),
    )
    tilt = GradienterModel("axis", np.eye(3), (0.0, 0.0), TILT_SIGMA_DEG, LAG_S)
    compass = CompassModel(
        magnetic=True, vehicle_from_sensor=np.eye(3), offset_deg=0.0, sigma_deg=voyage.compass_sigma_deg
    )
    deck = made(tilt, compass)
    taken = ImuInput(
        name="imu", rotation=np.eye(3), profile=noise_profile(voyage.part if voyage.part in PROFILES else "icm42688p")
    )
    deck.set_imu(taken)
    feed(deck, imu, spans_s[-1] + 1, random, voyage.compass_sigma_deg)
    errors, sigmas = [], []
    for span in spans_s:
        found = deck.work(range(1, 1 + span)).run()
        if isinstance(found, CalibrationRefusedError):
            raise found
        error, sigma = _against_the_truth(found[0], imu, tilt, compass)
        errors.append(error)
        sigmas.append(sigma)
    return Errors(np.array(errors), np.array(sigmas))


def feed(deck: Deck, imu: ImuModel, seconds: int, random: np.random.Generator, compass_sigma_deg: float) -> None:
    """Give a deck so many seconds of readings of an IMU, a gradienter and a compass."""
    headings, tilts = _headings(imu.aircraft, seconds, random, compass_sigma_deg), _tilts(imu.aircraft, seconds, random)
    for first in range(0, seconds, _CHUNK_S):
        count = min(_CHUNK_S, seconds - first)
        times = first + (np.arange(count * RATE_HZ) + 0.5) / RATE_HZ
        rows = imu.read(times, 1.0 / RATE_HZ)
        for slot in range(first, first + count):
            here = slice((slot - first) * RATE_HZ, (slot - first + 1) * RATE_HZ)
            deck.take_imu("imu", summary(slot, times[here], rows[here]), times[here], rows[here])
            at = slot + np.arange(TILT_HZ) / TILT_HZ
            seen = tilts[slot * TILT_HZ : (slot + 1) * TILT_HZ]
            deck.take_tilt(summary(slot, at, seen), at, seen)
            at = slot + np.arange(HEADING_HZ) / HEADING_HZ
            turned = unrolled(headings[slot * HEADING_HZ : (slot + 1) * HEADING_HZ, None])
            deck.take_heading(summary(slot, at, turned, circle=True), at, turned)


def _headings(aircraft: VirtualAircraft, seconds: int, random: np.random.Generator, sigma_deg: float) -> Array:
    """Magnetic headings, degrees: half of the error's variance is constant, half depends on the heading (iron)."""
    times = np.arange(seconds * HEADING_HZ) / HEADING_HZ
    true = aircraft.angles_over(times)[:, 2]
    constant, sine, cosine = random.normal(size=3) * sigma_deg * math.sqrt(0.5)
    error = constant + sine * np.sin(true) + cosine * np.cos(true)
    noise = random.normal(size=len(times)) * COMPASS_NOISE_DEG
    shown: Array = np.round(np.degrees(true) - aircraft.site.declination_deg + error + noise, 1) % 360.0
    return shown


def _tilts(aircraft: VirtualAircraft, seconds: int, random: np.random.Generator) -> Array:
    """Readings of the fluid, degrees, by the law of `Gradienter`, for all times at once."""
    step_s, each = 0.01, round(100 / TILT_HZ)
    times = np.arange(-10.0, seconds, step_s)
    felt = np.concatenate(
        [Gradienter(aircraft).tilt_deg(part) for part in np.array_split(times, len(times) // 2000 + 1)]
    )
    keep = math.exp(-step_s / LAG_S)
    x, y = felt[0].tolist()
    shown = []
    for felt_x, felt_y in felt.tolist():
        x, y = felt_x + keep * (x - felt_x), felt_y + keep * (y - felt_y)
        shown.append((x, y))
    zero = random.normal(size=2) * TILT_SIGMA_DEG
    found = np.array(shown[round(10.0 / step_s) :: each])
    return np.asarray(np.round(found + zero + random.normal(size=found.shape) * TILT_NOISE_DEG, 3))


def _against_the_truth(
    window: Window, imu: ImuModel, tilt: GradienterModel, compass: CompassModel
) -> tuple[Array, Array]:
    solution = solve(window, local(imu.aircraft.site), tilt, compass, What.BOTH, "deck")
    found = solution.imus[0]
    assert found.gyro_rad_s is not None
    assert found.accel_m_s2 is not None
    truth = imu.mean_bias(window.end_s, window.end_s + NEXT_S)
    error = np.concatenate([found.gyro_rad_s - truth.gyro_rad_s, found.accel_m_s2 - truth.accel_m_s2])
    return error, np.concatenate([found.gyro_sigma_use_rad_s, found.accel_sigma_use_m_s2])


# The table.

SPANS_S: Final = (120, 600)
STILL_S: Final = (60, 120)
STILL: Final = Voyage(waves=(), turn_deg_s=0.0)
_TRIADS: Final = (
    ("gyros, deg/h", DEG_H, slice(0, 3)),
    ("horizontal accelerometers, mg", MG, slice(3, 5)),
    ("vertical accelerometer, mg", MG, slice(5, 6)),
)
MOST: Final = {("gyros, deg/h", 120): 40.0, ("gyros, deg/h", 600): 10.0,
               ("horizontal accelerometers, mg", 120): 1.0, ("horizontal accelerometers, mg", 600): 0.4}  # fmt: skip


def section(voyages: int, stands: int, seed: int, jobs: int) -> Section:
    """Make the table of calibrations on a deck, and its claims."""
    sea = many(sail, [(Voyage(), SPANS_S, 10_000 * seed + number) for number in range(voyages)], jobs)
    still = many(sail, [(STILL, STILL_S, 10_000 * seed + 5_000 + number) for number in range(stands)], jobs)
    lines = [
        "rms error against the mean bias of the next 180 s",
        "",
        f"{'rms':>51}{'+-':>6}{'sigma':>8}{'2 sigma covers':>16}",
    ]
    claims: list[Claim] = []
    for index, span in enumerate(SPANS_S):
        lines += _rows(f"sea, {span} s", sea, index)
        twice = covered(stack(sea, "error")[:, index], stack(sea, "sigma")[:, index], 2.0)
        claims.append(Claim(f"deck, {span} s: 2 sigma covers", "%", twice.times(100.0), 98.0, 93.0))
        for name, unit, part in _TRIADS[:2]:
            found = rms(stack(sea, "error")[:, index, part] / unit)
            claims.append(Claim(f"deck, {span} s: {name}", "", found, MOST[name, span], 0.0))
    for index, span in enumerate(STILL_S):
        lines += _rows(f"still, {span} s", still, index)
        share = _over_the_ground(still, index, span)
        claims.append(Claim(f"still ground, {span} s: gyro sigma over that at rest", "", share, 1.5, 0.0))
    return Section(f"On a deck ({voyages} voyages, {stands} stands)", lines, claims)


def _rows(title: str, runs: list[Errors], index: int) -> list[str]:
    lines = []
    errors, sigmas = stack(runs, "error")[:, index], stack(runs, "sigma")[:, index]
    for name, unit, part in _TRIADS:
        error, sigma = errors[:, part], sigmas[:, part]
        found, twice = rms(error / unit), covered(error, sigma, 2.0)
        size = float(np.sqrt(np.square(sigma).mean())) / unit
        digits = 1 if unit == DEG_H else 3
        lines.append(
            f"{title:13}{name:30}{found.value:8.{digits}f}{found.error:6.{digits}f}"
            f"{size:8.{digits}f}{100.0 * twice.value:12.1f} %"
        )
    return lines


def _over_the_ground(runs: list[Errors], index: int, span_s: int) -> Figure:
    """Ratio of the gyros' sigma on deck to the sigma of a mean of the same length on the ground, V(T, H)."""
    model = PROFILES[STILL.part].gyro
    at_rest = math.sqrt(model.white**2 / span_s + float(floor_variance(model.flicker, model.walk, span_s, NEXT_S)))
    return rms(stack(runs, "sigma")[:, index, :3] / at_rest)

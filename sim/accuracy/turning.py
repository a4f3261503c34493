"""Calibrations on a platform that turns slowly, from the start or after a rest: share of wrong results.

An aircraft stands on a platform that turns about the vertical. Its readings go second by second into the flying
collector; whenever a calibration is possible, it is computed. A wrong result is one whose error
exceeds three times its stated sigma.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Final, Literal

import numpy as np

from companion.config.sections import NoiseProfile
from companion.estimation.collector.intake import Settings
from companion.estimation.collector.rolling import RollingCollector
from companion.estimation.machine import What
from companion.estimation.means.pose import CompassModel, GradienterModel
from companion.estimation.means.windows import ImuInput
from companion.estimation.noise.allan import allan_model, noise_profile
from companion.estimation.solution.solve import solve
from companion.physics.units import DEG_H, MG
from companion.samples import CompassSample, ImuSample, TiltSample
from sim.accuracy.experiments import many
from sim.accuracy.figures import Claim, Figure, Section
from sim.accuracy.stand import local
from sim.aircraft import Pose, VirtualAircraft
from sim.devices import Gradienter
from sim.earth import STANDARD_GRAVITY_M_S2, Array
from sim.imu_model import PARTS, AxisNoise, ImuModel, ImuSpec
from sim.motions import SlowTurn
from sim.scenario import site_at

RATES_DEG_S: Final = (0.0, 0.01, 0.02, 0.05, 0.15, 0.4, 1.0, 2.0)
REST_S: Final = 40.0
TURNS_S: Final = 80.0
"""Time for which the stand is observed from the start of the turn on."""
SIGMAS: Final = 3.0
FALSE_PERCENT: Final = 0.5
NEXT_S: Final = 180.0
IMU_HZ: Final = 20
TILT_HZ: Final = 10.0
COMPASS_HZ: Final = 8.0
SOONEST_S: Final = 10
LOOK_S: Final = 2
Begins = Literal["at the start", "after rest"]
_UG: Final = STANDARD_GRAVITY_M_S2 * 1e-6

VN100: Final = ImuSpec(
    name="vn100",
    gyro=AxisNoise(white=8.9 * DEG_H, flicker=7.0 / 0.664 * DEG_H, walk=7.0 * math.sqrt(3e-3) * DEG_H),
    accel=AxisNoise(white=99 * _UG, flicker=40 / 0.664 * _UG, walk=40 * math.sqrt(3e-3) * _UG),
)
"""Noise of VectorNav's data sheet: 0.0035 deg/s/sqrt(Hz), 5 to 7 deg/h; 140 ug/sqrt(Hz), 40 ug."""
SPECS: Final = {"vn100": VN100, **{name: PARTS[name] for name in ("icm42688p", "bmi088", "adis16405")}}


COMPASSES: Final = {"0.5 deg": (0.5, 0.0), "steps of 0.1": (0.05, 0.1), "steps of 1": (0.2, 1.0), "none": None}
"""Noise and resolution of each compass, in degrees; None: no compass."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TurningCase:
    part: str
    learned: bool
    """True: the IMU has its own part's noise profile. False: the profile of an unknown part."""
    compass: str
    rate_deg_s: float
    begins: Begins
    seed: int


@dataclass(frozen=True, slots=True)
class Found:
    looks: int
    """Number of times at which a calibration was possible early enough."""
    refused: int
    """Number of these times at which the calibration was refused."""
    named: int
    """Number of refusals whose text named a turn."""
    worst: float
    """Largest ratio of gyro error to stated sigma; the error is against the true bias in the window."""
    largest_deg_h: float
    """Largest gyro error against the true bias in the window."""


def _profile(case: TurningCase) -> NoiseProfile:
    if not case.learned:
        return noise_profile(None)
    if case.part == "vn100":
        return NoiseProfile("vn100", allan_model(8.9 * DEG_H, 7.0 * DEG_H), allan_model(99 * 1e-3 * MG, 40 * 1e-3 * MG))
    return noise_profile(case.part)


class Platform:
    """One stand, its collector, and the result so far."""

    def __init__(self, case: TurningCase) -> None:
        self.random = random = np.random.default_rng([case.seed, 31])
        site = site_at(45.0, 10.0, 100.0)
        tilt = random.normal(size=2) * 2.0
        self.aircraft = VirtualAircraft(Pose(float(tilt[0]), float(tilt[1]), float(random.uniform(0.0, 360.0))), site)
        rest_s = 0.0 if case.begins == "at the start" else REST_S
        self.end_s = rest_s + TURNS_S
        if case.rate_deg_s:
            rate = float(random.choice([-1.0, 1.0])) * case.rate_deg_s
            start_s = rest_s - 1.0 if rest_s else -10.0
            self.aircraft.add(SlowTurn(start_s=start_s, duration_s=self.end_s + 20.0, rate_deg_s=rate))
        self.imu = ImuModel(
            self.aircraft,
            SPECS[case.part],
            seed=int(random.integers(2**62)),
            gyro_bias_rad_s=(random.normal(size=3) * 100.0 * DEG_H).tolist(),
            accel_bias_m_s2=(random.normal(size=3) * 2.0 * MG).tolist(),
        )
        self.compass = COMPASSES[case.compass]
        self.local = local(site)
        self.level = GradienterModel("axis", np.eye(3), (0.0, 0.0), 0.01)
        self.model = CompassModel(magnetic=True, vehicle_from_sensor=np.eye(3), offset_deg=0.0, sigma_deg=1.0)
        wanted = Settings(
            min_still_s=10.0,
            max_s=60.0,
            target_gyro_sigma_rad_s=5.0 * DEG_H,
            target_accel_sigma_m_s2=0.2 * MG,
            horizon_s=NEXT_S,
        )
        taken = ImuInput(name="fc", rotation=np.eye(3), profile=_profile(case))
        self.collector = RollingCollector(wanted, [taken], self.level, self.model if self.compass is not None else None)

    def errors(self, now_s: float) -> tuple[Array, Array]:
        """Calibrate now; return the gyro errors against the true bias in the window, and the stated sigma_use."""
        window = self.collector.window(now_s)
        solution = solve(window, self.local, self.level, self.model if self.compass else None, What.BOTH)
        (found,) = solution.imus
        assert found.gyro_rad_s is not None
        then = self.imu.mean_bias(window.start_s, window.end_s).gyro_rad_s
        return found.gyro_rad_s - then, found.gyro_sigma_use_rad_s

    def samples(self) -> list[tuple[float, Callable[[], object]]]:
        """Return all samples, sorted by time, each with the call that delivers it to the collector."""
        collector, random, end_s = self.collector, self.random, self.end_s
        found: list[tuple[float, Callable[[], object]]] = []
        times = (np.arange(round(end_s * IMU_HZ)) + 0.5) / IMU_HZ
        rows = self.imu.read(times, 1.0 / IMU_HZ)
        for t_s, (p, q, r, x, y, z) in zip(times.tolist(), rows.tolist(), strict=True):
            found.append((t_s, partial(collector.add_imu, "fc", ImuSample(t_s, (p, q, r), (x, y, z)))))
        times = np.arange(0.05, end_s, 1.0 / TILT_HZ)
        tilts = Gradienter(self.aircraft, law="axis").tilt_deg(times) + random.normal(size=(len(times), 2)) * 0.0005
        for t_s, (x, y) in zip(times.tolist(), np.round(tilts, 3).tolist(), strict=True):
            found.append((t_s, partial(collector.add_tilt, TiltSample(t_s, x, y))))
        if self.compass is not None:
            times = np.arange(0.03, end_s, 1.0 / COMPASS_HZ)
            angles = np.degrees(self.aircraft.angles_over(times)[:, 2])
            angles += random.standard_normal() - self.aircraft.site.declination_deg
            noise_deg, resolution_deg = self.compass
            angles += random.normal(size=len(times)) * noise_deg
            if resolution_deg:
                angles = np.round(angles / resolution_deg) * resolution_deg
            for t_s, angle in zip(times.tolist(), np.round(np.mod(angles, 360.0), 6).tolist(), strict=True):
                found.append((t_s, partial(collector.add_compass, CompassSample(t_s, angle))))
        return sorted(found, key=lambda one: one[0])


def run(case: TurningCase) -> Found:
    platform = Platform(case)
    collector, samples = platform.collector, platform.samples()[::-1]
    found: list[tuple[Array, Array]] = []
    looks = refused = named = 0
    for second in range(1, int(platform.end_s) + 1):
        while samples and samples[-1][0] < second:
            samples.pop()[1]()
        now_s = second + 0.3
        collector.tick(now_s)
        if second <= SOONEST_S or second % LOOK_S:
            continue
        looks += 1
        status = collector.status(now_s)
        if status.waiting_for is not None:
            refused += 1
            named += "the aircraft t" in status.waiting_for
        elif status.enough:
            found.append(platform.errors(now_s))
    if not found:
        return Found(looks, refused, named, 0.0, 0.0)
    errors, sigmas = (np.array(column) for column in zip(*found, strict=True))
    return Found(looks, refused, named, float(np.abs(errors / sigmas).max()), float(np.abs(errors).max()) / DEG_H)


def cases(rate_deg_s: float, seeds: int, first: int = 0) -> list[TurningCase]:
    """Return cases with one turn rate, alternating parts, profiles, compasses and beginnings."""
    begins: tuple[Begins, ...] = ("at the start", "after rest")
    kinds = [
        kind
        for kind in itertools.product(SPECS, (False, True), COMPASSES, begins)
        # Without a compass a turn from the start is seen by nobody.
        if rate_deg_s == 0.0 or kind[2] != "none" or kind[3] == "after rest"
    ]
    return [
        TurningCase(part=part, learned=learned, compass=compass, rate_deg_s=rate_deg_s, begins=begin, seed=first + k)
        for k, (part, learned, compass, begin) in enumerate(itertools.islice(itertools.cycle(kinds), seeds))
    ]


_HEAD: Final = """\
 turn                                in the  named,  above 3  worst,  largest error,
deg/s  compass       stands  looks   way, %       %   sigmas  sigmas  deg/h"""


def section(stands: int, seed: int, jobs: int) -> Section:
    """Make the table by turn rate, with and without a compass."""
    work = [(case,) for rate in RATES_DEG_S for case in cases(rate, stands, 1_000_000 * (seed - 1))]
    rows: dict[tuple[float, bool], list[Found]] = {}
    for (case,), one in zip(work, many(run, work, jobs), strict=True):
        rows.setdefault((case.rate_deg_s, case.compass == "none"), []).append(one)
    lines = _HEAD.splitlines()
    for (rate, blind), ones in sorted(rows.items()):
        looks = sum(one.looks for one in ones)
        shares = [
            100.0 * sum(counts) / looks for counts in zip(*((one.refused, one.named) for one in ones), strict=True)
        ]
        above = sum(one.worst > SIGMAS for one in ones)
        worst, largest = max(one.worst for one in ones), max(one.largest_deg_h for one in ones)
        words = "without" if blind else "with"
        lines.append(
            f"{rate:5g}  {words:13}{len(ones):7d}{looks:7d}{shares[0]:9.2f}{shares[1]:8.2f}"
            f"{above:9d}{worst:8.2f}{largest:9.0f}"
        )
    lines += [
        "",
        "Looks: every two seconds, could a calibration be written now? In the way: no, something was;",
        "named: it was said that the aircraft turns. Beside them the errors of what would have been",
        "written, against the window's bias.",
    ]
    still = [one for (rate, _), ones in rows.items() if rate == 0.0 for one in ones]
    falsely = 100.0 * sum(one.named for one in still) / sum(one.looks for one in still)
    worst = max(one.worst for ones in rows.values() for one in ones)
    claims = [
        Claim("turning: worst error that would have been written", "sigmas", Figure(worst, 0.0), SIGMAS),
        Claim("turning: still, and said to turn", "%", Figure(falsely, 0.0), FALSE_PERCENT),
    ]
    return Section(f"A ground that turns ({stands} stands of each rate)", lines, claims)

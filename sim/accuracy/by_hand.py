"""Accuracy for an aircraft that was never calibrated: turned about on sloping spots, propped up twelve times."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Final

import numpy as np

from companion.estimation.alignment.align import turned
from companion.estimation.alignment.align_model import Ground, PoseMeans
from companion.estimation.alignment.faces import Face, Sides, faces, mounting
from companion.estimation.collector.intake import Settings
from companion.estimation.collector.rolling import RollingCollector
from companion.estimation.means.windows import ImuInput, ImuWindow
from companion.estimation.noise.allan import noise_profile
from companion.estimation.seconds.counting import Counted, TurnCounter
from companion.samples import ImuSample
from sim.accuracy.figures import Claim, Figure, Section, covered, rms, stack
from sim.accuracy.stand import GRAVITY_ANOMALY_M_S2, NEXT_S, RATE_HZ, AnomalousSite, local, sites
from sim.aircraft import Pose, Site, VirtualAircraft
from sim.earth import Array
from sim.hands import Hands
from sim.imu_model import DEG_H, MG, ImuModel

_Move = Callable[[float], float]
BY_HAND: Final = ("icm42688p", "bmi088", "adis16470")
STAND_S, PROPPED_S = 12, 7  # Seconds in the means of a stand on a spot, and of one propped up
PLACEMENT_DEG: Final = 0.02
PROPPED_DEG: Final = 5.0
"""Sigma, about each axis, of the error with which a person props the aircraft up on a face."""
ARDUPILOT_READINGS: Final = 50
"""Number of readings that a level calibration of ArduPilot averages."""
SLOPE_DEG: Final = 3.0
"""Slope of the ground on which the aircraft is propped up."""
SLOPES_DEG: Final = (0.5, 1.0, 3.0, 5.0)
"""Slopes of the spots on which the aircraft is turned."""
TURNS: Final = tuple((headings, slope) for headings in (2, 4) for slope in SLOPES_DEG)
"""Simulated turns on a spot: number of headings, and slope of the spot in degrees."""
GYRO_SCALE, GYRO_SHEAR, STAMPS_S = 0.01, 0.005, 0.5e-3
"""Sigmas of scale and shear of the gyros that measure the turns; half the rounding of the gyros' time stamps."""
_FACES: Final = ((90, 0), (-90, 0), (0, -90), (0, 90), (0, 180), (0, 0))
"""Pitch and roll in degrees of the six faces, with this axis up: +x, -x, +y, -y, +z, -z."""
_EDGES: Final = ((45, 0), (-45, 0), (0, 45), (0, -135), (45, 90), (-45, 90))


@dataclass(frozen=True, slots=True, eq=False)
class HandRun:
    """Errors of one aircraft, and sigmas, in SI units; biases relative to their mean over the next three minutes."""

    faces: Array
    """Errors of the accelerometers' bias, scale and shear after the twelve stands (9,)."""
    faces_sigma: Array
    faces_checked: bool
    """True: no stand was rejected or in doubt."""
    turn: Array
    """Errors of the bias of the horizontal accelerometers, forward and right, after each turn (TURNS, 2)."""
    turn_sigma: Array
    slope: Array
    """Error of the estimated slope of each spot, in rad (TURNS,)."""
    level: Array
    """Errors of the board's roll and pitch, measured on the steepest spot (2,)."""
    level_sigma: Array
    level_firmware: Array
    """Errors (2,) of a firmware's level calibration on that spot, with biases and scales known exactly."""


@dataclass(frozen=True, slots=True, eq=False)
class _Stood:
    """Measurement of one stand, in which the aircraft is motionless."""

    start_s: float
    end_s: float
    window: ImuWindow
    rows: Array
    """Readings of the accelerometers (n, 3)."""

    def face(self) -> Face:
        return (np.array(self.window.accel_m_s2), np.array(self.window.accel_sigma_use_m_s2))

    def on_spot(self, turned: Counted, before: PoseMeans | None) -> PoseMeans:
        heading_rad = turned.angle_rad + (0.0 if before is None else before.heading_rad)
        is_turned, imus = before is not None, (self.window,)
        return PoseMeans(imus, None, (1.0, 1.0), heading_rad, turned.sigma_rad, on_spot=True, counted=is_turned)


class _Spot:
    """Measurements on one spot: five stands, each a quarter turn after the last, and all gyro readings."""

    def __init__(self) -> None:
        self.stood: list[_Stood] = []
        self.counter = TurnCounter()

    def chosen(self, headings: int) -> list[PoseMeans]:
        """Return the stands that `align turn` asks for: first heading, half a turn, first heading; or all quarters."""
        found: list[PoseMeans] = []
        counter = copy.deepcopy(self.counter)  # which lets go of what was before a stand
        chosen = self.stood[::2] if headings == 2 else self.stood
        for before, now in zip([None, *chosen], chosen, strict=False):
            turned: Counted | None = Counted(0.0, math.radians(0.01))
            if before is not None:
                bias = (np.array(before.window.gyro_rad_s) + np.array(now.window.gyro_rad_s)) / 2.0
                turned = counter.counted(before.end_s, now.start_s, bias, np.eye(3))
            assert turned is not None
            found.append(now.on_spot(turned, found[-1] if found else None))
        return found


class _Aircraft:
    """An aircraft whose autopilot was mounted by eye and never calibrated, a person who moves it, and a collector."""

    def __init__(self, part: str, seed: int, number: int) -> None:
        self.random = np.random.default_rng([seed, 6, BY_HAND.index(part), number])
        draw = self.random.normal
        self.site = sites()[number % len(sites())]
        here = AnomalousSite(**asdict(self.site), anomaly_m_s2=float(draw() * GRAVITY_ANOMALY_M_S2))
        self.gravity_m_s2 = here.gravity_m_s2
        self.scale, self.shear = draw(size=3) * 0.005, draw(size=3) * 0.003
        roll, pitch, yaw = (draw(size=3) * [1.0, 1.0, 2.0]).tolist()
        self.aircraft = VirtualAircraft(Pose(heading_deg=float(self.random.uniform(0.0, 360.0))), here)
        self.imu = ImuModel(
            self.aircraft,
            part,
            seed=int(self.random.integers(2**62)),
            gyro_bias_rad_s=(draw(size=3) * 100.0 * DEG_H).tolist(),
            gyro_scale=(draw(size=3) * GYRO_SCALE).tolist(),
            gyro_misalignment_rad=(draw(size=3) * GYRO_SHEAR).tolist(),
            gyro_shear=(draw(size=3) * GYRO_SHEAR).tolist(),
            accel_bias_m_s2=(draw(size=3) * 20.0 * MG).tolist(),
            accel_scale=self.scale.tolist(),
            accel_shear=self.shear.tolist(),
            mounting_deg=(roll, pitch, yaw),
        )
        self.hands = Hands(self.aircraft, placement_deg=PLACEMENT_DEG, seed=int(self.random.integers(2**31)))
        self.taken = ImuInput(name="imu", rotation=np.eye(3), profile=noise_profile(part))
        self.t_s = 0.0
        self._read_s = 0.0

    def _read(self, seconds: float, counter: TurnCounter | None) -> tuple[Array, Array]:
        """Read the next seconds, with time stamps in whole milliseconds."""
        times = self._read_s + (np.arange(round(seconds * RATE_HZ)) + 0.5) / RATE_HZ
        self._read_s += seconds
        rows = self.imu.read(times, 1.0 / RATE_HZ)
        if counter is not None:
            stamps = times + self.random.uniform(-STAMPS_S, STAMPS_S, len(times))
            for t_s, stamp_s, (p, q, r, *_) in zip(times.tolist(), stamps.tolist(), rows.tolist(), strict=True):
                counter.add(ImuSample(t_s, (p, q, r), (0.0, 0.0, 0.0), None, None, stamp_s))
        return times, rows

    def stand(self, move: _Move, counter: TurnCounter | None = None, seconds: int = STAND_S) -> _Stood:
        """Move the aircraft, then measure its stand."""
        begin_s = math.ceil(move(self.t_s) + 1.0)
        if counter is not None:
            self._read(begin_s + 0.5 - self._read_s, counter)
        self._read_s = begin_s + 0.5
        times, rows = self._read(seconds + 0.5, counter)
        wanted = Settings(
            min_still_s=float(seconds),
            max_s=float(seconds),
            target_gyro_sigma_rad_s=0.0,
            target_accel_sigma_m_s2=0.0,
            horizon_s=NEXT_S,
        )
        collector = RollingCollector(wanted, [self.taken])
        for t_s, (p, q, r, x, y, z) in zip(times.tolist(), rows.tolist(), strict=True):
            collector.add_imu("imu", ImuSample(t_s, (p, q, r), (x, y, z), None))
        self.t_s = begin_s + seconds + 1.3
        collector.tick(self.t_s)
        window = collector.window(self.t_s)
        return _Stood(window.start_s, window.end_s, window.imus[0], rows[:, 3:])

    def propped(self, pitch_deg: float, roll_deg: float) -> _Stood:
        """Prop the aircraft up by hand, on a slope in a random direction; measure its stand."""
        azimuth = self.random.uniform(0.0, 2.0 * math.pi)
        off = self.random.normal(size=2) * PROPPED_DEG + SLOPE_DEG * np.array([math.cos(azimuth), math.sin(azimuth)])
        pitch, roll = float(pitch_deg + off[0]), float(roll_deg + off[1])
        return self.stand(lambda t_s: self.hands.hold(t_s, pitch, roll), seconds=PROPPED_S)

    def on_spot(self, slope_deg: float) -> _Spot:
        """Measure stands after four quarter turns, back to the first heading, on a slope in a random direction."""
        azimuth = self.random.uniform(0.0, 2.0 * math.pi)
        pitch, roll = slope_deg * math.cos(azimuth), slope_deg * math.sin(azimuth)
        spot = _Spot()
        spot.stood.append(self.stand(lambda t_s: self.hands.spot(t_s, pitch, roll)))
        for _ in range(4):
            spot.stood.append(self.stand(lambda t_s: self.hands.turn(t_s, 90.0), spot.counter))
        return spot

    def level_reading(self, bias: Array) -> Array:
        """Return the accelerometers' reading in a horizontal aircraft, with the given biases."""
        level = VirtualAircraft(Pose(), self.aircraft.site)
        return self.imu.in_accel_axes(level.truth_at(0.0).force_m_s2) + bias


def _ground(site: Site) -> Ground:
    earth = local(site)
    rate, of_rate = earth.rate_in_body(np.eye(3), heading_known=False)
    return Ground(earth.gravity_m_s2, earth.gravity_sigma_m_s2, rate, of_rate)


def by_hand(part: str, seed: int, number: int) -> HandRun:
    here = _Aircraft(part, seed, number)
    spots = {slope: here.on_spot(slope) for slope in SLOPES_DEG}
    held = [here.propped(*pose) for pose in (*_FACES, *_EDGES)]
    bias = here.imu.mean_bias(here.t_s, here.t_s + NEXT_S).accel_m_s2
    earth, ground = local(here.site), _ground(here.site)
    known = faces([one.face() for one in held], earth.gravity_m_s2, earth.gravity_sigma_m_s2, wander_m_s2=_wander(held))
    truth = np.concatenate([bias, here.scale, here.shear])
    read = here.level_reading(bias)
    level_bias = read + np.array([0.0, 0.0, here.gravity_m_s2])
    turns = {(headings, slope): turned(spots[slope].chosen(headings), ground) for headings, slope in TURNS}
    steepest = turns[4, max(SLOPES_DEG)]
    board, true_board = (
        mounting(steepest.imus[0], Sides(known.figures, known.sigma, np.eye(3)), earth.gravity_m_s2),
        _tilt((read - bias) / (1.0 + here.scale)),
    )
    first = spots[max(SLOPES_DEG)].stood[0].rows[:ARDUPILOT_READINGS].mean(axis=0)
    return HandRun(
        faces=known.figures - truth,
        faces_sigma=known.sigma,
        faces_checked=not known.left_out and not known.in_doubt,
        turn=np.array([found.imus[0].level_bias_m_s2[:2] for found in turns.values()]) - level_bias[:2],
        turn_sigma=np.array([np.sqrt(np.diag(found.imus[0].level_covariance_m2_s4))[:2] for found in turns.values()]),
        slope=np.radians([found.slope_deg - slope for (_, slope), found in turns.items()]),
        level=np.array([board.roll_rad, board.pitch_rad]) - true_board,
        level_sigma=board.sigma_rad,
        level_firmware=_tilt((first - bias) / (1.0 + here.scale)) - true_board,
    )


def _wander(stands: list[_Stood]) -> Array:
    """Return the sigma (3,) of the change of the bias from a stand to the next minutes."""
    use, stat = (
        np.array([getattr(one.window, name) for one in stands])
        for name in ("accel_sigma_use_m_s2", "accel_sigma_stat_m_s2")
    )
    return np.asarray(np.sqrt(np.maximum(use**2 - stat**2, 0.0).mean(axis=0)))


def _tilt(force: Array) -> Array:
    """Return roll and pitch from corrected accelerometer readings."""
    x, y, z = force
    return np.array([math.atan2(-y, -z), math.atan2(x, math.hypot(y, z))])


# The tables.

_DEGREE: Final = float(np.radians(1.0))
_BIAS: Final = slice(0, 3)
_SCALE: Final = slice(3, 6)
TURN_MG: Final = 0.25
BIAS_MG: Final = 0.15
SCALE_PERCENT: Final = 0.02
LEVEL_DEG: Final = 0.03
COVERS: Final = (93.0, 98.0)


def section(runs: list[HandRun], each: int) -> Section:
    parts = {part: runs[each * k : each * (k + 1)] for k, part in enumerate(BY_HAND)}
    lines: list[str] = []
    claims: list[Claim] = []
    for make in (_turns, _six_sides, _level):
        lines += [*make(parts, claims), ""]
    lines += [
        f"{STAND_S} s each; turned on marks met to {PLACEMENT_DEG:g} deg, gyros of 1 %, 0.5 % from square;",
        f"propped up for {PROPPED_S} s within {PROPPED_DEG:g} deg on ground that slopes by {SLOPE_DEG:g}.",
        "Biases against their mean over the next 3 min.",
        "New boards: bias 20 mg, scale 0.5 %, shear 0.3 %, put in within 1 deg, gravity 30 mGal off.",
    ]
    return Section(f"By hand, without a gradienter ({each} aircraft of each part)", lines, claims)


def _covers(words: str, errors: Array, sigmas: Array, claims: list[Claim]) -> Figure:
    found = covered(errors, sigmas, 2.0).times(100.0)
    claims.append(Claim(f"{words}: 2 sigma cover", "%", found, COVERS[1], COVERS[0]))
    return found


def _turns(parts: dict[str, list[HandRun]], claims: list[Claim]) -> list[str]:
    lines = [
        "headings: horizontal bias when level, rms mg, mean sigma, 2 sigma cover; slope, rms deg",
        "",
        f"{'on a slope of':14}" + "".join(f"{part:>27}" for part in parts),
    ]
    for row, (headings, slope) in enumerate(TURNS):
        line = f"{headings} on {slope:3.1f} deg "
        for part, runs in parts.items():
            error, sigma = stack(runs, "turn")[:, row], stack(runs, "turn_sigma")[:, row]
            found = rms(error).times(1.0 / MG)
            mean = float(sigma.mean()) / MG
            share = covered(error, sigma, 2.0).times(100.0)
            off = rms(stack(runs, "slope")[:, row]).times(1.0 / _DEGREE)
            line += f"{found.value:8.3f}{mean:6.3f}{share.value:5.0f} %{off.value:6.3f}"
            claims.append(Claim(f"turn, {part}, {headings} on {slope:g} deg: rms", "mg", found, TURN_MG))
        lines.append(line)
    every = [run for runs in parts.values() for run in runs]
    for headings in (2, 4):
        rows = [row for row, turn in enumerate(TURNS) if turn[0] == headings]
        error, sigma = (stack(every, name)[:, rows] for name in ("turn", "turn_sigma"))
        _covers(f"turn, {headings} headings", error, sigma, claims)
    return lines


def _six_sides(parts: dict[str, list[HandRun]], claims: list[Claim]) -> list[str]:
    lines = [
        "twelve stands: bias, rms mg, and scale, rms %",
        "",
        f"{'':12}{'companion':>15}{'sigma':>15}{'2 sigma':>8}",
    ]
    for part, runs in parts.items():
        errors, sigma = stack(runs, "faces"), stack(runs, "faces_sigma")
        bias, scale = rms(errors[:, _BIAS]).times(1.0 / MG), rms(errors[:, _SCALE]).times(100.0)
        line = f"{part:12}{bias.value:8.3f}{scale.value:7.4f}"
        claims.append(Claim(f"faces, {part}: bias, rms", "mg", bias, BIAS_MG))
        claims.append(Claim(f"faces, {part}: scale, rms", "%", scale, SCALE_PERCENT))
        share = _covers(f"faces, {part}", errors, sigma, claims)
        checked = Figure(100.0 * float(stack(runs, "faces_checked").mean()), 0.0)
        line += f"{sigma[:, _BIAS].mean() / MG:8.3f}{100.0 * sigma[:, _SCALE].mean():7.4f}{share.value:6.0f} %"
        claims.append(Claim(f"faces, {part}: no good stand blamed", "%", checked, 100.0, 98.0))
        lines.append(line)
    return lines


def _level(parts: dict[str, list[HandRun]], claims: list[Claim]) -> list[str]:
    lines = [
        "the board against the base, on 5 deg of slope: rms deg, 2 sigma cover; a firmware's own level there",
        "",
    ]
    for part, runs in parts.items():
        error, sigma = stack(runs, "level"), stack(runs, "level_sigma")
        found, theirs = (rms(one).times(1.0 / _DEGREE) for one in (error, stack(runs, "level_firmware")))
        claims.append(Claim(f"level, {part}: rms", "deg", found, LEVEL_DEG))
        share = _covers(f"level, {part}", error, sigma, claims)
        lines.append(f"{part:12}{found.value:8.4f}{share.value:7.0f} %{theirs.value:8.2f}")
    return lines

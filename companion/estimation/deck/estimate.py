"""Estimate of a window on a deck, in the same type `Window` as on the ground, so that later steps need no distinction.

The means of an IMU are converted to those of an IMU at rest: at the gradienter's mean tilt, with the Earth's rate only.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from companion.config.sections import AllanModel
from companion.errors import CalibrationRefusedError
from companion.estimation.deck.smoother import Believed, Found, IntegratedSecond, smooth
from companion.estimation.deck.waves import Level, compare
from companion.estimation.means.pose import CompassModel, GradienterModel, HeadingWindow, TiltWindow
from companion.estimation.means.warming import drifting
from companion.estimation.means.windows import ImuInput, ImuWindow, Window
from companion.estimation.noise.allan import floor_variance, slope_variance
from companion.estimation.seconds.batch import Batch
from companion.physics.frames import Array, Floats, Matrix, body_from_ned, vector
from companion.physics.gradienter import up_jacobian
from companion.physics.units import DEG, MG

MIN_S: Final = 60
"""Shortest window on a deck, s. Some waves last as long, so a shorter window is never enough."""
MIN_LOOK_S: Final = 40
"""Shortest window to verify a write, s. A short window has a larger sigma, which the result states."""
MAX_S: Final = 1200
SCALE_SIGMA: Final = 0.003
"""Sigma of scale and cross-axis errors of common gyros (at most 0.5 %): this share of a turn rate looks like a bias."""
COMPASS_SHARE: Final = math.sqrt(0.5)
"""Share of a compass' sigma that changes with the heading; the rest is the same on all headings."""
FROZEN_S: Final = 20
"""Time, s, for which a sensor must repeat one reading, while the aircraft sways, to count as faulty."""
_SWAYS_RAD_S: Final = 0.3 * DEG  # Least scatter of the rates of roll and pitch in that time
_SAME: Final = 1e-9
_SPREAD: Final = 1.5
"""Least standard deviation of readings, in integer steps, at which swaying averages out the rounding to integers."""
_UNKNOWN_ACCEL_M_S2: Final = 50.0 * MG
_LEAST_ACCEL_M_S2: Final = 0.1 * MG
"""Prior sigma of an accelerometer bias measured with a gradienter; `solve` adds the sigma of the gradienter's zero."""
_MIDDLE: Final = 0.37  # Share of K^2 T that a slope through the window misses
_FLICKER_TO_COME: Final = 0.75
"""Variance of the next minutes' flicker that past flicker does not predict, in multiples of B^2. Flicker's part of
V(T, H) is this plus the flicker in the window, a random walk of B / sqrt(T) (method.md section 2.2)."""
_GRAVITY_M_S2: Final = 9.8


TriadVariances = tuple[float, float]
"""Largest variance among the axes of a triad, and the white-noise part of it, which longer averaging reduces."""


DeckFound = tuple[Window, Sequence[TriadVariances]]
"""Estimate of a window on a deck: the window, and for each IMU the variances of gyros and of accelerometers."""
ImuSecond = tuple[Batch, IntegratedSecond]
"""One second of one IMU: its batch, in the sensor's axes, and its integrated motion, in the vehicle's axes."""


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DeckWindow:
    """Readings of one window on a deck; `run` estimates from them."""

    imus: Sequence[ImuInput]
    seconds: Sequence[Sequence[ImuSecond]]
    levels: Sequence[Mapping[int, Level]]
    headings: Mapping[int, float]
    slots: Sequence[int]  # Seconds of the window, ascending
    gradienter: GradienterModel | None
    compass: CompassModel | None
    horizon_s: float
    reference_deg: tuple[float, float] | None
    """Tilt, as gradienter readings, to which accelerometer means are converted; None: mean tilt of the window."""

    def run(self) -> DeckFound | CalibrationRefusedError:
        """Compute the estimate; ten minutes of one IMU take a third of a second on a desktop."""
        try:
            return self._run()
        except (CalibrationRefusedError, np.linalg.LinAlgError) as error:
            return CalibrationRefusedError(str(error))

    def _run(self) -> DeckFound:
        readings = {slot: level.reading for levels in self.levels[:1] for slot, level in levels.items()}
        frozen = self._frozen("gradienter", readings)
        all_levels = [[one for slot, one in levels.items() if slot not in frozen] for levels in self.levels]
        frozen = self._frozen("compass", {slot: np.array([heading]) for slot, heading in self.headings.items()})
        headings = np.array([math.nan if slot in frozen else self.headings.get(slot, math.nan) for slot in self.slots])
        reference = self.reference_deg
        if self.gradienter is not None:
            if any(len(levels) < MIN_LOOK_S // 2 for levels in all_levels):
                raise CalibrationRefusedError(f"no reading from gradienter in {len(self.slots)} s")
            if reference is None:
                x, y = np.mean([one.reading for one in all_levels[0]], axis=0).tolist()
                reference = (x, y)
        found = [
            self._imu(imu, seconds, levels, headings, reference)
            for imu, seconds, levels in zip(self.imus, self.seconds, all_levels, strict=True)
        ]
        last = found[0][2]
        window = Window(
            start_s=float(self.slots[0]),
            end_s=self.slots[-1] + 1.0,
            imus=tuple(window for window, _, _ in found),
            tilt=None
            if reference is None
            else TiltWindow(
                x_deg=reference[0], y_deg=reference[1], x_sigma_deg=0.0, y_sigma_deg=0.0, temperature_degc=None
            ),
            heading=None if self.compass is None else self._heading(last, self.compass),
            turn_rad_s=vector(last.turn_rad_s),
        )
        return window, [known for _, triads, _ in found for known in triads]

    def _frozen(self, name: str, readings: Mapping[int, Floats]) -> set[int]:
        """Return the seconds in which a sensor repeated one reading while the aircraft swayed.

        Raises:
            CalibrationRefusedError: the sensor repeats one reading until the end of the window.
        """
        if not readings:
            return set()
        slots, values = np.array(list(readings)), np.array(list(readings.values()))
        changes = np.abs(np.diff(values, axis=0)).max(axis=1) > _SAME
        rates = {batch.slot: batch.mean[:3] @ self.imus[0].rotation.T for batch, _ in self.seconds[0]}
        found: set[int] = set()
        for run in np.split(slots, np.flatnonzero(changes) + 1):
            swayed = [rates[slot][:2] for slot in run if slot in rates]
            if len(run) < FROZEN_S or not swayed or np.std(swayed, axis=0).max() < _SWAYS_RAD_S:
                continue
            if run[-1] >= self.slots[-1] - 1:
                raise CalibrationRefusedError(f"{name} is stuck: the same for {len(run)} s while it sways")
            found.update(run.tolist())
        return found

    def _imu(
        self,
        imu: ImuInput,
        seconds: Sequence[ImuSecond],
        levels: Sequence[Level],
        headings: Floats,
        reference: tuple[float, float] | None,
    ) -> tuple[ImuWindow, tuple[TriadVariances, TriadVariances], Found]:
        gradienter = self.gradienter
        span_s = float(len(seconds))
        compared = None if gradienter is None else compare(levels)
        believed = self._believed(imu, seconds, reference, compared)
        forward = np.array([1.0, 0.0, 0.0]) if self.compass is None else self.compass.vehicle_from_sensor[:, 0]
        found = smooth([passage for _, passage in seconds], headings, forward, believed)
        direction, own = _felt(found, gradienter, reference, compared)
        gyro_own = found.gyro_covariance
        mean_rate = np.linalg.norm(found.turn_rad_s)
        steps = _hidden_steps(imu, [batch for batch, _ in seconds])
        going_on = np.square(found.ramp_rad_s2 * self.horizon_s / 2.0) / 3.0
        gyro, accel = imu.profile.gyro, imu.profile.accel
        to_come = _FLICKER_TO_COME * gyro.flicker**2 + gyro.walk**2 * self.horizon_s / 3.0
        # The smoother follows a random walk, but not flicker: never claim more than a mean at rest.
        at_rest = float(floor_variance(gyro.flicker, gyro.walk, span_s, self.horizon_s))
        gyro_floor = np.maximum(to_come, at_rest - np.diag(gyro_own))
        gyro_floor = gyro_floor + steps[:3] + going_on + (SCALE_SIGMA * mean_rate) ** 2
        accel_floor = steps[3:] + float(floor_variance(accel.flicker, accel.walk, span_s, self.horizon_s))
        covariance = np.zeros((6, 6))
        covariance[:3, :3] = gyro_own + np.diag(gyro_floor)
        covariance[3:, 3:] = own + np.diag(accel_floor)
        use = np.sqrt(np.diag(covariance))
        heading_rad = math.atan2(found.body_to_ned[-1, 1, 0], found.body_to_ned[-1, 0, 0])
        temperatures = [batch.temperature_degc for batch, _ in seconds if batch.temperature_degc is not None]
        window = ImuWindow(
            name=imu.name,
            samples=sum(batch.n for batch, _ in seconds),
            duration_s=span_s,
            gyro_rad_s=vector(found.gyro_rad_s),
            accel_m_s2=vector(direction),
            gyro_sigma_stat_rad_s=vector(np.sqrt(np.diag(gyro_own))),
            accel_sigma_stat_m_s2=vector(np.sqrt(np.diag(own))),
            gyro_sigma_use_rad_s=vector(use[:3]),
            accel_sigma_use_m_s2=vector(use[3:]),
            temperature_degc=float(np.mean(temperatures)) if temperatures else None,
            warnings=(),
            drifting=drifting(imu.name, np.append(found.ramp_rad_s2, np.zeros(3)), temperatures),
            named=imu.profile.is_named,
            covariance=covariance,
            # Columns in level axes: along the heading, to the right of it, and down.
            by_earth=found.by_earth @ body_from_ned(0.0, 0.0, heading_rad).T,
        )
        # A slope weighs the middle most and misses part of a walking bias: averaging does not reduce that.
        walked = _MIDDLE * followed_walk(gyro, span_s) ** 2 * span_s
        gyros = float(use[:3].max() ** 2), max(float(np.diag(gyro_own).max()) - walked, 0.0)
        return window, (gyros, (float(use[3:].max() ** 2), float(np.diag(own).max()))), found

    def _believed(
        self,
        imu: ImuInput,
        seconds: Sequence[ImuSecond],
        reference: tuple[float, float] | None,
        compared: tuple[Array, Matrix] | None,
    ) -> Believed:
        gradienter, compass = self.gradienter, self.compass
        accel, accel_sigma = np.zeros(3), _UNKNOWN_ACCEL_M_S2
        if gradienter is not None and compared is not None and reference is not None:
            off = np.array(reference) - compared[0]
            accel = _GRAVITY_M_S2 * (gradienter.up(*off.tolist()) - gradienter.up(*reference))
            accel_sigma = _LEAST_ACCEL_M_S2
        model = imu.profile.gyro
        white = model.white
        if not imu.profile.is_named:
            white = max(white, math.sqrt(float(np.mean([passage.white2 for _, passage in seconds]))))
        slope = slope_variance(np.array(model.flicker), np.array(model.walk), float(len(seconds)))
        return Believed(
            accel_m_s2=accel,
            accel_sigma_m_s2=accel_sigma,
            compass_sigma_rad=0.0 if compass is None else compass.sigma_deg * COMPASS_SHARE * DEG,
            gyro_white=white,
            gyro_walk=followed_walk(model, float(len(seconds))),
            gyro_slope=math.sqrt(float(slope)),
            compass_lag_s=0.0 if compass is None else compass.lag_s,
            accel_white=imu.profile.accel.white,
        )

    def _heading(self, found: Found, compass: CompassModel) -> HeadingWindow | None:
        if not self.headings:
            return None
        pointing = found.body_to_ned[-1] @ compass.vehicle_from_sensor[:, 0]
        return HeadingWindow(
            heading_deg=math.atan2(pointing[1], pointing[0]) / DEG % 360.0, sigma_deg=found.heading_sigma_rad / DEG
        )


def followed_walk(gyro: AllanModel, span_s: float) -> float:
    """Return K, rad/s / sqrt(s), of a random walk that changes in `span_s` seconds as much as this gyro's bias does."""
    return math.hypot(gyro.walk, gyro.flicker / math.sqrt(span_s))


def _felt(
    found: Found,
    gradienter: GradienterModel | None,
    reference: tuple[float, float] | None,
    compared: tuple[Array, Matrix] | None,
) -> tuple[Array, Matrix]:
    """Return the accelerometers' mean (3,) as if at rest with the tilt `reference`, and its covariance (3, 3)."""
    size = found.force_m_s2
    if gradienter is None or reference is None or compared is None:
        up = -found.body_to_ned[:, 2].mean(axis=0)
        up /= np.linalg.norm(up)
        return size * up, np.outer(up, up) * found.force_sigma_m_s2**2
    x, y = (np.array(reference) - compared[0]).tolist()
    right, up = gradienter.up(*reference), gradienter.up(x, y)
    by_reading = size * DEG * gradienter.vehicle_from_sensor @ up_jacobian(gradienter.law, x, y)
    covariance = by_reading @ compared[1] @ by_reading.T
    return size * up / float(up @ right), covariance + np.outer(right, right) * found.force_sigma_m_s2**2


def _hidden_steps(imu: ImuInput, batches: Sequence[Batch]) -> Array:
    """Return the variance (6,), vehicle axes, of rounding that swaying leaves, plus mean `Batch.shared_variance`."""
    steps = np.repeat([imu.gyro_step_rad_s, imu.accel_step_m_s2], 3)
    means = np.array([batch.mean for batch in batches])
    spread = np.sqrt(means.var(axis=0) + np.mean([batch.variance for batch in batches], axis=0))
    hidden = np.where(spread < _SPREAD * steps, np.square(steps / 2.0), 0.0)
    hidden = hidden + np.mean([batch.shared_variance for batch in batches], axis=0)
    turn = np.square(imu.rotation)
    return np.concatenate([turn @ hidden[:3], turn @ hidden[3:]])

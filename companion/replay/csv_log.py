"""Somebody's own log of an IMU at rest, as comma separated values, through the estimator.

The mounting turns the sensor's axes into the vehicle's (x forward, y right, z down).
"""

from __future__ import annotations

import datetime
import math
from collections.abc import Iterable
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
from companion.calibration.solution.site import Remedies, Whereabouts
from companion.calibration.solution.solve import solve_at
from companion.config.sections import Mounting, Noise
from companion.errors import CalibrationRefusedError
from companion.physics.frames import rotation_matrix
from companion.samples import ImuSample

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
        StorageError: as `csv_columns.read`, where the samples are its.
    """
    settings = Settings(
        min_still_s=MIN_STILL_S, max_s=MAX_STILL_S, target_gyro_sigma_rad_s=0.0, target_accel_sigma_m_s2=0.0
    )
    imu = ImuInput(name=NAME, rotation=rotation_matrix(mounting), profile=noise_profile(profile))
    collector = RollingCollector(settings, [imu], gradienter=False, compass=False)
    draft = Draft(datetime.datetime.now(tz=datetime.UTC))
    found: list[Measurement | str] = []
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
                found.append(_measurement(collector, now_s))
                still_s = glance.still_s
        collector.add_imu(NAME, ImuSample(now_s, sample.gyro_rad_s, sample.accel_m_s2, sample.temperature_degc))
    collector.tick(now_s + 0.3)
    glance = collector.glance(now_s + 0.3)
    if glance.obstacle is None and glance.still_s > max(still_s, MIN_STILL_S - 1.0):
        found.append(_measurement(collector, now_s + 0.3))
    best, refused = _latest(found)
    seconds = now_s - _FIRST_S
    if best is None:
        return draft.record("failed", refused or f"no {MIN_STILL_S:.0f} s at rest in it: {obstacle}", seconds)
    tilt_known = pose.pitch_deg is not None and pose.roll_deg is not None
    if not tilt_known:
        draft.warnings.append("no accelerometer biases without --pitch-deg and --roll-deg")
    try:
        draft.solution = solve_at(*_posed(best, pose), What.BOTH if tilt_known else What.GYROS, _REMEDIES)
    except CalibrationRefusedError as error:
        return draft.record("failed", str(error), seconds)
    return draft.record("done", in_words(draft.solution), seconds)


def _measurement(collector: RollingCollector, now_s: float) -> Measurement | str:
    """Of the stretch that lasts until now, or why there is none."""
    try:
        return collector.measurement(now_s)
    except CalibrationRefusedError as error:
        return str(error)


def _latest(found: list[Measurement | str]) -> tuple[Window | None, str]:
    """The window of the latest that gives one; where none does, why the very latest gives none."""
    refused = ""
    for each in reversed(found):
        try:
            if isinstance(each, Measurement):
                return each.window(), ""
            raise CalibrationRefusedError(each)
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

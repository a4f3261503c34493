"""A calibration without a daemon: simulated devices' bytes through the companion's decoders, collector and solver."""

from __future__ import annotations

import datetime
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from companion.calibration.collector.outlook import Settings
from companion.calibration.collector.rolling import RollingCollector
from companion.calibration.means.pose import CompassModel, GradienterModel
from companion.calibration.means.windows import ImuInput
from companion.calibration.noise.allan import noise_profile
from companion.calibration.request import What
from companion.calibration.solution.site import LocalEarth, Whereabouts, local_earth
from companion.calibration.solution.solve import ImuSolution, Solution, solve
from companion.physics.gradienter import Law
from companion.protocols.decoding.base import Decoder
from companion.protocols.registry import PROTOCOLS, Kind
from companion.samples import CompassSample, ImuSample, Sample, TiltSample
from sim.aircraft import Site
from sim.devices import SerialDevice

DATE: Final = datetime.date(2026, 11, 21)


class Wire:
    """One simulated device, its line, and the companion's decoder at the other end."""

    def __init__(self, kind: Kind, device: SerialDevice) -> None:
        self.device = device
        self.decoder: Decoder = PROTOCOLS[kind][device.protocol].decoder(device.line_time_s(1))
        self.decoder.feed(device.power_on(0.0), 0.0)

    def samples_until(self, t_s: float) -> list[Sample]:
        """What has been sampled up to this time, decoded as it arrives."""
        found: list[Sample] = []
        for frame in self.device.frames_until(t_s):
            found += self.decoder.feed(frame.data, frame.complete_s)
        return found


class Still(NamedTuple):
    """What one calibration found."""

    solution: Solution
    local: LocalEarth

    @property
    def imu(self) -> ImuSolution:
        """Of the only IMU."""
        return self.solution.imus[0]


def whereabouts(site: Site) -> Whereabouts:
    """The simulator's site as a configuration would say it."""
    return Whereabouts(site.latitude_deg, site.longitude_deg, site.height_m, "configuration", DATE)


def calibrate(
    imu: Wire,
    gradienter: Wire,
    compass: Wire,
    site: Site,
    *,
    seconds: float,
    profile: str | None,
    law: Law,
    tilt_sigma_deg: float,
    heading_sigma_deg: float,
) -> Still:
    """Stand still for so many seconds and solve.

    Raises:
        CalibrationRefusedError: not still, or the readings contradict each other.
    """
    wanted = Settings(
        min_still_s=seconds, max_s=seconds, target_gyro_sigma_rad_s=0.0, target_accel_sigma_m_s2=0.0, horizon_s=180.0
    )
    taken = ImuInput(name="own", rotation=np.eye(3), profile=noise_profile(profile))
    tilt = GradienterModel(law, np.eye(3), (0.0, 0.0), tilt_sigma_deg)
    heading = CompassModel(magnetic=True, vehicle_from_sensor=np.eye(3), offset_deg=0.0, sigma_deg=heading_sigma_deg)
    collector = RollingCollector(wanted, [taken], tilt, heading)
    now_s = 0.0
    while now_s < seconds + 2.0:
        now_s += 0.5
        feed(collector, imu.samples_until(now_s))
        feed(collector, gradienter.samples_until(now_s))
        feed(collector, compass.samples_until(now_s))
    collector.tick(now_s)
    local = local_earth(whereabouts(site))
    return Still(solve(collector.window(now_s), local, tilt, heading, What.BOTH), local)


def feed(collector: RollingCollector, samples: Sequence[Sample]) -> None:
    """Samples to where they belong."""
    for sample in samples:
        if isinstance(sample, ImuSample):
            collector.add_imu("own", sample)
        elif isinstance(sample, TiltSample):
            collector.add_tilt(sample)
        elif isinstance(sample, CompassSample):
            collector.add_compass(sample)

"""Samples of a still aircraft for the calibration's tests: plain numpy, a few lines, nothing of the simulator."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from companion.config.sections import AllanModel, NoiseProfile
from companion.estimation.collector.intake import Settings
from companion.estimation.collector.rolling import RollingCollector
from companion.estimation.means.pose import CompassModel, GradienterModel
from companion.estimation.means.windows import ImuInput
from companion.estimation.noise.allan import noise_profile
from companion.physics.units import DEG, DEG_H, MG
from companion.samples import CompassSample, ImuSample, TiltSample

Floats = NDArray[np.float64]

GYRO_NOISE = 0.05 * DEG
ACCEL_NOISE = 2.0 * MG
BIAS = np.array([0.3, -0.2, 0.1]) * DEG
FORCE = np.array([0.1, -0.2, -9.79])
RATE_HZ = 50

QUIET = NoiseProfile("quiet", AllanModel(1e-9, 1e-9, 1e-12), AllanModel(1e-9, 1e-9, 1e-12))
"""Adds nothing, so that what is measured shows."""

TILT = GradienterModel("axis", np.eye(3), (0.0, 0.0), 1.0)
HEADING = CompassModel(magnetic=True, vehicle_from_sensor=np.eye(3), offset_deg=0.0, sigma_deg=1.0)


def settings(**more: float) -> Settings:
    values: dict[str, Any] = {
        "min_still_s": 10.0,
        "max_s": 60.0,
        "target_gyro_sigma_rad_s": 5.0 * DEG_H,
        "target_accel_sigma_m_s2": 0.2 * MG,
    }
    return Settings(**{**values, **more})


def imu(name: str = "fc", profile: NoiseProfile | None = None, **more: object) -> ImuInput:
    values: dict[str, object] = {
        "name": name,
        "rotation": np.eye(3),
        "profile": profile or noise_profile("icm42688p"),
    }
    return ImuInput(**{**values, **more})  # type: ignore[arg-type]


def noise(rng: np.random.Generator, size: int, gyro: float = GYRO_NOISE, accel: float = ACCEL_NOISE) -> Floats:
    return np.concatenate([BIAS + rng.normal(0.0, gyro, (size, 3)), FORCE + rng.normal(0.0, accel, (size, 3))], axis=1)


def imu_sample(t_s: float, row: Floats, temperature_degc: float | None = None) -> ImuSample:
    g, a = row[:3].tolist(), row[3:].tolist()
    return ImuSample(t_s, (g[0], g[1], g[2]), (a[0], a[1], a[2]), temperature_degc)


class Feeder:
    """Feeds a collector second by second; each source can be changed or silenced by a hook."""

    def __init__(
        self, collector: RollingCollector, names: tuple[str, ...] = ("fc",), *, seed: int = 1, rate_hz: int = RATE_HZ
    ) -> None:
        self.collector = collector
        self.names = names
        self.rng = np.random.default_rng(seed)
        self.rate_hz = rate_hz
        self.now_s = 1000.5
        self.change: Callable[[str, Floats, Floats], Floats | None] = lambda _name, _t, rows: rows
        self.tilt: Callable[[float], tuple[float, float] | None] | None = None
        self.heading: Callable[[float], float | None] | None = None

    def run(self, seconds: float) -> None:
        """Feed all sources until `now_s` is so many seconds later; nobody asks in between."""
        count = round(seconds * self.rate_hz)
        times = self.now_s + np.arange(count) / self.rate_hz
        streams: dict[str, Floats | None] = {}
        for name in self.names:
            streams[name] = self.change(name, times, noise(self.rng, count))
        for index, t_s in enumerate(times.tolist()):
            for name, rows in streams.items():
                if rows is not None:
                    self.collector.add_imu(name, imu_sample(t_s, rows[index]))
            if index % 5 == 0:
                if self.tilt is not None and (reading := self.tilt(t_s)) is not None:
                    self.collector.add_tilt(TiltSample(t_s, *reading))
                if self.heading is not None and (heading := self.heading(t_s)) is not None:
                    self.collector.add_compass(CompassSample(t_s, heading))
        self.now_s += count / self.rate_hz
        self.collector.tick(self.now_s)

    def waiting_for(self) -> str | None:
        return self.collector.status(self.now_s).waiting_for

    def still_s(self) -> float:
        return self.collector.status(self.now_s).still_s

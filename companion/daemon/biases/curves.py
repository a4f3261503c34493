"""The curves of bias over temperature of the IMUs that there are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from companion.daemon.core import Core
from companion.daemon.devices.autopilot_imu import AutopilotImu
from companion.estimation.means.warming import Warming
from companion.estimation.noise.allan import noise_profile
from companion.estimation.records.history import Point, by_power_up
from companion.estimation.solution.prior import curve_of, follow
from companion.estimation.temperature.along import Along, Settling, settling
from companion.estimation.temperature.curve import Curve, State
from companion.physics.frames import Array, vector
from companion.samples import Triad, Vector
from companion.storage.learned import KnownImu


class Curves:
    """Worked out anew whenever more is known."""

    def __init__(self, core: Core, imus: Mapping[str, AutopilotImu]) -> None:
        self._profiles, self._imus = core.profiles, imus
        self._names = {imu.name for imu in core.config.imu}
        self._of: dict[tuple[str, Triad], Curve | None] = {}
        self._settling: dict[str, Settling | None] = {}

    def follow(self, known: Mapping[str, KnownImu]) -> None:
        """Work out the curves of what is known; blocking."""
        of: dict[tuple[str, Triad], Curve | None] = {}
        for name in known.keys() & self._names:
            profile = noise_profile(self._profiles.of(name))
            of[name, "gyro"] = curve_of(known[name].points, "gyro", profile.gyro)
            of[name, "accel"] = curve_of(known[name].points, "accel", profile.accel)
        self._of = of
        self._settling = {name: settling(_states(known[name].points)) for name in known.keys() & self._names}

    def forget(self, name: str) -> None:
        """Of an IMU that is another one now."""
        self._of = {key: curve for key, curve in self._of.items() if key[0] != name}
        self._settling.pop(name, None)

    def of(self, name: str, triad: Triad) -> Curve | None:
        """None: not known."""
        return self._of.get((name, triad))

    def along(self, name: str, triad: Triad, warming: Warming | None) -> Along | None:
        """What the curve says of a window; None: it is not known, or the temperature not to have changed."""
        curve, path = self.of(name, triad), None if warming is None else warming.path
        if curve is None or path is None:
            return None
        profile = noise_profile(self._profiles.of(name))
        found = follow(curve, path, self._settling.get(name), profile.of(triad))
        start, _, end = path.degc
        return found.less(
            self.taken_off(name, triad, path.mean_degc, end), self.taken_off(name, triad, start, end) / path.span_s
        )

    def drift(
        self, name: str, triad: Triad, degc: float | None, now_degc: float | None
    ) -> tuple[Vector, Vector] | None:
        """By how much its output has moved since it was so warm, rad/s or m/s^2, and its variance; None: not known."""
        curve = self.of(name, triad)
        if curve is None or degc is None or now_degc is None:
            return None
        mean, variance = curve.change((degc, 0.0), (now_degc, 0.0))
        return vector(mean - self.taken_off(name, triad, degc, now_degc)), vector(variance)

    def taken_off(self, name: str, triad: Triad, degc: float, now_degc: float) -> Array:
        """What the autopilot takes off by temperature itself, from one to another, (3,)."""
        calibration = self._imus[name].calibration if name in self._imus else None
        return np.zeros(3) if calibration is None else calibration.thermal_change(triad, degc, now_degc)


def _states(points: Sequence[Point]) -> list[list[State]]:
    groups = by_power_up([point for point in points if point.temperature_degc is not None])
    return [[(point.temperature_degc or 0.0, point.k_s) for point in group] for group in groups]

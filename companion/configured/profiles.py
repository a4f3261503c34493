"""Noise profile of each IMU: which one its sigmas are computed from, and what an unknown part costs."""

from __future__ import annotations

import functools

import msgspec

from companion.config.sections import UNKNOWN, Config, Imu, NoiseProfile, Profile
from companion.configured.models import longest_window_s, settings
from companion.estimation.noise.allan import PROFILES, predicted_sigma
from companion.physics.units import DEG_H
from companion.storage.profiles import ProfileStore


def gyro_sigmas_deg_h(config: Config) -> dict[str, float]:
    """Predict how well the gyros of each part of the catalogue can be known; one sigma, "unknown" last.

    The estimator's own V(T, H) of the longest window. A warm-up and integer telemetry add to it.
    """
    mean_s, horizon_s = longest_window_s(config), settings(config).horizon_s
    return {name: predicted_sigma(one.gyro, mean_s, horizon_s) / DEG_H for name, one in PROFILES.items()}


class Profiles:
    """The profile of each IMU: as configured; else that of the part which its autopilot names."""

    def __init__(self, config: Config) -> None:
        self._config = config
        self._imus = {imu.name: imu for imu in config.imu}
        self._parts: dict[str, Profile] = {}

    def found(self, name: str, part: Profile | None) -> bool:
        """The autopilot says which part an IMU is, or that it does not know; whether that changes its profile."""
        before = self.of(name)
        if part is None:
            self._parts.pop(name, None)
        else:
            self._parts[name] = part
        return self.of(name) != before

    def of(self, name: str) -> str | NoiseProfile | None:
        """The profile of an IMU; None: nobody has named its part."""
        return self._imus[name].profile or self._parts.get(name)

    def imu(self, name: str) -> Imu:
        """The configuration of an IMU, with its profile in it."""
        return msgspec.structs.replace(self._imus[name], profile=self.of(name))

    def status(self) -> list[dict[str, object]]:
        """For `companion status`."""
        store = ProfileStore(self._config.storage.path)
        found: list[dict[str, object]] = []
        for name in self._imus:
            profile = self.of(name)
            fitted = profile.name if isinstance(profile, NoiseProfile) else None
            found.append(
                {
                    "imu": name,
                    "name": fitted or profile,
                    "fitted": fitted is not None,
                    "by_device_id": self._imus[name].profile is None and profile is not None,
                    "file": None if fitted is None else str(store.path(fitted)),
                    "summary": self._in_words(name),
                }
            )
        return found

    @functools.cached_property
    def _price_of_unknown(self) -> str:
        *known, (_, unknown) = gyro_sigmas_deg_h(self._config).items()
        others = ", ".join(f"{part} {sigma:.0f}" for part, sigma in known)
        return f"gyros known to {unknown:.0f} deg/h at best ({others})"

    def _in_words(self, name: str) -> str:
        profile = self.of(name)
        if isinstance(profile, NoiseProfile):
            return f"{profile.name}, {profile.origin}"
        if profile in (None, UNKNOWN):
            return f"part unknown: {self._price_of_unknown}"
        by = "" if self._imus[name].profile is not None else ", by its device id"
        return f"{profile}, of the catalogue{by}"

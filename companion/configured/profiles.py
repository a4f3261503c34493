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
        self._parts: dict[str, Profile | None] = {}

    def found(self, name: str, part: Profile | None) -> bool:
        """Set the part that the autopilot names for an IMU, None where it knows none; return whether that matters."""
        before = self.of(name)
        self._parts[name] = part
        return self.of(name) != before

    def of(self, name: str) -> str | NoiseProfile | None:
        """Return the profile of an IMU; None: nobody has named its part."""
        return self._imus[name].profile or self._parts.get(name)

    def imu(self, name: str) -> Imu:
        """Return the configuration of an IMU with its profile."""
        return msgspec.structs.replace(self._imus[name], profile=self.of(name))

    def status(self) -> list[dict[str, object]]:
        """Describe each IMU's profile for `companion status`."""
        found: list[dict[str, object]] = []
        for name, imu in self._imus.items():
            profile, file = self.of(name), None
            by_device_id = imu.profile is None and profile is not None
            if isinstance(profile, NoiseProfile):
                file, summary = ProfileStore(self._config.storage.path).path(profile.name), profile.origin
                profile = profile.name
            elif profile in (None, UNKNOWN):
                summary = self._price_of_unknown
            else:
                summary = f"of the catalogue{', by its device id' if by_device_id else ''}"
            label = "part unknown: " if profile in (None, UNKNOWN) else f"{profile}, "
            found.append(
                {
                    "imu": name,
                    "name": profile,
                    "fitted": file is not None,
                    "by_device_id": by_device_id,
                    "file": None if file is None else str(file),
                    "summary": label + summary,
                }
            )
        return found

    @functools.cached_property
    def _price_of_unknown(self) -> str:
        *known, (_, unknown) = gyro_sigmas_deg_h(self._config).items()
        others = ", ".join(f"{part} {sigma:.0f}" for part, sigma in known)
        return f"gyros known to {unknown:.0f} deg/h at best ({others})"

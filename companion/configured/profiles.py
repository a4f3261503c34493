"""Whose noise figures the sigmas of each IMU are made of."""

from __future__ import annotations

import msgspec

from companion.config.sections import Config, Imu, Noise, Profile
from companion.storage.profiles import ProfileStore


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

    def of(self, name: str) -> str | Noise | None:
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
            fitted = profile.name if isinstance(profile, Noise) else None
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

    def _in_words(self, name: str) -> str:
        profile = self.of(name)
        if isinstance(profile, Noise):
            return f"{profile.name}, {profile.origin}"
        if profile is None:
            return "none: sigmas are those of the worst common parts"
        by = "" if self._imus[name].profile is not None else ", by its device id"
        return f"{profile}, of the catalogue{by}"

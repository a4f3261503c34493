"""Identity of the sensor behind each IMU, and since when it has been powered."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Final

import numpy as np

from companion.config.sections import NoiseProfile
from companion.daemon.core import Core
from companion.daemon.devices.subsystem import Devices
from companion.daemon.stands.alignment import ActiveAlignment
from companion.estimation.records.history import PowerUp
from companion.storage.records import this_boot

_IN_WORDS: Final = {
    "system": "vehicle",
    "gyro": "gyro (device id)",
    "accel": "accelerometer (device id)",
    "scale": "accelerometer scale",
}
"""Words for keys of the identity, where the key is not plain."""


class ImuIdentities:
    """Identities of the configured IMUs."""

    def __init__(self, core: Core, devices: Devices, used: ActiveAlignment) -> None:
        self._config, self._vehicle, self._imus = core.config, core.vehicle, devices.imus
        self._alignment, self._collector = used, core.collector
        self._sensors = {role.name: sensor for sensor in devices.sensors for role in sensor.roles if role.kind == "imu"}
        self._sources = {imu.name: imu for imu in core.config.imu}
        self._host = this_boot() or os.urandom(8).hex()

    def power_up(self, name: str, unix_s: float) -> PowerUp:
        """Estimate since when an IMU's sensor has been powered, at a wall clock time."""
        up_s = self._collector.up_s(name)
        return PowerUp(host=self._host, since_unix_s=None if up_s is None else round(unix_s - up_s, 1))

    def session(self, name: str) -> str:
        """Return a word that changes as soon as the sensor may have been without power."""
        if name in self._imus:
            return f"boot {self._vehicle.boots}"
        sensor = self._sensors.get(name)
        if sensor is None:
            return ""
        return f"{sensor.link.reconnects} {sensor.decoder.times.clock.breaks} {sorted(sensor.health.counts.items())}"

    def zero(self) -> str | None:
        """Identify the active zero of the gradienter."""
        gradienter, used = self._config.gradienter, self._alignment.used
        if gradienter is None:
            return None
        at = used.measured_at if used is not None else "configured"
        mounting = _plain(gradienter.mounting)
        return f"{gradienter.protocol} {gradienter.law} {mounting} {_plain(gradienter.offset_deg)} {at}"

    def identity(self, name: str, before: Mapping[str, str]) -> dict[str, str]:
        """Return the properties that define a sensor and its biases; `before` fills gaps."""
        source = self._sources[name]
        profile = source.profile.name if isinstance(source.profile, NoiseProfile) else source.profile
        found: dict[str, str] = {"source": source.source, "profile": profile or "unknown"}
        if source.source == "serial":
            return {**found, "protocol": source.protocol or "", "mounting": _plain(source.mounting)}
        calibration = self._imus[name].calibration if name in self._imus else None
        found |= {
            "instance": str(source.instance or 1),
            "system": str(self._vehicle.system_id),
            "firmware": str(self._vehicle.firmware),
        }
        if calibration is None:
            # A property that is not known now has not changed.
            return {**before, **found}
        return found | {
            "gyro": str(calibration.gyro_id),
            "accel": str(calibration.accel_id),
            "orientation": _plain((np.round(calibration.orientation, 4) + 0.0).ravel().tolist()),
            "scale": _plain(calibration.accel_scale),
        }


def changed(before: Mapping[str, str], now: Mapping[str, str]) -> str:
    """Name the differences of two identities; empty: none."""
    keys = sorted(key for key in {*before, *now} if before.get(key) != now.get(key))
    return ", ".join(_IN_WORDS.get(key, key) for key in keys)


def _plain(value: object) -> str:
    return " ".join(f"{each:.6g}" for each in value) if isinstance(value, list | tuple) else str(value)

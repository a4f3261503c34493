"""Readings of one IMU at rest, whatever kind of file they came from."""

from __future__ import annotations

import datetime
import itertools
from typing import Final

import msgspec
import numpy as np

from companion.config.sections import NoiseProfile
from companion.physics.frames import Floats

NAME: Final = "imu"

LAST_S: Final = 1e11


class StillLog(msgspec.Struct, frozen=True, kw_only=True):
    """One IMU in one session: a file, or several of which each goes on where the one before ends."""

    imu: str
    files: tuple[str, ...]
    began_unix_s: float | None
    t_s: Floats
    """(n,) ascending."""
    readings: Floats
    """(n, 6): gyro in rad/s, accelerometer in m/s^2; axes as recorded."""
    temperature_degc: Floats
    """(n,); NaN where unknown."""
    profile: str | NoiseProfile | None = None
    """Noise profile in the configuration in force then."""
    truncated: bool = False
    """It came as integers only, which are left out."""
    clock_offset_s: float | None = None
    """UTC minus the recording's clock."""
    breaks_s: tuple[float, ...] = ()
    """When the readings became others by no noise: offsets were written, the device restarted."""

    notes: tuple[str, ...] = ()
    """Assumptions and oddities, in words."""
    left_out: dict[str, int] = {}
    """Lines that do not count, by reason."""
    clock_from_start: bool = False
    """True: times count from the switch-on of the autopilot."""

    @property
    def began_at(self) -> str | None:
        """UTC."""
        if self.began_unix_s is None:
            return None
        return datetime.datetime.fromtimestamp(self.began_unix_s, tz=datetime.UTC).isoformat(timespec="seconds")

    def pieces(self, skip_s: float = 0.0) -> list[slice]:
        """The samples between the breaks, in order; without the first `skip_s` of the session."""
        if not len(self.t_s):
            return []
        first = int(np.searchsorted(self.t_s, self.t_s[0] + skip_s)) if skip_s else 0
        cuts = [first, *(max(int(at), first) for at in np.searchsorted(self.t_s, sorted(self.breaks_s))), len(self.t_s)]
        return [slice(start, end) for start, end in itertools.pairwise(cuts) if end > start]

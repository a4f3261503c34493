"""Detection of a gradienter or compass whose reading does not change while the IMUs measure motion of the aircraft."""

from __future__ import annotations

import asyncio
import logging
import math
from collections import deque
from collections.abc import Callable, Sequence
from typing import Final

import numpy as np

from companion.component.statustext import Say, Severity, Weight
from companion.daemon.devices.sensors import ABSENT, SerialSensor
from companion.estimation.collector.rolling import RollingCollector
from companion.messages import message
from companion.physics.frames import Array
from companion.protocols.stream_health import SILENT, Trouble

logger = logging.getLogger(__name__)

PERIOD_S: Final = 0.5
REMEMBERED_S: Final = 300
TILTED_DEG: Final = 3.0
"""Minimum tilt that proves an unchanged gradienter reading stuck: 300 times the coarsest gradienter's resolution,
far beyond the error of a mean."""
TILTED_SECONDS: Final = 3
BEFORE_S: Final = 3.0
QUIET_S: Final = 3.0
"""Longest data gap of an IMU that still counts as evidence of motion; a write of offsets causes such a gap."""
LATE_S: Final = 1.0
"""Maximum delay of an IMU's first data after the earliest IMU's: a later IMU missed the start of the motion."""
TURNED_DEG: Final = 15.0
TURNING_RAD_S: Final = math.radians(12.0)
"""Minimum angular rate that counts as turning; a gyro bias may be up to 10 deg/s."""


NO_OFFSETS: Final = object()
"""Value for the offsets of an IMU whose readings no autopilot corrects."""


class SensorWatch:
    """Checks every sensor twice a second, also for an unchanged reading while the IMUs measure a tilt or turn.

    Each IMU measures in its own axes, so no mounting is needed. `offsets_of` returns the offsets subtracted from an
    IMU's samples, None if unknown. After a change of these offsets or of the board's orientation, the IMU's data are
    collected anew: the change must not look like a tilt.
    """

    def __init__(
        self,
        sensors: Sequence[SerialSensor],
        collector: RollingCollector,
        offsets_of: Callable[[str], object] = lambda name: NO_OFFSETS,
        say: Say = lambda *what: None,
    ) -> None:
        self._sensors, self._collector = sensors, collector
        self._offsets_of, self._say = offsets_of, say
        self._seconds: dict[str, deque[tuple[int, Array, float]]] = {}
        """Summary of each second, by IMU: number of the second, unit vector of mean force (3,), turn about it, deg."""
        self._offsets: dict[str, object] = {}
        self._has_failed = False

    async def run(self) -> None:
        loop = asyncio.get_running_loop()
        while True:
            try:
                self.update(loop.time())
            except Exception:
                # A fault of the watch must neither stop the sensors nor fill the log.
                if not self._has_failed:
                    logger.exception("looking after the sensors failed")
                self._has_failed = True
            await asyncio.sleep(PERIOD_S)

    def update(self, now_s: float) -> None:
        self._note_motion()
        troubles: dict[str, str] = {}
        for sensor in self._sensors:
            found, is_news = sensor.health.update(now_s, None if "imu" in sensor.kinds else self._stuck(sensor))
            if found is None:
                continue
            words = f"{sensor.name}: {found.words.removeprefix(f'{sensor.link.settings}: ')}"
            if found.key == ABSENT or found.key == sensor.health.reported != SILENT:
                troubles |= {role.name: words for role in sensor.roles}
            if found.implausible:
                if is_news:
                    # With this sensor no calibration can finish, and values already written may be wrong.
                    self._say(Severity.WARNING, words, Weight.NEWS)
                self._collector.reset(f"{sensor.name}: {found.words}", sensor.name if sensor.kinds == {"imu"} else None)
        for source in self._collector.sources():
            source.trouble = troubles.get(source.name, "")

    def _note_motion(self) -> None:
        for name, batch in self._collector.imu_seconds().items():
            seconds, offsets = self._seconds.setdefault(name, deque(maxlen=REMEMBERED_S)), self._offsets_of(name)
            if offsets is None or (seconds and seconds[-1][0] == batch.slot):
                continue
            if self._offsets.get(name) is not offsets:
                self._offsets[name] = offsets
                seconds.clear()
            rate, force = batch.mean[:3], batch.mean[3:]
            size = float(np.linalg.norm(force))
            if size > 0.0:
                down = force / size
                about = float(rate @ down)
                seconds.append((batch.slot, down, math.degrees(about) if abs(about) > TURNING_RAD_S else 0.0))

    def _seen(self, since_s: float, until_s: float) -> list[list[tuple[int, Array, float]]]:
        """Return each IMU's one-second summaries between two times; leave out IMUs whose data begin late or stopped."""
        # Measured against the newest second, not the clock: collection stops while a sensor is implausible.
        newest = max((seconds[-1][0] for seconds in self._seconds.values() if seconds), default=0)
        found = [
            [second for second in seconds if since_s <= second[0] <= until_s - 1.0]
            for seconds in self._seconds.values()
            if seconds and seconds[-1][0] >= newest - QUIET_S
        ]
        first = min((seconds[0][0] for seconds in found if seconds), default=0)
        return [seconds for seconds in found if seconds and seconds[0][0] <= first + LATE_S]

    def _stuck(self, sensor: SerialSensor) -> Trouble | None:
        since_s = sensor.health.stream.unchanged_since_s
        last_s = sensor.health.stream.last_sample_s
        if since_s is None or last_s is None:
            return None
        near_s = sensor.health.stream.near_since_s or since_s
        # Use the smallest tilt that any IMU measured.
        tilted_deg = min((_tilted_deg(each, since_s) for each in self._seen(near_s, last_s)), default=0.0)
        # Turns add up, and so do turns too slow to count: begin the sum shortly before the reading froze.
        seen = self._seen(max(near_s, since_s - BEFORE_S), last_s) if "compass" in sensor.kinds else []
        turned_deg = min((abs(sum(turn_deg for *_, turn_deg in each)) for each in seen), default=0.0)
        if turned_deg > TURNED_DEG:
            moved = f"turned by {turned_deg:.0f} deg"
        elif tilted_deg > TILTED_DEG and "gradienter" in sensor.kinds:
            moved = f"tilted by {tilted_deg:.0f} deg"
        else:
            return None
        evidence = f"the same reading for {last_s - since_s:.0f} s while the aircraft {moved}"
        return Trouble("stuck", message("sensor_stuck", evidence=evidence), implausible=True)

    def implausible(self) -> str | None:
        now_s = asyncio.get_running_loop().time()
        found = [(sensor.name, sensor.health.trouble(now_s)) for sensor in self._sensors]
        return next((f"{name}: {each.words}" for name, each in found if each is not None and each.implausible), None)


def _tilted_deg(seconds: list[tuple[int, Array, float]], since_s: float) -> float:
    """Return the smallest tilt, deg, of the latest summaries (from `since_s` on) against the first; 0 if too few."""
    stayed = [down for slot, down, _ in seconds[1:] if slot >= since_s][-TILTED_SECONDS:]
    if len(stayed) < TILTED_SECONDS:
        return 0.0
    cosines = [float(seconds[0][1] @ down) for down in stayed]
    return math.degrees(math.acos(min(1.0, max(-1.0, *cosines))))

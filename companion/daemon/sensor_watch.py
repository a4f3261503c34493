"""Looks after all of our own sensors at once: what only several of them together can tell, and a word about each."""

from __future__ import annotations

import asyncio
import logging
import math
from collections import deque
from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

import numpy as np

from companion.calibration.rolling import RollingCollector
from companion.physics.frames import Array
from companion.protocols.stream_health import Trouble

if TYPE_CHECKING:
    from companion.daemon.sensors import SerialSensor

logger = logging.getLogger(__name__)

PERIOD_S: Final = 0.5
REMEMBERED_S: Final = 300
TILTED_DEG: Final = 3.0
"""Far more than the mean of a second in somebody's hands is off, and 300 steps of the coarsest gradienter."""
TILTED_SECONDS: Final = 3
TURNED_DEG: Final = 15.0
TURNING_RAD_S: Final = math.radians(12.0)
"""Less may be a bias: what is called still may have 10 deg/s."""


class MotionWitness:
    """Whether the aircraft has tilted or turned since some instant, as its IMUs saw it.

    In the IMUs' own axes: the angle between two directions of gravity, and the turn about it, need no mounting.
    """

    def __init__(self) -> None:
        self._seconds: dict[str, deque[tuple[int, Array, float]]] = {}

    def look(self, collector: RollingCollector) -> None:
        """Take note of the last whole second of each IMU."""
        for name, batch in collector.imu_seconds().items():
            seconds = self._seconds.setdefault(name, deque(maxlen=REMEMBERED_S))
            if seconds and seconds[-1][0] == batch.slot:
                continue
            rate, force = batch.mean[:3], batch.mean[3:]
            size = float(np.linalg.norm(force))
            if size > 0.0:
                down = force / size
                about = float(rate @ down)
                turned_deg = math.degrees(about) if abs(about) > TURNING_RAD_S else 0.0
                seconds.append((batch.slot, down, turned_deg))

    def tilted_deg(self, since_s: float, until_s: float) -> float:
        """By how much it has tilted and stayed so; the least that any IMU saw."""
        return min((self._tilted_deg(seconds, since_s, until_s) for seconds in self._seconds.values()), default=0.0)

    @staticmethod
    def _tilted_deg(seconds: deque[tuple[int, Array, float]], since_s: float, until_s: float) -> float:
        after = [down for slot, down, _ in seconds if since_s <= slot <= until_s - 1.0]
        if len(after) <= TILTED_SECONDS:
            return 0.0
        cosines = [float(after[0] @ down) for down in after[-TILTED_SECONDS:]]
        return math.degrees(math.acos(min(1.0, max(-1.0, *cosines))))

    def turned_deg(self, since_s: float, until_s: float) -> float:
        """By how much it has turned about the vertical; the least that any IMU saw."""
        turns = [
            abs(sum(turned_deg for slot, _, turned_deg in seconds if since_s <= slot <= until_s - 1.0))
            for seconds in self._seconds.values()
        ]
        return min(turns, default=0.0)


class SensorWatch:
    """Looks at every sensor twice a second; `run` it beside them.

    Args:
        sensors: ours.
        collector: what must not be measured with readings that look good and are not.
    """

    def __init__(self, sensors: Sequence[SerialSensor], collector: RollingCollector) -> None:
        self._sensors, self._collector = sensors, collector
        self._witness = MotionWitness()
        self._has_failed = False

    async def run(self) -> None:
        """Look until cancelled."""
        loop = asyncio.get_running_loop()
        while True:
            try:
                self.look(loop.time())
            except Exception:
                # What merely watches must not end what is watched, nor fill the log.
                if not self._has_failed:
                    logger.exception("looking after the sensors failed")
                self._has_failed = True
            await asyncio.sleep(PERIOD_S)

    def look(self, now_s: float) -> None:
        """One look at all of them."""
        self._witness.look(self._collector)
        for sensor in self._sensors:
            if "imu" not in sensor.kinds:
                sensor.health.stuck = self._stuck(sensor)
            found = sensor.health.look(now_s)
            if found is not None and found.lies:
                self._collector.reset(f"{sensor.name}: {found.words}", sensor.name if sensor.kinds == {"imu"} else None)

    def _stuck(self, sensor: SerialSensor) -> Trouble | None:
        """A still gradienter or compass may repeat its digits for minutes; one that is moved may not."""
        since_s = sensor.health.stream.unchanged_since_s
        last_s = sensor.health.stream.last_sample_s
        if since_s is None or last_s is None:
            return None
        tilted_deg = self._witness.tilted_deg(since_s, last_s)
        turned_deg = self._witness.turned_deg(since_s, last_s) if "compass" in sensor.kinds else 0.0
        if turned_deg > TURNED_DEG:
            how = f"turned by {turned_deg:.0f} deg"
        elif tilted_deg > TILTED_DEG and "gradienter" in sensor.kinds:
            how = f"tilted by {tilted_deg:.0f} deg"
        else:
            return None
        return Trouble(
            "stuck", f"the same reading for {last_s - since_s:.0f} s while the aircraft {how}: stuck", lies=True
        )

    def worst(self) -> str | None:
        """Of the sensor that troubles most what is wrong, with its name; None while all do well."""
        now_s = asyncio.get_running_loop().time()
        found = [(sensor.name, sensor.health.trouble(now_s)) for sensor in self._sensors]
        troubles = sorted((not each.lies, f"{name}: {each.words}") for name, each in found if each is not None)
        return troubles[0][1] if troubles else None

"""Time and place by the autopilot, as far as they can be believed.

A place is believed when it may be one, and once it has been said again. While the aircraft stands still it does not
change by more than matters: what is farther off is believed only after it has been said for half a minute without
contradiction. Until then the old place stays, and `doubt` says what a calibration waits for.
"""

from __future__ import annotations

import asyncio
import dataclasses
import logging
import math
from collections.abc import Callable
from typing import Final

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.config.sections import HEIGHT_M, LATITUDE_DEG, LONGITUDE_DEG
from companion.links.mavlink.signing import EARLIEST_S
from companion.messages import message

logger = logging.getLogger(__name__)

LATEST_UNIX_TIME_S: Final = 4102444800.0  # 2100: later is no time but a fault

FAR_M: Final = 10_000.0
"""Less changes gravity by 0.01 mg and the Earth's rate by 0.03 deg/h at most, and is more than GNSS wanders."""
FAR_HEIGHT_M: Final = 300.0  # 0.1 mg of gravity, half of what a calibration aims at; GNSS wanders by less

CONFIRMED_AFTER_S: Final = 2.5  # a first place: what one packet says is not enough
SETTLED_AFTER_S: Final = 30.0
SILENT_S: Final = 5.0  # time for which a place counts after it was said last

_EARTH_RADIUS_M: Final = 6_371_000.0
_ESTIMATE: Final = "autopilot GLOBAL_POSITION_INT"
_RECEIVER: Final = "autopilot GPS_RAW_INT"


@dataclasses.dataclass(frozen=True, slots=True)
class Position:
    """Position by the autopilot; the height is above mean sea level."""

    latitude_deg: float
    longitude_deg: float
    height_m: float
    source: str


class TimeAndPlace:
    """Takes the autopilot's messages; whoever calls has made sure that they are the autopilot's.

    `is_carried`: whether the aircraft moves, or may fly: then its place changes rightly.
    """

    def __init__(self, is_carried: Callable[[], bool] = lambda: False) -> None:
        self.position: Position | None = None
        self._is_carried = is_carried
        self._anchor: Position | None = None  # that others are compared with; stays while the aircraft stands still
        self._claim: Position | None = None  # said and not believed yet; None: nowhere on Earth
        self._since_s = self._heard_s = -math.inf
        self._unix_minus_loop_s: float | None = None

    @property
    def unix_time_s(self) -> float | None:
        """UTC as the autopilot has it (from its GNSS), carried on by the loop's clock; None when it has none."""
        if self._unix_minus_loop_s is None:
            return None
        return self._unix_minus_loop_s + asyncio.get_running_loop().time()

    @property
    def doubt(self) -> str | None:
        """Why the place is not known for sure at this moment, and what helps; None while it is, or none is said."""
        now_s = asyncio.get_running_loop().time()
        if now_s - self._heard_s >= SILENT_S:
            return None
        if self._anchor is None:
            change, wait_s = "new position", CONFIRMED_AFTER_S
        else:
            change, wait_s = _apart(self._anchor, self._claim), SETTLED_AFTER_S
        left_s = max(1.0, wait_s - (now_s - self._since_s))
        return message("position_in_doubt", change=change, seconds=f"{left_s:.0f}")

    def restarted(self) -> None:
        """Forget what the autopilot has said; an aircraft that stands still is where it was."""
        self.position = self._claim = self._unix_minus_loop_s = None
        self._heard_s = -math.inf

    def hear_time(self, message: mavlink.MAVLink_system_time_message, t_s: float) -> None:
        unix_s = message.time_unix_usec * 1e-6
        self._unix_minus_loop_s = unix_s - t_s if EARLIEST_S < unix_s < LATEST_UNIX_TIME_S else None

    def hear_estimate(self, message: mavlink.MAVLink_global_position_int_message, t_s: float) -> None:
        place = _position(message.lat, message.lon, message.alt, _ESTIMATE)
        said = (self.position, self._claim)
        if place is not None or any(each is not None and each.source == _ESTIMATE for each in said):
            self._hear(place, t_s)

    def hear_receiver(self, message: mavlink.MAVLink_gps_raw_int_message, t_s: float) -> None:
        estimated = self.position is not None and self.position.source == _ESTIMATE
        if message.fix_type >= mavlink.GPS_FIX_TYPE_3D_FIX and not estimated:
            self._hear(_position(message.lat, message.lon, message.alt, _RECEIVER), t_s)

    def _hear(self, place: Position | None, t_s: float) -> None:
        if _is_near(place, self._anchor):
            self.position = place
            self._since_s = t_s  # who contradicts it begins anew
        elif place is not None and _is_near(place, self.position) and self._is_carried():
            self.position = self._anchor = place
        elif t_s - self._heard_s >= SILENT_S or not _is_near(place, self._claim):
            self._claim, self._since_s, self._heard_s = place, t_s, t_s
            if self._anchor is not None:
                logger.warning("%s", self.doubt)
        else:
            self._heard_s = t_s
            if t_s - self._since_s >= (CONFIRMED_AFTER_S if self._anchor is None else SETTLED_AFTER_S):
                self.position = self._anchor = place
                self._claim, self._heard_s = None, -math.inf


def _position(latitude_1e7: int, longitude_1e7: int, height_mm: int, source: str) -> Position | None:
    # (0, 0) is what ArduPilot sends while it knows no position.
    if (latitude_1e7, longitude_1e7) == (0, 0):
        return None
    place = Position(latitude_1e7 * 1e-7, longitude_1e7 * 1e-7, height_mm * 1e-3, source)
    bounds = ((place.latitude_deg, LATITUDE_DEG), (place.longitude_deg, LONGITUDE_DEG), (place.height_m, HEIGHT_M))
    return place if all(least <= value <= most for value, (least, most) in bounds) else None


def _is_near(one: Position | None, other: Position | None) -> bool:
    if one is None or other is None:
        return one is other
    return _distance_m(one, other) <= FAR_M and abs(one.height_m - other.height_m) <= FAR_HEIGHT_M


def _distance_m(one: Position, other: Position) -> float:
    north, from_north = math.radians(one.latitude_deg), math.radians(other.latitude_deg)
    turn = math.cos(math.radians(one.longitude_deg - other.longitude_deg))
    cosine = math.sin(north) * math.sin(from_north) + math.cos(north) * math.cos(from_north) * turn
    return _EARTH_RADIUS_M * math.acos(max(-1.0, min(cosine, 1.0)))


def _apart(before: Position, now: Position | None) -> str:
    if now is None:
        return "position gone or impossible"
    distance_m = _distance_m(before, now)
    if distance_m > FAR_M:
        return f"position jumped {distance_m / 1000.0:.0f} km"
    return f"height jumped {abs(now.height_m - before.height_m):.0f} m"

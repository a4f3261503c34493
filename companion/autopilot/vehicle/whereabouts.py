"""Time and place reported by the autopilot, after checks against faults and forgery.

A first place is accepted if it is possible and has been repeated. For a motionless aircraft, a place much farther
off is accepted only after half a minute of reports without contradiction. Until then the old place stays, and `doubt`
gives the reason why a calibration waits.
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

LATEST_UNIX_TIME_S: Final = 4102444800.0  # the year 2100; a later time is a fault

FAR_M: Final = 10_000.0
"""Distance from which a place counts as another one. Over it gravity changes by 0.01 mg, the Earth's rate by 0.03 deg/h
at most. GNSS wanders by less."""
FAR_HEIGHT_M: Final = 300.0  # least height that matters: 0.1 mg of gravity, half of a usual target; GNSS wanders less

CONFIRMED_AFTER_S: Final = 2.5  # time of reports before a first place is accepted: one packet is not enough
SETTLED_AFTER_S: Final = 30.0
SILENT_S: Final = 5.0  # time for which a reported place counts without a further report

_EARTH_RADIUS_M: Final = 6_371_000.0
_ESTIMATE: Final = "autopilot GLOBAL_POSITION_INT"
_RECEIVER: Final = "autopilot GPS_RAW_INT"


@dataclasses.dataclass(frozen=True, slots=True)
class Position:
    """Position reported by the autopilot; the height is above mean sea level."""

    latitude_deg: float
    longitude_deg: float
    height_m: float
    source: str


class TimeAndPlace:
    """Time and place from the autopilot's messages; the caller must check that the autopilot sent them.

    `is_carried` returns whether the aircraft moves, or may fly, so that its place may change.
    """

    def __init__(self, is_carried: Callable[[], bool] = lambda: False) -> None:
        self.position: Position | None = None
        self._is_carried = is_carried
        self._anchor: Position | None = None  # accepted place, compared with reports; stays while the aircraft does
        self._claim: Position | None = None  # reported, not accepted yet; None: an impossible place
        self._since_s = self._heard_s = -math.inf
        self._unix_minus_loop_s: float | None = None

    @property
    def unix_time_s(self) -> float | None:
        """UTC of the autopilot (from its GNSS), extrapolated by the loop's clock; None: it has no UTC."""
        if self._unix_minus_loop_s is None:
            return None
        return self._unix_minus_loop_s + asyncio.get_running_loop().time()

    @property
    def doubt(self) -> str | None:
        """Reason why the place is in doubt at this moment, and the remedy; None: no doubt, or no place reported."""
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
        """Discard the autopilot's reports, but not the accepted place, as the aircraft is motionless at a restart."""
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
            self._since_s = t_s  # a contradicting place must be reported for the full time again
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
    # ArduPilot sends (0, 0) while it knows no position.
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

"""Effect of running motors on an IMU's biases, from several flights.

It stands beside the history of calibrations and never becomes a point of it: the daemon has measured that power-up
itself, and better; the log does not say which one it was, so that it would count twice; and the effect of motors is no
bias of the ground.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Final

import msgspec

from companion.estimation.records.flight_record import AXES, Flight, Term, is_worth_saying
from companion.physics.units import MG, unit_of

SURE_SIGMAS: Final = 3.0
_COMMON: Final = {"deg/h": 0.0, "mg": 0.2 * MG}
"""Error that all flights of an aircraft share: its horizontal accelerometers where it leans."""


class Moved(msgspec.Struct, frozen=True):
    """Effect of motors on the bias of one axis; SI units, one sigma."""

    imu: int
    axis: str
    flights: int
    moves: Term

    @property
    def is_sure(self) -> bool:
        """True if it is significant and worth a word."""
        return abs(self.moves.value) > SURE_SIGMAS * self.moves.sigma and is_worth_saying(self.axis, self.moves.value)

    @property
    def words(self) -> str:
        """One line for people."""
        unit, name, digits = unit_of(self.axis)
        by = f"{self.moves.value / unit:+.{digits}f} ± {self.moves.sigma / unit:.{digits}f} {name}"
        return f"{self.flights} flight{'s' * (self.flights > 1)}: motors move IMU {self.imu} {self.axis} by {by}"


def moved(
    flights: Iterable[Flight], system_id: int | None, imu: int, gyro_id: int | None, accel_id: int | None
) -> list[Moved]:
    """Average by axis over the flights of this vehicle with these sensors, weighted by sigma.

    Where they scatter by more than their sigmas, so much wider is that of the mean.
    """
    same = [
        one
        for flight in flights
        if None in (flight.system_id, system_id) or flight.system_id == system_id
        for one in flight.imus
        if one.imu == imu
    ]
    found = []
    for axis in AXES:
        of, sensor = ("gyro_id", gyro_id) if axis.startswith("gyro") else ("accel_id", accel_id)
        own = [one for one in same if sensor is not None and getattr(one, of) == sensor]
        terms = [each.motors for one in own for each in one.axes if each.axis == axis and each.motors is not None]
        weights = [1.0 / term.sigma**2 for term in terms if term.sigma > 0.0]
        if not weights or len(weights) < len(terms):
            continue
        mean = sum(w * term.value for w, term in zip(weights, terms, strict=True)) / sum(weights)
        scatter = sum(w * (term.value - mean) ** 2 for w, term in zip(weights, terms, strict=True))
        wider = max(1.0, scatter / max(len(terms) - 1, 1))
        sigma = math.hypot(math.sqrt(wider / sum(weights)), _COMMON[unit_of(axis)[1]])
        found.append(Moved(imu, axis, len(terms), Term(mean, sigma)))
    return found


def surely_moved(flights: Iterable[Flight], like: Flight) -> list[Moved]:
    """List the significant effects on the IMUs of one flight that others confirm."""
    known = list(flights)
    return [
        one
        for imu in like.imus
        for one in moved(known, like.system_id, imu.imu, imu.gyro_id, imu.accel_id)
        if one.is_sure and one.flights > 1
    ]

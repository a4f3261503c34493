"""Verdict on a flight: figures from the record of truth, estimate and events, and the limits of these figures.

Pure; times are on the firmware's clock, in seconds.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from statistics import median
from typing import Literal, NamedTuple

import numpy as np

from sim.earth import Array

YAW_LIMIT_DEG = 10.0
POSITION_LIMIT_M = 3.0
TILT_LIMIT_DEG = 70.0
"""Tilt limit: a hovering aircraft beyond this tilt is falling."""
LOW_M = 1.0
"""Height below which the flight counts as over."""
BEFORE_S = 10.0
"""Length of the interval before the fault with which the time after it is compared."""
CIRCLE_S = 50.0
"""Time that a plane needs for a circle in any wind; the error varies along the circle."""
SETTLED_S = 1.0
"""Averaging time of the estimator's position error before the fault."""
HEADER = f"{'fault':16}{'set-up':9}{'wind':>12}{'yaw':>7}{'other set':>13}{'off truth':>11}{'off spot':>10}  verdict"


class Event(NamedTuple):
    own_s: float
    kind: Literal["mode", "set", "disarmed", "text"]
    words: str


@dataclass
class Record:
    fault: str
    set_up: str
    wind: tuple[float, float]
    """Wind speed in m/s, and direction of origin in degrees."""
    truth: Array = field(default_factory=lambda: np.empty((0, 10)))
    """Rows of `FlyingAircraft.recorded`."""
    estimate: Array = field(default_factory=lambda: np.empty((0, 3)))
    """Estimates of the firmware: own_s, yaw in rad, 0."""
    place: Array = field(default_factory=lambda: np.empty((0, 4)))
    """Positions estimated by the firmware: own_s, north, east, down in m."""
    events: list[Event] = field(default_factory=list)
    struck_s: float = math.inf
    """Time of the fault."""
    circle: tuple[float, float, float] | None = None
    """Target circle, if the aircraft does not hold its spot: centre north and east, and radius, in m."""

    def after(self, kind: str) -> list[Event]:
        return [event for event in self.events if event.kind == kind and event.own_s >= self.struck_s]


@dataclass(frozen=True)
class Figures:
    """Figures of a flight, from the fault on."""

    yaw_deg: float
    """Largest error of the estimator's yaw."""
    yaw_before_deg: float
    """Largest error of the estimator's yaw in the last seconds before the fault."""
    fallback_s: float
    """Time until the other source set was in use; inf: never."""
    estimate_m: float
    """Largest horizontal error of the estimated position, less the error before the fault."""
    spot_m: float
    """Largest true horizontal distance from the place at the fault; on a circle: from the circle, less
    the largest distance before.
    """
    sets: int
    """Number of changes of the source set."""
    modes: int
    """Number of changes of the flight mode that nobody requested."""
    crashed: str
    """Description of a crash; empty without one."""

    @property
    def wrong(self) -> list[str]:
        """Return the reasons why the flight was not good."""
        found = []
        if not self.yaw_deg <= YAW_LIMIT_DEG:
            found.append(f"yaw above {YAW_LIMIT_DEG:g} deg")
        if not self.estimate_m <= POSITION_LIMIT_M or self.spot_m > POSITION_LIMIT_M:
            found.append(f"place above {POSITION_LIMIT_M:g} m")
        if self.sets > 2:
            found.append(f"{self.sets} changes of the source set")
        if self.modes:
            found.append(f"{self.modes} changes of mode")
        if self.crashed:
            found.append(self.crashed)
        return found


def _yaw_errors_deg(record: Record) -> tuple[Array, Array]:
    """Return times and errors of the estimator's yaw."""
    own_s = record.estimate[:, 0]
    true = np.interp(own_s, record.truth[:, 0], record.truth[:, 3])
    return own_s, np.degrees((record.estimate[:, 1] - true + math.pi) % (2.0 * math.pi) - math.pi)


def figures(record: Record) -> Figures:
    own_s, errors = _yaw_errors_deg(record)
    struck = record.struck_s
    if not (own_s > struck).any() or not (own_s < struck).any() or not len(record.place):
        raise ValueError("no estimates before or after the fault")
    sets = record.after("set")
    true = np.column_stack([np.interp(record.place[:, 0], record.truth[:, 0], record.truth[:, k]) for k in (4, 5)])
    off = record.place[:, 1:3] - true
    before = (record.place[:, 0] < struck) & (record.place[:, 0] >= struck - SETTLED_S)
    since = record.place[:, 0] >= struck
    off = off[since] - off[before].mean(axis=0)
    flown = record.truth[record.truth[:, 0] >= struck]
    return Figures(
        yaw_deg=float(np.abs(errors[own_s >= struck]).max()),
        yaw_before_deg=float(np.abs(errors[(own_s < struck) & (own_s > struck - BEFORE_S)]).max()),
        fallback_s=next((event.own_s - struck for event in sets if event.words != "1"), math.inf),
        estimate_m=float(np.hypot(*off.T).max()),
        spot_m=_off_spot_m(record, flown),
        sets=len(sets),
        modes=len(record.after("mode")),
        crashed=_crashed(record, flown),
    )


def _off_spot_m(record: Record, flown: Array) -> float:
    if record.circle is None:
        return float(np.hypot(*(flown[:, 4:6] - flown[0, 4:6]).T).max())
    north_m, east_m, radius_m = record.circle
    off = np.abs(np.hypot(record.truth[:, 4] - north_m, record.truth[:, 5] - east_m) - radius_m)
    after = record.truth[:, 0] >= record.struck_s
    before = ~after & (record.truth[:, 0] > record.struck_s - CIRCLE_S)
    return max(0.0, float(off[after].max() - off[before].max()))


def _crashed(record: Record, flown: Array) -> str:
    if record.after("disarmed"):
        return "disarmed in the air"
    if (-flown[:, 6]).min() < LOW_M:
        return "came down"
    if np.degrees(np.abs(flown[:, 1:3]).max()) > TILT_LIMIT_DEG:
        return "tipped over"
    return ""


def row(record: Record, found: Figures) -> str:
    fallback = f"{found.fallback_s:.1f} s" if math.isfinite(found.fallback_s) else "never"
    wind = f"{record.wind[0]:.0f} m/s {record.wind[1]:03.0f}"
    return (
        f"{record.fault:16}{record.set_up:9}{wind:>12}{found.yaw_deg:7.1f}{fallback:>13}"
        f"{found.estimate_m:9.1f} m{found.spot_m:8.1f} m  {'; '.join(found.wrong) or 'good'}"
    )


def summary(fault: str, set_up: str, flights: Sequence[Figures | None]) -> str:
    """Summarise flights with the same fault: number of good ones, and the largest figures with their medians.

    None stands for a flight that failed to start.
    """
    found = [flight for flight in flights if flight is not None]
    text = f"{fault}, {set_up}: {sum(not flight.wrong for flight in found)} of {len(found)} flights good"
    if len(found) < len(flights):
        text += f", {len(flights) - len(found)} did not come about"
    if not found:
        return text
    columns = {
        "yaw": ([flight.yaw_deg for flight in found], "deg"),
        "other set after": ([flight.fallback_s for flight in found], "s"),
        "off truth": ([flight.estimate_m for flight in found], "m"),
        "off spot": ([flight.spot_m for flight in found], "m"),
    }
    largest = (f"{name} {max(of):.1f} ({median(of):.1f}) {unit}" for name, (of, unit) in columns.items())
    return f"{text}; largest (median): {', '.join(largest)}"

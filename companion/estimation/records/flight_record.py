"""What a log of the autopilot says of a flight, as it is kept; SI units, over what the offsets in force left."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import msgspec

from companion.physics.units import unit_of

FORMAT_VERSION: Final = 1
AXES: Final = ("gyro x", "gyro y", "gyro z", "accel z")
HEADS: Final = {
    "in_flight": "in the air", "ekf": "EKF", "turn_on": "motors off", "temperature": "temperature", "motors": "motors",
    "vibration": "vibration", "trend": "per minute",
}  # fmt: skip
"""The terms of a `Split`, as tables name them."""
_MEANINGS: Final = {
    "in_flight": "mean bias from take-off to landing",
    "ekf": "the EKF's own estimate in the latter half of the flight",
    "turn_on": "bias while standing, before the motors start",
    "temperature": "warming from there into the air, by the learned curve",
    "motors": "change as the motors start: vibration, and warming where no curve is known",
    "vibration": "change for each m/s^2 of vibration level",
    "trend": "change in each minute of flight",
}
UNSEEN: Final = "accel x, y: not counted, in the air nothing tells them from tilt"
_WORTH: Final = {"deg/h": 30.0, "mg": 1.5}
"""Smaller findings are nobody's worry."""


class Term(msgspec.Struct, frozen=True):
    """A part of a bias with one sigma; rad/s or m/s^2."""

    value: float
    sigma: float


class Split(msgspec.Struct, frozen=True, kw_only=True):
    """One axis of one IMU, over what the offsets in force left; None: the log does not carry it."""

    axis: str
    in_flight: Term | None
    """Its mean in the air."""
    ekf: Term | None
    """As the EKF had it in the latter half of that."""
    turn_on: Term | None
    """Before the motors."""
    temperature: Term | None
    """From there to the mean in the air, by the learnt curve."""
    motors: Term | None
    """The step at their start: vibration rectification, and temperature where no curve is known."""
    vibration: Term | None
    """For each m/s^2 of vibration level."""
    trend: Term | None
    """A minute of flight."""


class Drift(msgspec.Struct, frozen=True):
    """How far free inertial navigation is from the solution after a time."""

    seconds: float
    starts: int
    median_m: float
    worst_m: float
    """In one start of twenty it is more."""


class Stages(msgspec.Struct, frozen=True):
    """Of a flight, in s of the autopilot's clock; None where the log does not tell."""

    armed_s: float
    motors_s: float | None
    take_off_s: float | None
    landing_s: float | None
    disarmed_s: float | None


class ImuFlight(msgspec.Struct, frozen=True, kw_only=True):
    """One IMU in one flight."""

    imu: int
    rate_hz: float
    calibration: str | None
    """`started_at` of the record whose offsets it flew with."""
    gyro_id: int | None = None
    accel_id: int | None = None
    set_gyro_rad_s: tuple[float, ...] | None
    set_accel_m_s2: tuple[float, ...] | None
    """The offsets in force, in the IMU's own axes."""
    axes: tuple[Split, ...]
    drift: dict[str, list[Drift]]
    """Drift without aid, by whose offsets: `flown`, `before`."""
    notes: tuple[str, ...]


class Flight(msgspec.Struct, frozen=True, kw_only=True):
    """From an arming to the disarming after it."""

    key: str
    """Of this arming of this start of this autopilot, however often and from whichever file it is read."""
    system_id: int | None
    began_at: str | None
    stages: Stages
    reference: str
    """What the drift is measured from: "ekf", or "truth" of a simulator."""
    imus: tuple[ImuFlight, ...]
    notes: tuple[str, ...]


class KeptFlight(msgspec.Struct, frozen=True, kw_only=True):
    """One file of the flights."""

    log: str
    """The name of the file it was read from."""
    read_at: str
    flight: Flight
    format_version: int = FORMAT_VERSION


def legend(imus: Sequence[ImuFlight]) -> list[str]:
    """Explain the terms that the tables of these IMUs have, a line for each."""
    axes = [axis for imu in imus for axis in imu.axes]
    return [f"{head}: {_MEANINGS[term]}" for term, head in HEADS.items() if any(getattr(axis, term) for axis in axes)]


def is_worth_saying(axis: str, value: float) -> bool:
    """Whether a part of a bias is more than nobody's worry."""
    unit, name, _ = unit_of(axis)
    return abs(value) / unit > _WORTH[name]


def drift_lines(imu: ImuFlight) -> list[str]:
    """The figure that counts, a line for each time."""
    lines = []
    for flown in imu.drift.get("flown", ()):
        others = [
            f"with the offsets of {name} {each.median_m:.1f} m"
            for name, rows in imu.drift.items()
            if name != "flown"
            for each in rows
            if each.seconds == flown.seconds
        ]
        own = f"{flown.median_m:.1f} m (95 %: {flown.worst_m:.1f} m, {flown.starts} starts)"
        lines.append("; ".join([f"{flown.seconds:.0f} s without GNSS: {own}", *others]))
    return lines


def figure(imus: Sequence[ImuFlight]) -> str | None:
    """The one line of a flight, of its first IMU and 30 s, else what is next to that; None where it did not fly."""
    first = next((imu for imu in imus if imu.drift.get("flown")), None)
    if first is None:
        return None
    rows = first.drift["flown"]
    return drift_lines(first)[min(range(len(rows)), key=lambda k: abs(rows[k].seconds - 30.0))]


def next_flight(found: Flight) -> str:
    """The largest thing that is surely there."""
    worst: tuple[float, str] = (0.0, "nothing to do: what the offsets left is small or not surely there")
    for imu in found.imus:
        for axis in imu.axes:
            unit, name, digits = unit_of(axis.axis)
            for term, what, remedy in (
                (axis.motors, "by vibration of the motors", "damp the autopilot better"),
                (axis.turn_on, "before the motors", "calibrate nearer to the take-off"),
            ):
                if term is None or abs(term.value) < 2.0 * term.sigma:
                    continue
                size = abs(term.value) / unit / _WORTH[name]
                if size > max(worst[0], 1.0):
                    words = f"IMU {imu.imu} {axis.axis}: {abs(term.value) / unit:.{digits}f} {name} {what}: {remedy}"
                    worst = size, words
    return worst[1]

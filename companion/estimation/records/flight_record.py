"""Records of flights, made from logs of the autopilot, in SI units; biases are residuals after the active offsets."""

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
"""Column headings for the terms of a `Split` in tables (docs/flight.md)."""
UNSEEN: Final = "accel x, y: not counted, in the air nothing tells them from tilt"
_WORTH: Final = {"deg/h": 30.0, "mg": 1.5}  # Least bias worth a recommendation


class Term(msgspec.Struct, frozen=True):
    """Part of a bias with one sigma, in rad/s or m/s^2."""

    value: float
    sigma: float


class Split(msgspec.Struct, frozen=True, kw_only=True):
    """Residual bias of one axis after the active offsets, split into its causes; None: the log does not show it.

    `in_flight` is the mean from take-off to landing, `ekf` the EKF's estimate in the latter half of the flight.
    `turn_on` is the mean at rest before the motors start, `temperature` the change from then to the flight by the
    learned curve. `motors` is the step at the motors' start: from vibration rectification, and from temperature if no
    curve is known. `vibration` is the change per m/s^2 of vibration level, `trend` the change per minute of flight.
    """

    axis: str
    in_flight: Term | None
    ekf: Term | None
    turn_on: Term | None
    temperature: Term | None
    motors: Term | None
    vibration: Term | None
    trend: Term | None


class Drift(msgspec.Struct, frozen=True):
    """Position error after `seconds` of inertial navigation, from `starts` times of a flight; 5 % exceed `worst_m`."""

    seconds: float
    starts: int
    median_m: float
    worst_m: float


class Stages(msgspec.Struct, frozen=True):
    """Times of a flight's stages on the autopilot's clock; None: not in the log."""

    armed_s: float
    motors_s: float | None
    take_off_s: float | None
    landing_s: float | None
    disarmed_s: float | None
    is_arming_logged: bool = True  # Else `armed_s` is the beginning of the log


class ImuFlight(msgspec.Struct, frozen=True, kw_only=True):
    """Result of one flight for one IMU; `calibration` is the start of the calibration that wrote the active offsets."""

    imu: int
    rate_hz: float
    calibration: str | None
    gyro_id: int | None = None
    accel_id: int | None = None
    set_gyro_rad_s: tuple[float, ...] | None
    set_accel_m_s2: tuple[float, ...] | None  # Active offsets, in the IMU's own axes
    axes: tuple[Split, ...]
    drift: dict[str, list[Drift]]  # Drift of free navigation, by set of offsets: `flown`, `before`
    notes: tuple[str, ...]


class Flight(msgspec.Struct, frozen=True, kw_only=True):
    key: str
    """Identity of this arming of the autopilot, equal in all log files that contain this arming."""
    system_id: int | None
    began_at: str | None
    stages: Stages
    reference: str
    """Source of the motion against which drift is measured: "ekf", or "truth" of a simulator."""
    imus: tuple[ImuFlight, ...]
    notes: tuple[str, ...]


class KeptFlight(msgspec.Struct, frozen=True, kw_only=True):
    log: str
    read_at: str
    flight: Flight
    format_version: int = FORMAT_VERSION


def drift_lines(imu: ImuFlight) -> list[str]:
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
    """Summarise a flight as text: drift after about 30 s, of the first IMU with a known drift; None: no such IMU."""
    first = next((imu for imu in imus if imu.drift.get("flown")), None)
    if first is None:
        return None
    rows = first.drift["flown"]
    return drift_lines(first)[min(range(len(rows)), key=lambda k: abs(rows[k].seconds - 30.0))]


def next_flight(found: Flight) -> str:
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

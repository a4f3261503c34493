"""What a firmware's sensor truly had too much in a flight, from what its log says it was told; and what was found.

Truth comes from the parameters in the log, with the log's own times: ArduPilot's simulated errors (SIM_*), and PX4's
offsets, since its simulated sensor has none. Read by pymavlink and pyulog, and not by the companion.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sim.earth import Array
from sim.imu_model import DEG_H, MG, Bias

AXES = ("X", "Y", "Z")
NAMED = ("gyro x", "gyro y", "gyro z", "accel z")
"""As `companion flight` names them; the horizontal accelerometers it does not count."""
OF_AXIS = (0, 1, 2, 5)
TERMS = ("own_imu", "turn_on", "in_flight", "temperature", "motors", "vibration", "trend")
OFFSETS = {
    "ardupilot": tuple(f"INS_{kind}OFFS_{axis}" for kind in ("GYR", "ACC") for axis in AXES),
    "px4": tuple(f"CAL_{kind}0_{axis}OFF" for kind in ("GYRO", "ACC") for axis in AXES),
}
"""Of the first IMU."""
BIASES = tuple(f"SIM_{kind}1_BIAS_{axis}" for kind in ("GYR", "ACC") for axis in AXES)
_GROUND_S, _MOTORS_S, _SETTLED_S, _WINDOW_S = 30.0, 0.5, 3.0, 10.0
"""As docs/flight.md has them: so long before the motors; from take-off on; windows."""
_STEP_S = 0.1
_NOTHING = 1e-12
_PX4_TAKES = 0.01
"""It leaves an offset in force that differs by less (Gyroscope.cpp, Accelerometer.cpp: set_offset)."""


class Told(NamedTuple):
    """What a log says that the sensor was told."""

    firmware: str
    parameters: Sequence[tuple[float, str, float]]
    """Time in s, name and value, in order."""
    vibration: Array
    """(n, 2) time and level in m/s^2."""

    def at(self, t_s: Array, names: Iterable[str]) -> Array:
        """(n, m) parameters at times; 0 before they are told."""
        found = []
        for name in names:
            rows = [(at_s, value) for at_s, known, value in self.parameters if known == name] or [(0.0, 0.0)]
            before = np.searchsorted([at_s for at_s, _ in rows], t_s, side="right") - 1
            found.append(np.array([value for _, value in rows])[np.maximum(before, 0)])
        return np.column_stack(found)

    def left(self, t_s: Array, armed_s: float) -> tuple[Array, Array]:
        """What the readings had too much, (n, 6) in rad/s and m/s^2: all of it, and what is temperature's alone."""
        if self.firmware == "px4":
            return -self._in_use(t_s), np.zeros((len(t_s), 6))
        offsets = self.at(np.array([armed_s]), OFFSETS["ardupilot"])
        warmth = self._warmth(t_s)
        return self.at(t_s, BIASES) + warmth - offsets, warmth

    def _in_use(self, t_s: Array) -> Array:
        """PX4's offsets, without what it has not taken."""
        names = OFFSETS["px4"]
        now, used = np.zeros(6), np.zeros(6)
        times, rows = [-np.inf], [np.zeros(6)]
        for at_s in sorted({at_s for at_s, name, _ in self.parameters if name in names}):
            now = self.at(np.array([at_s]), names)[0]
            for half in (slice(0, 3), slice(3, 6)):
                first = half.start == 0 and len(times) == 1  # the first gyro offsets of a start are taken however small
                if first or np.linalg.norm(now[half] - used[half]) > _PX4_TAKES:
                    used = used.copy()
                    used[half] = now[half]
            times.append(at_s)
            rows.append(used)
        return np.array(rows)[np.searchsorted(times, t_s, side="right") - 1]

    def _warmth(self, t_s: Array) -> Array:
        """ArduPilot's curve at its simulated temperature (AP_InertialSensor_SITL.cpp: get_temperature)."""
        degc = self.degc(t_s)
        middle = 0.5 * self.at(t_s, ["SIM_IMUT1_TMIN", "SIM_IMUT1_TMAX"]).sum(axis=1)
        d = (degc - middle)[:, None]
        powers = [
            self.at(t_s, [f"SIM_IMUT1_{kind}{n}_{axis}" for kind in ("GYR", "ACC") for axis in AXES]) for n in (1, 2, 3)
        ]
        return np.asarray(((powers[2] * d + powers[1]) * d + powers[0]) * d * 1e-6)

    def degc(self, t_s: Array) -> Array:
        """ArduPilot's simulated temperature."""
        fixed, start, end, constant = self.at(t_s, [f"SIM_IMUT_{n}" for n in ("FIXED", "START", "END", "TCONST")]).T
        warming = end - (end - start) * np.exp(-t_s / np.maximum(constant, 1e-3))
        return np.asarray(np.where(fixed != 0.0, fixed, warming))


def ardupilot_told(log: Path) -> Told:
    """PARM and VIBE of a .BIN."""
    from pymavlink.DFReader import DFReader_binary

    reader: Any = DFReader_binary(str(log))  # type: ignore[no-untyped-call]
    parameters, vibration = [], []
    with contextlib.closing(reader):
        while (message := reader.recv_match(type=["PARM", "VIBE"])) is not None:
            at_s = message.TimeUS * 1e-6
            if message.get_type() == "PARM":
                parameters.append((at_s, message.Name, message.Value))
            elif message.IMU == 0:
                vibration.append((at_s, float(np.linalg.norm([message.VibeX, message.VibeY, message.VibeZ]))))
    return Told("ardupilot", parameters, np.array(vibration).reshape(-1, 2))


def px4_told(log: Path) -> Told:
    """The parameters of a .ulg."""
    from pyulog import ULog

    found = ULog(str(log), ["vehicle_imu_status"])
    parameters = [(found.start_timestamp * 1e-6, name, value) for name, value in found.initial_parameters.items()]
    parameters += [(at_us * 1e-6, name, value) for at_us, name, value in found.changed_parameters]
    return Told("px4", parameters, np.zeros((0, 2)))


def told(log: Path) -> Told:
    """Of either firmware's log."""
    return px4_told(log) if log.suffix == ".ulg" else ardupilot_told(log)


def truth_of(flown: Told, flight: Mapping[str, Any], end_s: float) -> dict[str, dict[str, float]]:
    """By axis and term, what `companion flight` should have found, where it has found something.

    Args:
        flown: what the sensor was told.
        flight: one of the flights of `companion flight --json`.
        end_s: of the log, for a flight without a landing.
    """
    stages = flight["stages"]
    motors_s = (stages["motors_s"] or stages["armed_s"]) - _MOTORS_S
    ground, ground_warmth = flown.left(np.arange(motors_s - _GROUND_S, motors_s, _STEP_S), stages["armed_s"])
    start_s = stages["take_off_s"] + _SETTLED_S
    windows = int((min(stages["landing_s"] or end_s, stages["disarmed_s"] or end_s) - _SETTLED_S - start_s) / _WINDOW_S)
    t_s = start_s + np.arange(0.0, windows * _WINDOW_S - 0.5 * _STEP_S, _STEP_S)
    air, air_warmth = flown.left(t_s, stages["armed_s"])
    minutes = (t_s.reshape(windows, -1).mean(axis=1) - t_s.mean()) / 60.0
    means = air.reshape(windows, -1, 6).mean(axis=1)
    columns = {"trend": minutes}
    if len(flown.vibration):
        level = np.interp(t_s, flown.vibration[:, 0], flown.vibration[:, 1])
        columns["vibration"] = level.reshape(windows, -1).mean(axis=1)
    found: dict[str, dict[str, float]] = {}
    for axis, k in zip(flight["imus"][0]["axes"], OF_AXIS, strict=True):
        true = {
            "turn_on": ground[:, k].mean(),
            "in_flight": air[:, k].mean(),
            "temperature": air_warmth[:, k].mean() - ground_warmth[:, k].mean(),
        }
        true["motors"] = true["in_flight"] - true["turn_on"] - (true["temperature"] if axis["temperature"] else 0.0)
        # The slope of what was told against what the firmware has measured: its level has a filter and noise.
        used = [name for name in columns if axis[name] is not None]
        design = np.column_stack([np.ones(windows), *(columns[name] for name in used)])
        slopes = np.linalg.lstsq(design, means[:, k], rcond=None)[0][1:]
        true |= dict(zip(used, slopes, strict=True))
        found[axis["axis"]] = {term: float(value) for term, value in true.items() if axis[term] is not None}
    return found


class Row(NamedTuple):
    """One term of one axis of one flight; deg/h or mg, and per m/s^2 or a minute."""

    axis: str
    term: str
    true: float
    found: float
    sigma: float


def rows_of(flight: Mapping[str, Any], true: Mapping[str, Mapping[str, float]]) -> list[Row]:
    """What was found beside what was there."""
    rows = []
    for axis in flight["imus"][0]["axes"]:
        unit = DEG_H if axis["axis"].startswith("gyro") else MG
        for term, value in true[axis["axis"]].items():
            told_of = axis[term]
            if told_of["sigma"] == 0.0 and abs(told_of["value"] - value) < _NOTHING:
                continue  # a temperature that stays the same
            rows.append(Row(axis["axis"], term, value / unit, told_of["value"] / unit, told_of["sigma"] / unit))
    return rows


def serial_rows(record: Mapping[str, Any], true: Bias) -> list[Row]:
    """What a calibration has found of the companion's own IMU beside what it had; `record` as `calibrate --json`."""
    (imu,) = (each for each in record["imus"] if each["name"] == "own")
    units = np.repeat([DEG_H, MG], 3)
    found, sigma = (
        np.concatenate([imu[f"gyro_{what}_rad_s"], imu[f"accel_{what}_m_s2"]]) / units for what in ("bias", "sigma_use")
    )
    told_of = np.concatenate(true) / units
    return [
        Row(axis, "own_imu", float(told_of[k]), float(found[k]), float(sigma[k]))
        for axis, k in zip(NAMED, OF_AXIS, strict=True)
    ]


RECOVERED_HEADER = (
    f"{'':24}{'unit':>16}{'flights':>9}{'injected':>10}{'error':>9}{'sigma':>9}{'within 2 sigma':>16}{'worst':>8}"
)


def recovered(rows: Sequence[Row]) -> list[str]:
    """The table: rms of what was injected and of the error, median sigma, share within two of them."""
    lines, all_within = [], 0
    for term in TERMS:
        for axis in NAMED:
            some = [row for row in rows if (row.axis, row.term) == (axis, term)]
            if not some:
                continue
            true, found, sigma = np.array([row[2:] for row in some]).T
            within = np.abs(found - true) <= 2.0 * sigma
            all_within += int(within.sum())
            unit = ("deg/h" if axis.startswith("gyro") else "mg") + {
                "vibration": " per m/s^2",
                "trend": " a minute",
            }.get(term, "")
            lines.append(
                f"{term.replace('_', '-') + ', ' + axis:24}{unit:>16}{len(some):9d}{_rms(true):10.2f}"
                f"{_rms(found - true):9.2f}{np.median(sigma):9.2f}{within.sum():9d} of {len(some):3d}"
                f"{np.max(np.abs(found - true) / sigma):8.1f}"
            )
    return [RECOVERED_HEADER, *lines, f"all: {all_within} of {len(rows)} ({all_within / max(len(rows), 1):.1%})"]


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(np.square(values))))

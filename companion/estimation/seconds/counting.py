"""Turn of an aircraft at its place, from gyro samples integrated as rotations.

Somebody who turns an aircraft also tilts it. Simulation of half a turn, gyro scales wrong by 1 %, axes 0.5 deg from
square: the integral of the rate about down is wrong by 0.5 deg at a tilt of 4 deg, by 5 deg at 12 deg. Rotations by all
three axes are wrong by 0.05 and 0.1 deg. The gyros' scale adds 1.8 deg, which a full circle shows (`align_model`).
"""

from __future__ import annotations

import math
from array import array
from typing import Final, NamedTuple

import numpy as np

from companion.physics.frames import Array, Floats, Matrix, rotations, running_products
from companion.samples import ImuSample

MAX_SAMPLES: Final = 60_000  # Ten minutes at 100 Hz, 2.4 MB, since the last pose; a longer turn is not counted
LEAST_SAMPLES: Final = 8
HOLE_S: Final = 0.05
"""Longest gap between samples beyond the usual interval, s: an aircraft turned at 60 deg/s moves 3 degrees in it."""
AT_REST_S: Final = 0.5  # Longest gap at rest: a turn from rest to rest takes longer
LATE_S: Final = 0.05
"""Largest delay of a sample, s. Beyond it, host's and device's clocks run at different rates (a slow simulator)."""
MOVES_RAD_S: Final = math.radians(0.5)
SIGMA_RAD: Final = math.radians(0.15)
"""Error of each turn due to non-orthogonal gyro axes of a tilted aircraft, 1 sigma; scale and time errors add to it."""


class Counted(NamedTuple):
    """Turn about the vehicle's z axis, clockwise from above, not wrapped; sigma excludes the gyros' scale error."""

    angle_rad: float
    sigma_rad: float


class TurnCounter:
    """Stores the latest rates of one IMU and integrates the turn between two times."""

    def __init__(self) -> None:
        self._samples = array("d")

    def add(self, sample: ImuSample) -> None:
        if len(self._samples) >= 5 * MAX_SAMPLES:
            del self._samples[:]
        device_s = math.nan if sample.t_device_s is None else sample.t_device_s
        self._samples.extend((sample.t_s, device_s, *sample.gyro_rad_s))

    def counted(
        self, start_s: float, end_s: float, bias_rad_s: Array, vehicle_from_sensor: Matrix, cut_rad_s: float = 0.0
    ) -> Counted | None:
        """Integrate the turn between two instants at rest, and drop older samples; None if samples are missing.

        `bias_rad_s` (3,): gyro bias, vehicle axes. `cut_rad_s`: step of rates that are truncated toward zero; else 0.
        """
        rows = np.array(self._samples).reshape(-1, 5)
        old = int(np.searchsorted(rows[:, 0], start_s))
        del self._samples[: 5 * old]
        rows = rows[old : int(np.searchsorted(rows[:, 0], end_s))]
        if len(rows) < LEAST_SAMPLES or rows[0, 0] - start_s > AT_REST_S or end_s - rows[-1, 0] > AT_REST_S:
            return None
        if (np.diff(rows[:, 1]) < -AT_REST_S).any():  # the device has restarted
            return None
        # Prefer the device's clock: transmission bunches samples and repeats some.
        times, rates, late_s = rows[:, 0], rows[:, 2:], 0.0
        device_s, order = np.unique(rows[:, 1], return_index=True)
        if np.isfinite(device_s).all() and 2 * len(device_s) > len(rows):
            times, rates, late_s = device_s, rows[order, 2:], abs(float(np.ptp(times) - np.ptp(device_s)))
        gaps = np.diff(times)
        if len(gaps) == 0 or max(gaps.max(), late_s) > AT_REST_S:
            return None
        rates = (rates + np.sign(rates) * cut_rad_s / 2.0) @ vehicle_from_sensor.T - bias_rad_s
        # Integrate only while it moves: at rest, truncation and a wandering bias would add up over minutes.
        moves_s = times[np.abs(rates).max(axis=1) > MOVES_RAD_S + cut_rad_s]
        if len(moves_s) == 0:
            return Counted(0.0, SIGMA_RAD)
        moves = (times > moves_s[0] - AT_REST_S) & (times < moves_s[-1] + AT_REST_S)
        times, rates = times[moves], rates[moves]
        if len(times) < LEAST_SAMPLES or np.diff(times).max() > np.median(gaps.tolist()) + HOLE_S:
            return None
        angle_rad = _turned_rad(times, rates)
        # The error of every fourth sample alone is twice the error of all from sampling and stamps.
        parts = [_turned_rad(times[k::4], rates[k::4]) - angle_rad for k in range(4)]
        off_pace = abs(angle_rad) * max(late_s - LATE_S, 0.0) / float(np.ptp(times))
        return Counted(angle_rad, math.hypot(SIGMA_RAD, float(np.linalg.norm(parts)) / math.sqrt(12.0), off_pace))


def _turned_rad(times_s: Floats, rates_rad_s: Floats) -> float:
    """Return the angle about z, not wrapped, of the rotation by rates (n, 3), which are integrated by trapezoids."""
    vectors = (rates_rad_s[1:] + rates_rad_s[:-1]) / 2.0 * np.diff(times_s)[:, None]
    turns = running_products(rotations(vectors))
    return float(np.unwrap(np.arctan2(turns[:, 1, 0] - turns[:, 0, 1], turns[:, 0, 0] + turns[:, 1, 1]))[-1])

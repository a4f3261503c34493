"""Check of sigma on a sensor: every window of a long still log is calibrated by itself, as after a start.

What it finds is held against what the windows after it find: the biases' difference has to come out within 2 sigma in
95 of 100 cases. How the sensor lay is the same in both, so that it cancels: the pose counts as known, and sigma is the
sensor's alone. Where it was moved in between, windows are not compared.
"""

from __future__ import annotations

import itertools
import math
import re
from collections import Counter
from collections.abc import Sequence
from typing import Final

import msgspec
import numpy as np

from companion.errors import StorageError
from companion.estimation.records.record import ImuRecord
from companion.lab.logs.log import StillLog
from companion.lab.replay.estimate import Given, estimate
from companion.physics.frames import Floats, roll_pitch_from_up, rotation_matrix
from companion.physics.units import DEG

MOST_WINDOWS: Final = 100_000
"""Eleven days of the shortest; a clock that jumps makes more."""
PAUSE_S: Final = 3.0
"""A sensor that was silent for longer may have been switched off."""
HORIZON_S: Final = 180.0
_AXES: Final = ("gyro x", "gyro y", "gyro z", "accel x", "accel y", "accel z")
_SAME_RAD: Final = 1.0 * DEG
"""More than any bias drifts by: gravity from elsewhere is another pose."""
_EXACT_DEG: Final = 1e-4
_LATITUDE_DEG: Final = 45.0
"""Any: the Earth's rate cancels, too."""


class AxisKept(msgspec.Struct, frozen=True, kw_only=True):
    """Predictions of one axis against the windows after them, rad/s or m/s^2."""

    axis: str
    next_s: float
    """Time after the window that is predicted."""
    pairs: int
    sigma_use: float
    """Median of what was promised."""
    rms: float
    """Root mean square of the misses."""
    ratio: float
    """Root mean square of a miss over its sigma; 1 where sigma is right."""
    share: float
    """Share within 2 sigma, the white noise of what comes after allowed for."""


class Windows(msgspec.Struct, frozen=True, kw_only=True):
    """A log cut into windows side by side."""

    length_s: float
    count: int
    done: int
    refused: dict[str, int]
    """Number of windows without a result by reason, the commonest first; reasons that differ in figures are one."""
    axes: tuple[AxisKept, ...]
    """None where fewer than two windows in a row gave a result."""


def windows(log: StillLog, given: Given, length_s: float) -> Windows:
    """Calibrate in every window of a length in seconds."""
    posed, force = given, np.zeros(3)
    found: list[Floats | None] = []
    """Bias, sigma_stat and sigma_use of each window, (3, 6); None: it gave none."""
    whys: list[str] = []
    begin_s = float(log.t_s[0])
    starts_s = np.concatenate(([begin_s], log.t_s[1:][np.diff(log.t_s) > PAUSE_S]))
    count = math.floor((float(log.t_s[-1]) - begin_s) / length_s + 1e-6)
    if count > MOST_WINDOWS:
        raise StorageError(f"{log.files[0]}: {count} windows from its first to its last time; allowed: {MOST_WINDOWS}")
    edges = np.searchsorted(log.t_s, begin_s + length_s * np.arange(count + 1))
    for start, end in itertools.pairwise(edges.tolist()):
        if end - start < 2:
            found.append(None)
            whys.append("no samples")
            continue
        part = msgspec.structs.replace(
            log, t_s=log.t_s[start:end], readings=log.readings[start:end],
            temperature_degc=log.temperature_degc[start:end],
        )  # fmt: skip
        here = part.readings[:, 3:].mean(axis=0)
        if not here @ force >= math.cos(_SAME_RAD) * np.linalg.norm(here) * np.linalg.norm(force) > 0.0:
            posed, force = _posed(here, given), here
            found.append(None)
        # What was switched on before the window says how far a warm-up may still go.
        at = int(np.searchsorted(starts_s, log.t_s[start], side="right")) - 1
        powered_s = float(log.t_s[start] - starts_s[at]) + (posed.powered if at == 0 else 0.0)
        record, _ = estimate(part, msgspec.structs.replace(posed, powered=powered_s), max_still_s=length_s)
        imu = record.imus[0] if record.imus else None
        one = None if imu is None else _figures(imu)
        found.append(one)
        if one is None:
            whys.append(record.reason if imu is None else "; ".join(imu.warnings))
    spans = sorted({1, math.ceil(HORIZON_S / length_s)})
    return Windows(
        length_s=length_s,
        count=count,
        done=count - len(whys),
        refused=_counted(whys),
        axes=tuple(each for span in spans for each in _kept(found, span, span * length_s)),
    )


def _posed(force: Floats, given: Given) -> Given:
    """Fill in what was not given: a pose by that specific force (3,), and a place, both exact."""
    mean = rotation_matrix(given.mounting) @ force
    roll_rad, pitch_rad = roll_pitch_from_up(mean / np.linalg.norm(mean))
    return msgspec.structs.replace(
        given,
        pitch_deg=pitch_rad / DEG if given.pitch_deg is None else given.pitch_deg,
        roll_deg=roll_rad / DEG if given.roll_deg is None else given.roll_deg,
        heading_deg=given.heading_deg or 0.0,
        sigma_deg=_EXACT_DEG,
        heading_sigma_deg=_EXACT_DEG,
        latitude_deg=_LATITUDE_DEG if given.latitude_deg is None else given.latitude_deg,
        height_m=given.height_m or 0.0,
    )


def _figures(imu: ImuRecord) -> Floats | None:
    gyro = (imu.gyro_bias_rad_s, imu.gyro_sigma_stat_rad_s, imu.gyro_sigma_use_rad_s)
    accel = (imu.accel_bias_m_s2, imu.accel_sigma_stat_m_s2, imu.accel_sigma_use_m_s2)
    return None if None in gyro or None in accel else np.hstack([np.array(gyro), np.array(accel)])


def _counted(whys: Sequence[str]) -> dict[str, int]:
    """Count reasons without their figures, the commonest first; the key is the first of a kind."""
    kinds = Counter(re.sub(r"\d+(\.\d+)?", "", why) for why in whys)
    first = {re.sub(r"\d+(\.\d+)?", "", why): why for why in reversed(whys)}
    return {first[kind]: count for kind, count in kinds.most_common()}


def _kept(found: Sequence[Floats | None], span: int, next_s: float) -> list[AxisKept]:
    """Compare every window with the mean of the `span` windows after it."""
    misses, uses, seen = [], [], []
    for at, one in enumerate(found):
        after = [each for each in found[at + 1 : at + 1 + span] if each is not None]
        if one is None or len(after) < span:
            continue
        bias, stat, _ = np.moveaxis(np.array(after), 1, 0)
        misses.append(one[0] - bias.mean(axis=0))
        uses.append(np.square(one[2]))
        seen.append(np.square(stat).mean(axis=0) / span)
    if not misses:
        return []
    columns = zip(_AXES, *(np.array(each).T for each in (misses, uses, seen)), strict=True)
    return [
        AxisKept(
            axis=axis,
            next_s=next_s,
            pairs=len(misses),
            sigma_use=float(np.sqrt(np.median(use))),
            rms=float(np.sqrt(np.square(miss).mean())),
            ratio=float(np.sqrt((np.square(miss) / (use + own)).mean())),
            share=float((np.square(miss) <= 4.0 * (use + own)).mean()),
        )
        for axis, miss, use, own in columns
    ]

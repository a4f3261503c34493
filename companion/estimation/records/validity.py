"""Validity check of the active calibration, which ages after its last confirmation.

A confirmed calibration was written and seen in the telemetry, or measured to be right. The error budget limits its
validity (method.md sections 2.2 and 3.2):

- age: the wander predicted by the sensor's Allan profile stays below `DRIFT_SIGMAS` sigma, for at most the configured
  limit (30 minutes);
- temperature: the bias change by the curve stays below `DRIFT_SIGMAS` sigma; without a curve 3 K, configurable;
- residual: output and expected output of the rolling window differ by less than `RESIDUAL_SIGMAS` combined sigmas.

Age and temperature count from the last motionless window that agreed. An aircraft that stands for an hour keeps its
calibration without a write.
"""

from __future__ import annotations

import enum
import functools
import math
from typing import Final, NamedTuple

import msgspec
import numpy as np

from companion.config.sections import AllanModel, Calibration
from companion.estimation.noise.allan import floor_variance
from companion.estimation.records.record import ImuRecord
from companion.messages import message
from companion.physics.units import UNITS
from companion.samples import Triad, Vector

DRIFT_SIGMAS: Final = 2.0
RESIDUAL_SIGMAS: Final = 3.0
RETURNED_SIGMAS: Final = 2.0
"""Threshold of a residual that was beyond RESIDUAL_SIGMAS: noise must not change the verdict every second."""
WORTH_SIGMAS: Final = 2.0
"""Least improvement that is worth a new write, in sigmas; a smaller one would mostly write noise."""

_LONGEST_S: Final = 24 * 3600.0
_NONE: Final[Vector] = (0.0, 0.0, 0.0)
_DIGITS: Final[dict[Triad, int]] = {"gyro": 0, "accel": 2}


class Why(enum.Enum):
    """Reason why the active calibration is not good enough; operators see the value as text."""

    NEVER = "not calibrated yet"
    UNDONE = "calibration was undone"
    REBOOTED = "autopilot restarted"
    REPLACED = "boot reset gyro offsets"
    ALIGNED = "gradienter aligned since then"
    CHANGED = "changed by someone else"
    FAILED = "last calibration failed"
    UNSEEN = "offsets written but not verified"
    OLD = "calibration too old"
    TEMPERATURE = "temperature changed"
    RESIDUAL = "biases moved"


class Held(msgspec.Struct, frozen=True, kw_only=True):
    """State of one triad of one IMU, in rad/s or m/s^2, with which later windows are compared.

    `calibrated_s` is None if the offsets were only measured to be right. `sigma_use` is the stated sigma. `sigma`, for
    comparisons, excludes the coming warm-up, which affects old and new offsets equally. `expected` is the output minus
    the true value: zero if the autopilot corrects, else the whole bias. `seen`: telemetry shows the offsets' effect.
    `averaged_s`: averaging time of the calibration.
    """

    calibrated_s: float | None
    confirmed_s: float  # Time of the last confirmation
    temperature_degc: float | None  # Temperature at the confirmation
    sigma_use: Vector
    sigma: Vector
    expected: Vector
    seen: bool
    averaged_s: float


def held_of(
    imu: ImuRecord, triad: Triad, now_s: float, averaged_s: float, *, corrected: bool, seen: bool
) -> Held | None:
    """Return one triad's state after its calibration; None: no result. `corrected`: the autopilot subtracts it."""
    bias = imu.of(triad).bias
    sigma, settled = imu.sigma_in_force(triad), imu.settled_sigma(triad)
    if sigma is None or settled is None or bias is None:
        return None
    return Held(
        calibrated_s=now_s,
        confirmed_s=now_s,
        temperature_degc=imu.temperature_degc,
        sigma_use=sigma,
        sigma=settled,
        expected=_NONE if corrected else bias,
        seen=seen,
        averaged_s=averaged_s,
    )


class Present(msgspec.Struct, frozen=True, kw_only=True):
    """Output of the rolling window minus the true value at this pose, in vehicle axes (FRD), rad/s or m/s^2."""

    residual: Vector
    sigma_use: Vector
    sigma: Vector  # `sigma_use` and `sigma` are as in `Held`
    limit_sigmas: float = RESIDUAL_SIGMAS


class Objection(NamedTuple):
    why: Why
    words: str


@functools.lru_cache(maxsize=128)
def age_limit_s(model: AllanModel, sigma: Vector, averaged_s: float) -> float:
    """Return the age, s, at which the predicted wander of a bias reaches DRIFT_SIGMAS times its sigma.

    The wander begins with a mean over `averaged_s` and excludes white noise. It is compared with the smallest axis of
    `sigma`. The returned age is at most a day, far beyond the configured limit.
    """
    horizons_s = np.geomspace(1.0, _LONGEST_S, 1200)
    drift = floor_variance(model.flicker, model.walk, averaged_s, horizons_s)
    return float(horizons_s[drift <= (DRIFT_SIGMAS * min(sigma)) ** 2].max(initial=1.0))


def judge(
    key: tuple[str, Triad],
    held: Held,
    model: AllanModel,
    limits: Calibration,
    *,
    now_s: float,
    temperature_degc: float | None = None,
    present: Present | None = None,
    drift: tuple[Vector, Vector] | None = None,
) -> list[Objection]:
    """List the reasons against one triad's active calibration; the list is empty while it is good.

    `now_s` is on the clock of `held`; `present` is a motionless window, or None. `drift` is the bias change by
    temperature since the confirmation in `held`, and the change's variance; None: unknown.
    """
    name, triad = key
    (unit, words, _), digits = UNITS[triad], _DIGITS[triad]
    found: list[Objection] = []
    if not held.seen:
        found.append(Objection(Why.UNSEEN, message("offsets_not_seen_to_work", triad=triad, imu=name)))
    if present is not None and (worst := worst_axis(held, present)) is not None:
        found.append(Objection(Why.RESIDUAL, _since(f"{triad} {name}", f"{worst / unit:.{digits}f} {words} off")))
    if held.temperature_degc is not None and temperature_degc is not None:
        change = temperature_degc - held.temperature_degc
        warmer = f"{abs(change):.0f} K {'warmer' if change > 0 else 'colder'}"
        if drift is not None:
            moved = max(math.sqrt(mean**2 + variance) for mean, variance in zip(*drift, strict=True))
            if moved > DRIFT_SIGMAS * max(held.sigma):
                off = f"about {moved / unit:.{digits}f} {words} off, {warmer}"
                found.append(Objection(Why.TEMPERATURE, _since(f"{triad} {name}", off)))
        elif abs(change) > limits.max_temperature_change_degc:
            found.append(Objection(Why.TEMPERATURE, _since(f"imu {name}", warmer)))
    limit_s = min(60.0 * limits.max_age_min, age_limit_s(model, held.sigma, held.averaged_s))
    if (age_s := now_s - held.confirmed_s) > limit_s:
        age, limit = f"{age_s / 60:.0f}", f"{limit_s / 60:.0f}"
        found.append(Objection(Why.OLD, message("calibration_old", age=age, limit=limit)))
    return found


def _since(part: str, change: str) -> str:
    return message("changed_since_calibration", part=part, change=change)


def _off(present: Present, expected: Vector, then: Vector, sigmas: float, floor: float = 0.0) -> list[float]:
    return [
        residual - wanted
        for residual, wanted, was, now in zip(present.residual, expected, then, present.sigma, strict=True)
        if abs(residual - wanted) > max(sigmas * math.hypot(was, now), floor)
    ]


def worst_axis(held: Held, present: Present) -> float | None:
    """Return the largest signed change of the output beyond `limit_sigmas` combined sigmas; None: all axes agree."""
    return max(_off(present, held.expected, held.sigma, present.limit_sigmas), key=abs, default=None)


def worth_writing(present: Present, held: Held | None, floor: float) -> bool:
    """Return True if new offsets would improve any axis by more than WORTH_SIGMAS sigmas and by more than `floor`.

    Sigma combines those of the window and of the active calibration, if any; `floor` is in rad/s or m/s^2.
    """
    expected, then = (_NONE, _NONE) if held is None else (held.expected, held.sigma)
    return bool(_off(present, expected, then, WORTH_SIGMAS, floor))

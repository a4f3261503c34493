"""A step in the telemetry is judged by the noise there really is, and not by what a few seconds of it look like."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from companion.autopilot.firmware.ardupilot import ArduPilotParameters
from companion.autopilot.firmware.imu_calibration import ImuCalibration
from companion.autopilot.parameters.change import Change
from companion.autopilot.parameters.verify import EffectVerdict
from companion.daemon.offsets.effect import LOOK_LONGER_S, LOOK_S, judge_vectors, why_look_longer
from companion.daemon.offsets.plan import ImuPlan
from companion.estimation.means.windows import ImuWindow

NOISE_RAD_S = 1e-4
"""Noise of a second's mean."""
STEP_RAD_S = 2e-5


def calibration() -> ImuCalibration:
    zero = (0.0, 0.0, 0.0)
    return ImuCalibration(
        instance=1,
        parameters=ArduPilotParameters(1),
        gyro_offset_rad_s=zero,
        accel_offset_m_s2=zero,
        accel_scale=(1.0, 1.0, 1.0),
        gyro_id=1,
        accel_id=1,
        orientation=np.eye(3),
    )


def window(seconds: Any, offset: Any) -> ImuWindow:
    """Window of second means (n, 3) in rad/s; sigma from their own scatter."""
    mean = seconds.mean(axis=0) - offset
    sigma = seconds.std(axis=0, ddof=1) / np.sqrt(len(seconds))
    return ImuWindow(
        name="fc",
        samples=50 * len(seconds),
        duration_s=float(len(seconds)),
        gyro_rad_s=tuple(mean.tolist()),
        accel_m_s2=(0.0, 0.0, -9.8),
        gyro_sigma_stat_rad_s=tuple(sigma.tolist()),
        accel_sigma_stat_m_s2=(1e-3, 1e-3, 1e-3),
        gyro_sigma_use_rad_s=tuple((sigma + 1e-9).tolist()),
        accel_sigma_use_m_s2=(1e-3, 1e-3, 1e-3),
        temperature_degc=None,
        warnings=(),
    )


def verdict_of(
    rng: np.random.Generator, spans: tuple[int, int], noise: Any, step: Any, made: Any = None
) -> EffectVerdict:
    """Judge a write of `step` (3,) after which the output moved by `made`; None: by `step`."""
    before = window(rng.normal(0.0, noise, (spans[0], 3)), 0.0)
    after = window(rng.normal(0.0, noise, (spans[1], 3)), step if made is None else made)
    names = ArduPilotParameters(1).gyro_offset
    changes = tuple(Change(name, 0.0, float(each)) for name, each in zip(names, step, strict=True))
    target = ImuPlan("fc", calibration(), changes, (np.asarray(step), None), watched=True)
    (verdict,) = judge_vectors(target, before, after, "icm42688p", {})
    return verdict


@pytest.mark.parametrize("spans", [(10, 10), (4, 2)])
def test_a_write_in_order_is_refused_in_less_than_one_of_200_and_one_without_effect_is_never_called_verified(
    spans: tuple[int, int],
) -> None:
    rng, count = np.random.default_rng(7), 400
    sigma = NOISE_RAD_S * np.sqrt(1 / spans[0] + 1 / spans[1])
    refused = dict.fromkeys((0.5, 1.0, 2.0, 5.0, 30.0), 0)
    for size in refused:
        for _ in range(count):
            step = size * sigma * rng.choice((-1.0, 1.0), 3)
            refused[size] += not verdict_of(rng, spans, NOISE_RAD_S, step).ok
            without = verdict_of(rng, spans, NOISE_RAD_S, step, made=np.zeros(3))
            assert not without.ok or without.hidden, f"{size} sigma: verified, without effect"
            assert size < 30.0 or not without.ok or spans[1] < 5, f"{size} sigma: not seen to be without effect"
    assert sum(refused.values()) < 0.005 * count * len(refused), refused


def test_a_step_that_is_not_the_one_written_is_refused_all_the_same() -> None:
    rng, step = np.random.default_rng(5), np.full(3, STEP_RAD_S)
    assert not any(verdict_of(rng, (12, 2), NOISE_RAD_S, step, made=np.full(3, -0.01)).ok for _ in range(50))


@pytest.mark.parametrize(
    ("problems", "sigma", "looked_s", "words"),
    [
        (("by chance",), 0.1, 2.0, "effect of the write not clear yet: hold still, measuring longer"),
        (("by chance",), 0.1, LOOK_S, ""),
        ((), 0.3, LOOK_S, "effect of the write not clear yet: hold still, measuring longer"),
        ((), 0.5, 2.0, ""),
        ((), 0.3, LOOK_LONGER_S + 0.1, ""),
    ],
    ids=["two seconds call nothing wrong", "ten do", "nearly visible", "hidden for good", "looked for long enough"],
)
def test_a_longer_look_is_worth_it_where_it_can_change_the_verdict(
    problems: tuple[str, ...], sigma: float, looked_s: float, words: str
) -> None:
    verdict = EffectVerdict(axes={}, fraction_sigma=sigma, problems=problems, hidden=("INS_GYROFFS_X",))
    assert why_look_longer({"fc": [verdict]}, looked_s) == words

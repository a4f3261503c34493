"""Processor time of the attitude estimator for each sample at 1 kHz."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Final

import numpy as np

from companion.attitude.estimator import AttitudeEstimator, AttitudeSettings
from companion.estimation.noise.allan import noise_profile
from companion.physics.units import DEG_H
from companion.samples import ImuSample

RATE_HZ: Final = 1000
SECONDS: Final = 4
ROUNDS: Final = 5
LIMIT_US: Final = 6.0


def _samples() -> list[ImuSample]:
    random = np.random.default_rng(1)
    noise = random.standard_normal((RATE_HZ * SECONDS, 6)) * 1e-3
    times = np.arange(1, len(noise) + 1) / RATE_HZ
    noise[:, 0] += 0.3 * np.sin(3.0 * times)
    noise[:, 5] -= 9.81
    return [
        ImuSample(t_s, (a, b, c), (d, e, f))
        for t_s, (a, b, c, d, e, f) in zip(times.tolist(), noise.tolist(), strict=True)
    ]


def _ours(samples: list[ImuSample], batch: int) -> Callable[[], object]:
    batches = [samples[at : at + batch] for at in range(0, len(samples), batch)]
    settings = AttitudeSettings(
        vehicle_from_sensor=np.eye(3),
        gravity_m_s2=9.81,
        latitude_deg=48.0,
        gyro_noise=noise_profile(None).gyro,
        gyro_bias_rad_s=(0.001, 0.002, 0.003),
        gyro_covariance=np.eye(3) * (10.0 * DEG_H) ** 2,
        accel_bias_m_s2=(0.01, 0.0, 0.0),
        accel_sigma_m_s2=(0.002,) * 3,
    )

    def work() -> None:
        estimator = AttitudeEstimator(settings)
        estimator.align(0.0, np.eye(3), np.eye(3) * 1e-4)
        for samples in batches:
            estimator.update(samples, phase="flight")

    return work


def _microseconds(work: Callable[[], object], count: int) -> float:
    best_s = math.inf
    for _ in range(ROUNDS):
        start_s = time.process_time()
        work()
        best_s = min(best_s, time.process_time() - start_s)
    return best_s / count * 1e6


def table() -> None:
    """Print it."""
    samples = _samples()
    work = {
        "companion, batches of 4 (250 reads a second)": _ours(samples, 4),
        "companion, batches of 20": _ours(samples, 20),
        "companion, one sample a call": _ours(samples, 1),
    }
    print(f"\nattitude at {RATE_HZ} Hz, us of processor time a sample (limit {LIMIT_US:g}):")
    for name, one in work.items():
        print(f"  {name:46} {_microseconds(one, len(samples)):6.2f}")


if __name__ == "__main__":
    table()

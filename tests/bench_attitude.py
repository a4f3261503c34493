"""What an attitude costs a sample at 1 kHz, beside the filters of others on the same samples in the same run.

Theirs are compiled (vqf: C++, imufusion: C) and called once a sample, as a daemon would have to; none of them carries a
covariance or the Earth's rotation.
"""

from __future__ import annotations

import importlib.util
import math
import time
from collections.abc import Callable
from typing import Final

import numpy as np

from companion.attitude.estimator import AttitudeEstimator, AttitudeSettings
from companion.calibration.noise.allan import noise_profile
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


def _vqf(samples: list[ImuSample]) -> Callable[[], object]:
    from vqf import VQF

    rows = [(np.array(sample.gyro_rad_s), np.array(sample.accel_m_s2)) for sample in samples]

    def work() -> None:
        update = VQF(1.0 / RATE_HZ).update
        for gyro, accel in rows:
            update(gyro, accel)

    return work


def _imufusion(samples: list[ImuSample]) -> Callable[[], object]:
    import imufusion

    degrees = 180.0 / math.pi
    rows = [(np.array(s.gyro_rad_s) * degrees, np.array(s.accel_m_s2) / 9.81) for s in samples]

    def work() -> None:
        ahrs = imufusion.Ahrs()
        ahrs.set_sample_period(1.0 / RATE_HZ)
        update = ahrs.update_no_magnetometer
        for gyro, accel in rows:
            update(gyro, accel)

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
    for name, package, make in (
        ("vqf, one sample a call", "vqf", _vqf),
        ("imufusion, likewise", "imufusion", _imufusion),
    ):
        if importlib.util.find_spec(package) is not None:
            work[name] = make(samples)
    print(f"\nattitude at {RATE_HZ} Hz, us of processor time a sample (at most {LIMIT_US:g} wanted of ours):")
    for name, one in work.items():
        print(f"  {name:46} {_microseconds(one, len(samples)):6.2f}")


if __name__ == "__main__":
    table()

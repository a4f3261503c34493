"""Attitude filters of others, each from its own package, on the same calibrated samples.

They know forward-left-up and a frame with z up; P, half a turn about x, goes both ways. None of them is given a
magnetometer here: this is about tilt, and their headings are those of the gyros.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from typing import Any, Final

import numpy as np

from companion.attitude.quaternion import Quaternion, from_rotation_vector, multiply, roll_pitch_yaw
from companion.attitude.strapdown import Strapdown
from companion.samples import ImuSample
from sim.earth import Array
from sim.experiments.still import Still
from sim.experiments.trials import Follower, Setup

_P: Final[Quaternion] = (0.0, 1.0, 0.0, 0.0)


def _calibrated(still: Still, samples: list[ImuSample]) -> tuple[Array, Array]:
    """Rates and forces in forward-left-up, contiguous."""
    found = still.imu
    flip = np.array([1.0, -1.0, -1.0])
    assert found.gyro_rad_s is not None
    assert found.accel_m_s2 is not None
    rates = (np.array([sample.gyro_rad_s for sample in samples]) - found.gyro_rad_s) * flip
    forces = (np.array([sample.accel_m_s2 for sample in samples]) - found.accel_m_s2) * flip
    return np.ascontiguousarray(rates), np.ascontiguousarray(forces)


def _back(start: Quaternion, quaternions: Array) -> list[Quaternion]:
    """Forward-left-up to z-up into body FRD to NED, turned about the vertical to begin with the heading of `start`."""
    found: list[Quaternion] = []
    turn: Quaternion | None = None
    for w, x, y, z in quaternions.tolist():
        q = multiply(_P, multiply((w, x, y, z), _P))
        if turn is None:
            turn = from_rotation_vector((0.0, 0.0, roll_pitch_yaw(start)[2] - roll_pitch_yaw(q)[2]))
        found.append(multiply(turn, q))
    return found


def _forward(start: Quaternion) -> Array:
    """Body FRD to NED into what the packages begin with."""
    return np.array(multiply(_P, multiply(start, _P)))


def gyro_only(setup: Setup, still: Still, start: Quaternion, samples: list[ImuSample]) -> list[Quaternion]:
    """Strapdown on calibrated rates, and nothing else."""
    strapdown = Strapdown()
    x, y, z = (float(value) for value in still.imu.gyro_rad_s) if still.imu.gyro_rad_s is not None else (0.0, 0.0, 0.0)
    strapdown.bias_rad_s = (x, y, z)
    n, e, d = still.local.rate_ned_rad_s.tolist()
    strapdown.frame_rate_rad_s = (n, e, d)
    strapdown.restart(start, samples[0].t_s - 1.0 / setup.rate_hz)
    found = []
    for sample in samples:
        strapdown.integrate([sample])
        found.append(strapdown.orientation)
    return found


def _vqf(tau_acc_s: float, *, motion_bias: bool) -> Follower:
    def follow(setup: Setup, still: Still, start: Quaternion, samples: list[ImuSample]) -> list[Quaternion]:
        from vqf import VQF

        filter_: Any = VQF(1.0 / setup.rate_hz, tauAcc=tau_acc_s, motionBiasEstEnabled=motion_bias)
        rates, forces = _calibrated(still, samples)
        return _back(start, filter_.updateBatch(rates, forces)["quat6D"])

    return follow


def vqf_default(setup: Setup, still: Still, start: Quaternion, samples: list[ImuSample]) -> list[Quaternion]:
    """VQF as it comes: tau 3 s, bias estimation in motion."""
    return _vqf(3.0, motion_bias=True)(setup, still, start, samples)


def vqf_slow(setup: Setup, still: Still, start: Quaternion, samples: list[ImuSample]) -> list[Quaternion]:
    """VQF with tau 30 s and no bias estimation in motion."""
    return _vqf(30.0, motion_bias=False)(setup, still, start, samples)


def madgwick(setup: Setup, still: Still, start: Quaternion, samples: list[ImuSample]) -> list[Quaternion]:
    """Madgwick's filter of the package ahrs, gain 0.1."""
    from ahrs.filters import Madgwick

    rates, forces = _calibrated(still, samples)
    return _stepped(Madgwick(frequency=setup.rate_hz, gain=0.1).updateIMU, start, rates, forces)


def mahony(setup: Setup, still: Still, start: Quaternion, samples: list[ImuSample]) -> list[Quaternion]:
    """Mahony's filter of the package ahrs, its own gains (1, 0.3)."""
    from ahrs.filters import Mahony

    rates, forces = _calibrated(still, samples)
    return _stepped(Mahony(frequency=setup.rate_hz).updateIMU, start, rates, forces)


def _stepped(
    step: Callable[[Array, Array, Array], Array], start: Quaternion, rates: Array, forces: Array
) -> list[Quaternion]:
    q, found = _forward(start), np.empty((len(rates), 4))
    for number in range(len(rates)):
        found[number] = q = step(q, rates[number], forces[number])
    return _back(start, found)


def available() -> tuple[dict[str, Follower], str]:
    """The methods whose packages are installed, and what is missing."""
    known: dict[str, tuple[str, Follower]] = {
        "gyros only": ("math", gyro_only),
        "VQF (3 s)": ("vqf", vqf_default),
        "VQF (30 s)": ("vqf", vqf_slow),
        "Madgwick": ("ahrs", madgwick),
        "Mahony": ("ahrs", mahony),
    }
    missing = sorted({package for package, _ in known.values() if importlib.util.find_spec(package) is None})
    found = {name: follower for name, (package, follower) in known.items() if package not in missing}
    words = f"not installed, so not compared: {', '.join(missing)} (pip install {' '.join(missing)})"
    return found, words if missing else ""

"""Third-party recordings that lie outside the repository; tests skip where they are absent."""

from __future__ import annotations

import gzip
import os
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray
from pyulog import ULog

from companion.samples import ImuSample

Floats = NDArray[np.float64]

G_XIO = 9.80665
XSENS_RAD_S = 1.0 / 4778.0
XSENS_MIDDLE = 32768.0


def shared(relative: str) -> Path:
    """A file of the shared folder, or a skip that says which one is missing."""
    root = os.environ.get("COMPANION_SHARED")
    base = Path(root) if root else Path(__file__).resolve().parents[2] / ".." / "shared"
    path = base / "data" / relative
    if not path.exists():
        pytest.skip(f"the recording {relative} is not here (COMPANION_SHARED names the folder)")
    return path


class Recording(NamedTuple):
    """(n,) seconds, (n, 3) rad/s, (n, 3) m/s^2."""

    t_s: Floats
    gyro: Floats
    accel: Floats

    def samples(self) -> Iterator[ImuSample]:
        for t, (gx, gy, gz), (ax, ay, az) in zip(
            self.t_s.tolist(), self.gyro.tolist(), self.accel.tolist(), strict=True
        ):
            yield ImuSample(t, (gx, gy, gz), (ax, ay, az))


def px4() -> Recording:
    """PX4 hardware, handled until 8 s, then at rest and warming up; time from the first sample on."""
    found = ULog(str(shared("px4_pyulog/sample.ulg")), ["sensor_combined"]).get_dataset("sensor_combined").data
    time = found["timestamp"] * 1e-6
    gyro, accel = (
        np.column_stack([found[f"{name}[{k}]"] for k in range(3)]).astype(np.float64)
        for name in ("gyro_rad", "accelerometer_m_s2")
    )
    return Recording(time - time[0], gyro, accel)


def xsens_counts() -> Recording:
    """imu_tk: raw accelerometer counts; rates in rad/s with the middle of the range taken off."""
    with gzip.open(shared("imu_tk/xsens_gyro.mat.gz")) as file:
        gyro = np.loadtxt(file)
    with gzip.open(shared("imu_tk/xsens_acc.mat.gz")) as file:
        accel = np.loadtxt(file)
    return Recording(gyro[:, 0], (gyro[:, 1:] - XSENS_MIDDLE) * XSENS_RAD_S, accel[:, 1:])


def xio(name: str) -> Recording:
    """A CSV of x-io Technologies: deg/s and g."""
    with gzip.open(shared(f"xio/{name}")) as file:
        rows = np.loadtxt(file, delimiter=",", skiprows=1)
    return Recording(rows[:, 0], np.radians(rows[:, 1:4]), rows[:, 4:7] * G_XIO)

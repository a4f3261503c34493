"""`python -m sim rest FILE.csv`: a log of a simulated IMU at rest for hours, to try `companion log profile` with."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np

from sim.aircraft import Pose, VirtualAircraft
from sim.imu_model import DEG_H, MG, PARTS, ImuModel
from sim.scenario import site_at

HEAD: Final = "t_s,gx_rad_s,gy_rad_s,gz_rad_s,ax_m_s2,ay_m_s2,az_m_s2"
_AT_ONCE_S: Final = 100.0


def write(path: Path, part: str, hours: float, rate_hz: float, seed: int) -> int:
    """Write the log; return the number of samples."""
    model = ImuModel(
        VirtualAircraft(Pose(pitch_deg=2.0, roll_deg=-1.0, heading_deg=40.0), site_at(40.0, 116.0, 50.0)),
        part,
        seed=seed,
        gyro_bias_rad_s=[160.0 * DEG_H, -100.0 * DEG_H, 40.0 * DEG_H],
        accel_bias_m_s2=[2.4 * MG, -2.1 * MG, 0.9 * MG],
    )
    count, block = round(hours * 3600.0 * rate_hz), max(1, round(_AT_ONCE_S * rate_hz))
    with path.open("w", encoding="utf-8") as file:
        file.write(HEAD + "\n")
        for first in range(0, count, block):
            times = np.arange(first, min(first + block, count)) / rate_hz
            rows = np.column_stack([times, model.read(times, 1.0 / rate_hz)])
            np.savetxt(file, rows, fmt=["%.6f", *["%.9g"] * 6], delimiter=",")
    return count


def parser() -> argparse.ArgumentParser:
    made = argparse.ArgumentParser(prog="python -m sim rest", description=(__doc__ or "").partition(": ")[2])
    made.add_argument("file", type=Path, metavar="FILE")
    made.add_argument("--part", choices=sorted(PARTS), default="adis16470")
    made.add_argument("--hours", type=float, default=1.0)
    made.add_argument("--rate-hz", type=float, default=100.0)
    made.add_argument("--seed", type=int, default=1)
    return made


def main(arguments: Sequence[str]) -> int:
    made = parser()
    options = made.parse_args(arguments)
    if not 0.01 <= options.hours <= 24.0 or not 4.0 <= options.rate_hz <= 4000.0:
        made.error("allowed: --hours from 0.01 to 24, --rate-hz from 4 to 4000")
    count = write(options.file, options.part, options.hours, options.rate_hz, options.seed)
    print(f"{options.file}: {count} samples of an {options.part} at rest")
    return 0

"""`python -m sim turntable`: the paper's five poses (Tables 1 and 2), through wire formats and estimator, many seeds.

The biases are those of the tables, each pose with its own, as the paper measured them; the tilt reference errs by the
turntable's 10 arc seconds. What is left is compared with the bias during the calibration (what the paper must have
done), and with the bias of the three minutes after it (what counts in flight).
"""

from __future__ import annotations

import argparse
import datetime
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from companion.report.markup import Markup, tag
from companion.report.page import page
from sim.aircraft import Pose, VirtualAircraft
from sim.devices import HMR3300, Gradienter, VectorNavBinary
from sim.earth import STANDARD_GRAVITY_M_S2, Array
from sim.experiments.still import Wire, calibrate
from sim.experiments.trials import rms
from sim.imu_model import DEG_H, ImuModel
from sim.scenario import site_at

TABLE_SIGMA_DEG: Final = 10.0 / 3600.0
NEXT_S: Final = 180.0
RFU_TO_FRD: Final = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


@dataclass(frozen=True, slots=True)
class Group:
    """One pose of the tables. Accelerations in g, rates in deg/h; axes E, N, U of the body: right, forward, up."""

    pitch_deg: float
    roll_deg: float
    accel_g: tuple[float, float, float]
    paper_left_g: tuple[float, float, float]
    gyro_deg_h: tuple[float, float, float]


GROUPS: Final = (
    Group(0, 0, (-0.0012, 6.928e-4, -5.1506e-4), (-8.16639e-5, 5.0125e-5, -4.5908e-9), (66.294, 68.3424, 60.1932)),
    Group(0, 5, (-5.5739e-4, -0.0010068, 3.4809e-4), (9.036e-5, 3.1608e-5, -7.91e-6), (-89.532, -98.564, -72.196)),
    Group(0, -5, (2.1593e-4, -0.0022118, 1.2953e-3), (2.8914e-5, -1.5568e-5, 2.5291e-6), (60.294, 124.657, 108.289)),
    Group(5, 0, (0.0024125, 0.0021596, 8.9809e-4), (-8.1354e-5, 4.9918e-5, 4.3627e-6), (162.234, 169.563, 98.289)),
    Group(-5, 0, (0.0017076, 5.5211e-4, 2.7490e-3), (1.7039e-6, 3.3974e-5, -2.9729e-6), (-131.544, 100.8, -79.265)),
)
"""Tables 1 and 2 as printed; the first U residual cannot be right (method 1.3)."""
PAPER_MEAN_G: Final = (5.680e-5, 3.624e-5, 3.556e-6)
"""Means of the absolute values of the rows, worked out again: the text prints 3.650e-5 and 3.502e-6."""


def one(group: Group, seed: int, part: str, seconds: float) -> Array:
    """Errors of one calibration (2, 6): against the window's bias and the next minutes'; gyro deg/h, accel g; E N U."""
    random = np.random.default_rng([seed, 11])
    site = site_at(40.0, 116.0, 50.0)
    aircraft = VirtualAircraft(Pose(group.pitch_deg, group.roll_deg, float(random.uniform(0.0, 360.0))), site)
    x, y, z = (RFU_TO_FRD @ np.array(group.gyro_deg_h) * DEG_H).tolist()
    u, v, w = (RFU_TO_FRD @ np.array(group.accel_g) * STANDARD_GRAVITY_M_S2).tolist()
    imu = ImuModel(aircraft, part, seed=seed, gyro_bias_rad_s=(x, y, z), accel_bias_m_s2=(u, v, w))
    offset = random.normal(size=2) * TABLE_SIGMA_DEG
    still = calibrate(
        Wire("imu", VectorNavBinary(imu, rate_hz=100.0)),
        Wire("gradienter", Gradienter(aircraft, seed=seed, offset_deg=(float(offset[0]), float(offset[1])))),
        Wire("compass", HMR3300(aircraft, seed=seed, heading_error_deg=float(random.normal()))),
        site,
        seconds=seconds,
        profile=part,
        law="axis",
        tilt_sigma_deg=TABLE_SIGMA_DEG,
        heading_sigma_deg=1.0,
    )
    assert still.imu.gyro_rad_s is not None
    assert still.imu.accel_m_s2 is not None
    rows = []
    for begin_s, end_s in ((0.0, seconds), (seconds, seconds + NEXT_S)):
        truth = imu.mean_bias(begin_s, end_s)
        gyro = RFU_TO_FRD @ (still.imu.gyro_rad_s - truth.gyro_rad_s) / DEG_H
        accel = RFU_TO_FRD @ (still.imu.accel_m_s2 - truth.accel_m_s2) / STANDARD_GRAVITY_M_S2
        rows.append(np.concatenate([gyro, accel]))
    return np.array(rows)


def main(argv: Sequence[str]) -> int:
    """Run it; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m sim turntable", description=__doc__.split("\n\n")[0])
    parser.add_argument("--seeds", type=int, default=20, help="of each pose (default 20)")
    parser.add_argument("--jobs", type=int, default=2, help="processes (default 2)")
    parser.add_argument("--seconds", type=float, default=60.0, help="of standing still (default 60)")
    parser.add_argument("--html", type=Path, metavar="FILE", help="write a page as well")
    arguments = parser.parse_args(argv)
    if arguments.seeds < 1 or arguments.jobs < 1 or not 10 <= arguments.seconds <= 600:
        parser.error("--seeds and --jobs are at least 1, --seconds from 10 to 600")
    parts: list[Markup] = [tag("h1", "The turntable of the paper")]
    for part in ("adis16405", "icm42688p"):
        lines = table(part, arguments.seeds, arguments.seconds, arguments.jobs)
        print("\n".join(lines), end="\n\n")
        parts += [tag("h2", part), tag("div", tag("pre", "\n".join(lines), class_="mono"), style="overflow-x:auto")]
    if arguments.html is not None:
        now = datetime.datetime.now(datetime.UTC)
        arguments.html.write_text(
            page("The turntable of the paper", now, *parts, source="by simulation"), encoding="utf-8"
        )
        print(f"Page: {arguments.html}")
    return 0


def table(part: str, seeds: int, seconds: float, jobs: int) -> list[str]:
    """The rows, for one part."""
    work = [(group, seeds * row + n, part, seconds) for row, group in enumerate(GROUPS) for n in range(seeds)]
    with ProcessPoolExecutor(jobs) as pool:
        found = np.array(list(pool.map(one, *zip(*work, strict=True)))).reshape(len(GROUPS), seeds, 2, 6)
    lines = [
        f"{part}, {seconds:.0f} s of standing still, {seeds} seeds a pose; axes E N U of the body; ug and deg/h, rms",
        "",
        "pitch roll     initial accel, ug    left (window)    left (next 180 s)  the paper's left",
    ]
    for group, errors in zip(GROUPS, found, strict=True):
        window, after = rms(errors[:, 0]), rms(errors[:, 1])
        lines.append(
            f"{group.pitch_deg:5.0f}{group.roll_deg:5.0f}  "
            + _row(np.array(group.accel_g) * 1e6, "7.0f")
            + _row(window[3:] * 1e6, "6.1f")
            + _row(after[3:] * 1e6, "6.1f")
            + _row(np.abs(group.paper_left_g) * 1e6, "6.1f")
        )
    whole = found.reshape(-1, 2, 6)
    lines.append(
        f"{'all':>10}  "
        + _row(rms(np.array([group.accel_g for group in GROUPS])) * 1e6, "7.0f")
        + _row(rms(whole[:, 0])[3:] * 1e6, "6.1f")
        + _row(rms(whole[:, 1])[3:] * 1e6, "6.1f")
        + _row(np.array(PAPER_MEAN_G) * 1e6, "6.1f")
    )
    lines += ["", "pitch roll   initial gyro, deg/h    left (window)    left (next 180 s)  the paper's left"]
    for group, errors in zip(GROUPS, found, strict=True):
        window, after = rms(errors[:, 0]), rms(errors[:, 1])
        lines.append(
            f"{group.pitch_deg:5.0f}{group.roll_deg:5.0f}  "
            + _row(np.array(group.gyro_deg_h), "7.1f")
            + _row(window[:3], "6.1f")
            + _row(after[:3], "6.1f")
            + "   < 15"
        )
    lines.append(
        f"{'all':>10}  "
        + _row(rms(np.array([group.gyro_deg_h for group in GROUPS])), "7.1f")
        + _row(rms(whole[:, 0])[:3], "6.1f")
        + _row(rms(whole[:, 1])[:3], "6.1f")
        + "   < 15"
    )
    return lines


def _row(values: Array, form: str) -> str:
    return "".join(f"{float(value):{form}}" for value in values) + "  "

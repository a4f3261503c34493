"""A part that was just switched on: its age is its device's, its sigma says why, and no comparison counts a warm-up."""

from __future__ import annotations

import asyncio
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from companion.estimation.records.record import ImuRecord
from sim.imu_model import DEG_H
from tests.e2e.test_automatic import calibrated_by_itself
from tests.e2e.test_calibration import calibrated
from tests.support.rig import Rig
from tests.support.virtual_time import run_virtual

HOUR_S = 3600.0


def without_thermometer(folder: Path, **options: Any) -> Rig:
    """Its IMUs say 0, which in MAVLink means that there is no thermometer."""
    rig = Rig(folder, **options)
    for model in rig.models:
        model.temperature_degc = lambda t_s: 0.0  # type: ignore[method-assign]
    return rig


def found(folder: Path, **options: Any) -> tuple[ImuRecord, str, float]:
    """What a calibration finds in the autopilot's IMU, its reason, and how long it took."""

    async def main() -> tuple[ImuRecord, str, float]:
        async with without_thermometer(folder, **options).running() as rig:
            await rig.ready()
            begun_s = rig.now_s
            result, record = await calibrated(rig)
            assert result.outcome == "done", result
            return record.imus[0], record.reason, rig.now_s - begun_s

    return run_virtual(main())


def largest(values: Any) -> float:
    return float(np.max(values)) / DEG_H


def test_a_daemon_that_starts_late_does_not_take_an_autopilot_for_young(tmp_path: Path) -> None:
    imu, reason, _ = found(tmp_path, up_s=HOUR_S)
    assert largest(imu.gyro_sigma_warm_up_rad_s) < 5.0
    assert "warming" not in reason
    assert not any("warming" in words for words in imu.warnings)


def test_one_just_switched_on_says_why_its_sigma_is_wide_and_takes_no_longer(tmp_path: Path) -> None:
    part = {"part": "bmi088"}
    young, reason, took_s = found(tmp_path / "young", up_s=2.0, **part)
    old, _, old_s = found(tmp_path / "old", up_s=HOUR_S, **part)
    assert largest(young.gyro_sigma_use_rad_s) > 5.0 * largest(old.gyro_sigma_use_rad_s)
    assert "deg/h warming" in reason
    (words,) = [words for words in young.warnings if "warming" in words]
    assert words.startswith("gyro fc: on for ")
    later = re.search(r"; after (\d+) min about (\d+) deg/h$", words)
    assert later is not None
    assert float(later[2]) * DEG_H < 0.7 * largest(young.gyro_sigma_use_rad_s)
    assert took_s < old_s + 3.0
    # Whole: the part, and the rest that is as ever.
    rest = young.settled_sigma("gyro")
    assert rest is not None
    assert largest(rest) == pytest.approx(largest(old.gyro_sigma_use_rad_s), rel=0.3)


def test_offsets_that_are_wrong_are_not_called_right_because_both_may_warm_up(tmp_path: Path) -> None:
    """170 deg/h off, with a sigma of 200 for what a warm-up may do to old and new ones alike."""

    async def main() -> None:
        async with without_thermometer(tmp_path, part="bmi088", at_arm="gate", up_s=2.0).running() as rig:
            await calibrated_by_itself(rig)
            left = rig.double.residual(1, rig.now_s)
            assert np.abs(left.gyro_rad_s).max() < 40.0 * DEG_H
            # And once it is in force a warm-up that might be does not have it written again and again.
            await asyncio.sleep(120.0)
            assert len(rig.service.calibrating.store.history()) == 1

    run_virtual(main())

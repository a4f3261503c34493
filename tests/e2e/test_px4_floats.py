"""A calibration of PX4's first IMU in floats, from request to READY, and the gate while the stream changes."""

from __future__ import annotations

import asyncio
from pathlib import Path

import numpy as np

from sim.imu_model import DEG_H, MG
from tests.e2e.test_calibration import calibrated
from tests.support.rig import Rig
from tests.support.virtual_time import run_virtual


def test_the_first_imu_is_calibrated_in_floats_and_the_gate_stays_open_when_they_come_back(tmp_path: Path) -> None:
    async def main() -> None:
        async with Rig(tmp_path, firmware="px4", imus=1, max_s=13.0, imu_rate_hz=100.0).running() as rig:
            await rig.ready()
            stream = next(iter(rig.service.devices.imus.values())).stream
            _, record = await calibrated(rig)
            (fc,) = record.imus
            assert set(fc.written) >= {"CAL_GYRO0_XOFF", "CAL_ACC0_ZOFF"}
            assert all(item.outcome == "verified" for item in fc.written.values())
            assert max(fc.gyro_sigma_stat_rad_s or ()) < 6.0 * DEG_H  # integers of thirteen seconds: 12 and more
            left = rig.autopilot.residual(1, rig.now_s)
            assert np.abs(left.gyro_rad_s).max() < 18.0 * DEG_H
            assert np.abs(left.accel_m_s2).max() < 0.15 * MG
            # The integers have seen the new offsets; then, once PX4's estimator is settled, it is floats again.
            assert stream.kind is not None
            assert stream.kind.message == "SCALED_IMU"
            await asyncio.sleep(1.0)
            waits = []
            for _ in range(350):
                await asyncio.sleep(0.2)
                answer = rig.service.arming.readiness.answer()
                if answer.verdict != "accept":
                    waits.append((rig.now_s, answer.words))
            assert waits == []
            assert stream.kind.message == "HIGHRES_IMU+bias"

    run_virtual(main())

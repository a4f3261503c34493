"""An IMU that is mounted upside down is named and not written; the other IMU is calibrated."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sim.imu_model import MG
from tests.e2e.test_calibration import calibrated
from tests.support import rig as rigs
from tests.support.rig import Rig

WRONG = 'protocol = "vectornav"\nmounting = "ROTATION_ROLL_180"'


def summary(rig: Rig, name: str) -> tuple[bool, str]:
    return next((each["good"], each["summary"]) for each in rig.service.status()["devices"] if each["name"] == name)


async def test_an_imu_that_is_upside_down_is_named_and_the_other_is_calibrated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rigs, "OWN", rigs.OWN.replace('protocol = "vectornav"', WRONG))

    async with Rig(tmp_path, own_imu=True).running() as rig:
        await rig.ready()
        result, record = await calibrated(rig, timeout_s=60.0)
        assert result.outcome == "done", result
        fc, own = record.imus
        assert fc.written
        assert fc.accel_bias_m_s2 is not None
        assert np.abs(fc.accel_bias_m_s2).max() < 10.0 * MG
        assert own.gyro_bias_rad_s is None
        assert own.accel_bias_m_s2 is None
        (words,) = [words for words in own.warnings if "points" in words]
        assert words.startswith("accel own: z points up, by the tilt z points down: mounting = ")
        assert '"ROTATION_NONE"' in words
        assert "not known: own gyro" in result.reason or "gyro own" in result.reason
        good, said = summary(rig, "own")
        assert not good
        assert "z points up" in said

"""A compass in magnetometer mode, from its bytes to the record, in a clean and in a disturbed field."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from companion.cli.show import record_lines, status_lines
from companion.config import parse
from companion.estimation.records.record import Record
from sim.devices import COUNTS_PER_GAUSS, HMR3300
from tests.e2e.test_calibration import calibrated
from tests.support.rig import POSE, Rig

SCALE = f"counts_per_gauss = {COUNTS_PER_GAUSS}\n"


class MagneticRig(Rig):
    """A rig whose compass sends magnetometer lines."""

    def __init__(self, folder: Path, *, compass_keys: str = SCALE, **more: Any) -> None:
        super().__init__(folder, min_still_s=10.0, max_s=15.0, **more)
        text = self.text.replace('protocol = "hmr3300"\n', f'protocol = "hmr3300"\n{compass_keys}')
        self.config = parse(text, "rig.toml")
        compass = self.devices["compass"]
        assert isinstance(compass, HMR3300)
        compass.command(b"*M\r\n", 0.0)


async def measured(rig: Rig) -> Record:
    await rig.ready()
    result, record = await calibrated(rig)
    assert result.outcome == "done", result
    assert record.pose is not None
    return record


async def test_magnetometer_lines_give_a_heading_with_the_gradienters_tilt_and_a_bound(tmp_path: Path) -> None:
    async with MagneticRig(tmp_path).running() as rig:
        record = await measured(rig)
        assert record.magnetic is not None
        assert record.magnetic.heading_from == "field"
        assert record.pose is not None
        assert record.pose.psi_deg == pytest.approx(POSE.heading_deg, abs=0.2)
        assert record.magnetic.heading_bound_deg is not None
        assert record.magnetic.heading_bound_deg < 2.0
        assert record.magnetic.field_gauss == pytest.approx(rig.site.field_gauss, rel=0.002)
        assert record.magnetic.inclination_deg == pytest.approx(rig.site.inclination_deg, abs=0.1)
        assert not [words for words in record.warnings if "compass" in words]
        true = rig.model.true_bias(rig.aircraft.time_at(rig.now_s))
        (imu,) = record.imus
        assert imu.gyro_bias_rad_s is not None
        assert imu.gyro_sigma_use_rad_s is not None
        off = np.abs(np.subtract(imu.gyro_bias_rad_s, true.gyro_rad_s)) / imu.gyro_sigma_use_rad_s
        assert off.max() < 3.5
        import msgspec

        lines = record_lines(msgspec.to_builtins(record))
        assert any(line.startswith("compass: heading good to 1.") for line in lines)
        status = rig.service.status()
        assert any(line.startswith("compass: heading good to 1.") for line in status_lines(status))
        assert "profile fc: icm42688p, of the catalogue" in status_lines(status)
        pose = status["pose"]
        assert pose["heading_deg"] == pytest.approx(POSE.heading_deg - rig.site.declination_deg, abs=0.5)

"""A compass in magnetometer mode, from its bytes to the record, in a clean and in a disturbed field."""

from __future__ import annotations

import asyncio
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from companion.cli.show import record_lines, status_lines
from companion.config import parse
from companion.estimation.records.record import Record
from companion.physics.frames import wrap_deg
from sim.aircraft import Iron
from sim.devices import COUNTS_PER_GAUSS, HMR3300
from sim.imu_model import DEG_H
from tests.e2e.test_calibration import calibrated
from tests.support.rig import POSE, Rig
from tests.support.virtual_time import run_virtual

EARTH_RATE_RAD_S = 7.292115e-5
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


def test_magnetometer_lines_give_a_heading_with_the_gradienters_tilt_and_a_bound(tmp_path: Path) -> None:
    async def main() -> None:
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

    run_virtual(main())


def test_a_magnet_of_the_aircraft_is_bounded_warned_of_and_widens_the_gyros(tmp_path: Path) -> None:
    async def main() -> None:
        together = {}
        for name, iron in (
            ("clean", Iron()),
            ("magnet", Iron(body_gauss=(0.012, 0.014, -0.010))),
            ("car", Iron(dipole_a_m2=(150.0, 60.0, 40.0), dipole_at_m=(1.5, 1.2, 0.2))),
        ):
            rig = MagneticRig(tmp_path / name)
            rig.aircraft.iron = iron
            async with rig.running():
                record = await measured(rig)
            assert record.magnetic is not None
            assert record.pose is not None
            assert record.pose.psi_deg is not None
            assert record.magnetic.heading_bound_deg is not None
            error_deg = abs(wrap_deg(record.pose.psi_deg - POSE.heading_deg))
            assert error_deg <= record.magnetic.heading_bound_deg
            warned = [words for words in record.warnings if "move away from iron" in words]
            assert bool(warned) == (name != "clean")
            if name != "clean":
                assert error_deg > 1.0
                assert f"off by {record.magnetic.heading_bound_deg:.0f} deg" in warned[0]
            assert record.pose.sigma_deg.psi is not None
            assert record.pose.sigma_deg.psi >= record.magnetic.heading_bound_deg - 0.01
            # A wrong heading makes both level gyros wrong together, as no noise does: w_n (-sin psi, -cos psi) each.
            assert record.imus[0].covariance is not None
            covariance = record.imus[0].covariance[0][1]
            assert covariance is not None
            # So does a turn of the ground that nobody can exclude: about the vertical, 5 and 3 degrees off the axis.
            assert record.standing is not None
            assert record.standing.turn_deg_s is not None
            assert record.standing.turn_sigma_deg_s is not None
            turn = math.radians(math.hypot(record.standing.turn_deg_s, record.standing.turn_sigma_deg_s))
            assert turn < 30.0 * DEG_H
            covariance -= turn**2 * math.sin(math.radians(5.0)) * math.sin(math.radians(3.0))
            together[name] = covariance
            psi, sigma = math.radians(POSE.heading_deg), math.radians(record.pose.sigma_deg.psi)
            north_rad_s = EARTH_RATE_RAD_S * math.cos(math.radians(rig.site.latitude_deg))
            expected = (north_rad_s * sigma) ** 2 * math.sin(psi) * math.cos(psi)
            assert covariance == pytest.approx(expected, rel=0.15)  # up to the tilt of 5 and 3 degrees
        assert min(together["magnet"], together["car"]) > 1.5 * together["clean"]

    run_virtual(main())


def test_a_recording_of_a_field_heading_replays_to_the_same_record(tmp_path: Path) -> None:
    pytest.importorskip("mcap", reason="recordings need the extra")
    from companion.lab.replay.engine import replay

    records: list[Record] = []

    async def main() -> None:
        async with MagneticRig(tmp_path, recordings_mb=16).running() as rig:
            records.append(await measured(rig))
            await asyncio.sleep(3.0)

    run_virtual(main())
    files = sorted((tmp_path / "recordings").glob("*.mcap"))
    assert files
    (one,) = replay(files).calibrations
    assert one.not_recomputed is None
    assert one.differences == []
    assert one.record.magnetic == records[0].magnetic
    assert one.record.magnetic is not None

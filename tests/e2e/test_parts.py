"""Source of an IMU's noise figures without a configured profile: the part's, by its device ids."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np
import pytest

from companion.autopilot.firmware.firmwares import part_of
from companion.config.sections import NoiseProfile
from companion.estimation.machine import What
from companion.estimation.means.windows import ImuWindow
from companion.estimation.records.record import ImuRecord
from companion.estimation.solution.site import IN_CONFIGURATION
from companion.estimation.solution.solve import wide_gyros
from sim.imu_model import DEG_H
from tests.e2e.test_calibration import calibrated
from tests.support.rig import GYRO_BIAS_DEG_H, Rig
from tests.support.virtual_time import run_virtual

SPI_1 = 0x0A
"""Type of bus and number, the lower byte of a device id."""


def device_id(kind: int, address: int = 1) -> int:
    return kind << 16 | address << 8 | SPI_1


@pytest.mark.parametrize(
    ("firmware", "gyro", "accel", "part"),
    [
        ("ardupilot", 0x2B, 0x2B, "bmi088"),
        ("ardupilot", 0x34, 0x34, "icm42688p"),
        ("ardupilot", 0x31, 0x31, "adis16470"),
        ("px4", 0x26, 0x26, "icm42688p"),
        ("px4", 0x66, 0x6A, "bmi088"),
        ("px4", 0x58, 0x58, "adis16470"),
        # The same numbers mean other parts to the other firmware, and simulators are no part.
        ("px4", 0x2B, 0x2B, None),
        ("ardupilot", 0x26, 0x26, None),
        ("ardupilot", 0x2A, 0x2A, None),
        ("px4", 0x14, 0x14, None),
        # Two chips of one IMU, and a firmware that nobody knows.
        ("ardupilot", 0x2B, 0x34, None),
        ("px4", 0x66, 0x66, None),
        ("other", 0x2B, 0x2B, None),
    ],
)
def test_a_part_is_known_by_the_device_type_of_its_firmware(
    firmware: Any, gyro: int, accel: int, part: str | None
) -> None:
    assert part_of(firmware, device_id(gyro), device_id(accel, 2)) == part
    assert part_of(firmware, None, device_id(accel, 2)) is None


class FoundPart(NamedTuple):
    """End of a calibration of the gyros, and the message about the profile."""

    imu: ImuRecord
    warnings: tuple[str, ...]
    summary: str
    by_device_id: bool


def ids(firmware: str, gyro: int, accel: int) -> dict[str, float]:
    names = ("INS_GYR_ID", "INS_ACC_ID") if firmware == "ardupilot" else ("CAL_GYRO0_ID", "CAL_ACC0_ID")
    return dict(zip(names, (device_id(gyro), device_id(accel, 2)), strict=True))


def gyros(folder: Path, profile: str | NoiseProfile | None, *, compass: bool = True, **rig: Any) -> FoundPart:
    """One calibration of a BMI088's gyros, with this in the configuration."""
    found: list[FoundPart] = []

    async def main() -> None:
        # Nothing is written: the double's own gyro calibration would put its own device id back.
        made = Rig(folder, part="bmi088", imus=1, more="[push]\nparameters = false", **rig)
        configured = msgspec.structs.replace(made.config.imu[0], profile=profile)
        made.config = msgspec.structs.replace(made.config, imu=[configured])
        if not compass:
            made.config = msgspec.structs.replace(made.config, compass=None)
            del made.devices["compass"]
        async with made.running() as running:
            await running.ready()
            result, record = await calibrated(running, What.GYROS)
            assert result.outcome == "done", result
            (shown,) = running.service.status()["profiles"]
            warnings = (*record.warnings, *record.imus[0].warnings)
            found.append(FoundPart(record.imus[0], warnings, shown["summary"], shown["by_device_id"]))

    run_virtual(main())
    return found[0]


def sigma_deg_h(found: FoundPart) -> float:
    assert found.imu.gyro_sigma_use_rad_s is not None
    return float(np.max(found.imu.gyro_sigma_use_rad_s)) / DEG_H


def test_the_part_named_by_the_autopilot_brings_its_profile(tmp_path: Path) -> None:
    parameters = ids("ardupilot", 0x2B, 0x2B)
    unnamed = gyros(tmp_path / "a", None, parameters=ids("ardupilot", 0x3A, 0x3A))
    by_itself = gyros(tmp_path / "b", None, parameters=parameters)
    configured = gyros(tmp_path / "c", "bmi088")
    price = (
        "part unknown: its noise is learned at rest; a named part has a surer sigma"
        " (gyros, deg/h: icm42688p 5, bmi088 7, adis16470 13, adis16405 55)"
    )
    assert unnamed.summary == price
    assert by_itself.summary == "bmi088, of the catalogue, by its device id"
    assert configured.summary == "bmi088, of the catalogue"
    assert [one.by_device_id for one in (unnamed, by_itself, configured)] == [False, True, False]
    assert sigma_deg_h(by_itself) == pytest.approx(sigma_deg_h(configured), rel=0.05)
    assert sigma_deg_h(by_itself) < 0.6 * sigma_deg_h(unnamed)
    assert by_itself.imu.gyro_bias_rad_s is not None
    off = np.abs(np.array(by_itself.imu.gyro_bias_rad_s) / DEG_H - GYRO_BIAS_DEG_H)
    assert np.all(off < 3.5 * sigma_deg_h(by_itself))


def test_integers_that_hide_the_mean_are_not_blamed_on_the_part() -> None:
    window = ImuWindow(
        name="fc",
        samples=1000,
        duration_s=10.0,
        gyro_rad_s=(0.0, 0.0, 0.0),
        accel_m_s2=(0.0, 0.0, -9.8),
        gyro_sigma_stat_rad_s=(1e-4, 1e-4, 1e-4),
        accel_sigma_stat_m_s2=(1e-3, 1e-3, 1e-3),
        gyro_sigma_use_rad_s=(6e-4, 6e-4, 6e-4),
        accel_sigma_use_m_s2=(1e-3, 1e-3, 1e-3),
        temperature_degc=None,
        warnings=(),
        named=False,
    )
    earth = np.diag([1.0, 1.0, 0.0]) * (8.0 * DEG_H) ** 2
    (said,) = wide_gyros([window], earth, IN_CONFIGURATION)
    assert said.startswith("imu fc: sensor part unknown, gyro sigma only estimated")
    hidden = msgspec.structs.replace(window, hidden={"gyro": "coarse steps"})
    (said,) = wide_gyros([hidden], earth, IN_CONFIGURATION)
    assert said.startswith("no compass: ")
    (said,) = wide_gyros([window], None, IN_CONFIGURATION)
    assert said.startswith("imu fc: sensor part unknown, gyro sigma only estimated")
    named = msgspec.structs.replace(window, named=True)
    assert wide_gyros([named, hidden], None, IN_CONFIGURATION) == []

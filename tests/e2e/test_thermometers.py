"""Bad thermometers in the whole daemon: named, and nothing is learned by them."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from companion.storage.learned import BiasStore
from sim.thermal import Board
from tests.e2e.test_calibration import calibrated
from tests.support.rig import Rig
from tests.support.virtual_time import run_virtual

TEMPERATURE = Board(rise_k=20.0, time_constant_s=60.0).switched_on(10.0)
OWN = """
[[imu]]
name = "second"
source = "autopilot"
instance = 2
profile = "icm42688p"
"""


def learned(folder: Path, thermometer: Callable[[float], float], **options: Any) -> tuple[list[str], str, int]:
    """Warnings of the status, the IMU's summary, and how many points with a temperature are kept of it."""

    async def main() -> tuple[list[str], str, int]:
        rig = Rig(
            folder, min_still_s=5.0, max_s=6.0, temperature_degc=TEMPERATURE, more=OWN, imu_rate_hz=10.0, **options
        )
        rig.model.thermometer = thermometer
        async with rig.running():
            await rig.ready()
            await asyncio.sleep(80.0)
            result, record = await calibrated(rig)
            assert result.outcome == "done"
            status = rig.service.status()
            summary = next(device["summary"] for device in status["devices"] if device["name"] == "fc")
            assert (record.imus[0].temperature_degc is None) == (thermometer(20.0) != 20.13)
        kept = BiasStore(folder).read()
        assert any(point.temperature_degc is not None for point in kept["second"].points)
        told = [point for point in kept["fc"].points if point.temperature_degc is not None]
        return status["warnings"], summary, len(told)

    return run_virtual(main())


@pytest.mark.parametrize(
    ("thermometer", "words"),
    [
        (lambda degc: degc + 273.15, "imu fc: its thermometer shows 2"),
        (lambda degc: 24.47, "imu fc: its thermometer is stuck at 24.47 degC, while that of second moved by"),
    ],
)
def test_a_bad_thermometer_is_named_and_nothing_is_learned_by_it(
    tmp_path: Path, thermometer: Callable[[float], float], words: str
) -> None:
    warnings, _, told = learned(tmp_path, thermometer)
    assert [line for line in warnings if line.startswith(words)], warnings
    assert told <= 1  # a stuck one is believed for its first minute


def test_no_temperature_is_no_temperature_of_zero_degrees(tmp_path: Path) -> None:
    warnings, summary, told = learned(tmp_path, lambda degc: 0.0)
    assert not [line for line in warnings if "thermometer" in line]
    assert summary.endswith(", without a temperature")
    assert told == 0


def test_a_good_one_is_not_named_while_it_warms(tmp_path: Path) -> None:
    warnings, summary, told = learned(tmp_path, lambda degc: degc + 0.13)
    assert not [line for line in warnings if "thermometer" in line]
    assert "temperature" not in summary
    assert told > 3

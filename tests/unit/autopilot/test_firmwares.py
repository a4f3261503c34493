"""The firmware objects: who asks which firmware it is, and what an unknown one answers."""

from __future__ import annotations

import ast
from pathlib import Path
from typing import get_args

import pytest

from companion.autopilot.firmware.base import Firmware
from companion.autopilot.firmware.firmwares import (
    FIRMWARES,
    NO_FIRMWARE_YET,
    OTHER,
    firmware_named,
    firmware_with,
    port_needs,
)
from companion.autopilot.parameters.change import FirmwareName
from companion.errors import AutopilotError

ROOT = Path(__file__).parents[3]
AT_HOME = ("companion/autopilot/firmware/", "companion/autopilot/parameters/change.py")


def test_no_other_package_names_a_firmware() -> None:
    names = {str(one.name) for one in FIRMWARES}
    found = [
        f"{path.relative_to(ROOT)}:{node.lineno}"
        for path in sorted((ROOT / "companion").rglob("*.py"))
        if not str(path.relative_to(ROOT)).startswith(AT_HOME)
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Constant) and node.value in names
    ]
    assert found == []


def test_every_name_has_an_object_and_every_heartbeat_one() -> None:
    assert {firmware_named(name).name for name in get_args(FirmwareName)} == set(get_args(FirmwareName))
    assert [firmware_with(one.mav_autopilot or 0) for one in FIRMWARES] == list(FIRMWARES)
    assert firmware_with(99) is OTHER
    assert firmware_named(None) is NO_FIRMWARE_YET


@pytest.mark.parametrize("firmware", [NO_FIRMWARE_YET, OTHER])
def test_an_unknown_one_has_nothing_to_measure_or_to_write(firmware: Firmware) -> None:
    assert (firmware.imu_messages, firmware.ranges, firmware.rivals) == ({}, {}, ())
    assert not firmware.gyro_calibration_resets_ekf
    assert firmware.forwarding_words([]) == (True, "no ground station found (none connected?)")
    with pytest.raises(AutopilotError):
        firmware.heading_names()


# --- the companion's port


@pytest.mark.parametrize(
    ("firmware", "baud", "words"),
    [
        ("ardupilot", 921600, "its port needs SERIALn_PROTOCOL = 2, SERIALn_BAUD = 921, and a restart"),
        ("px4", 57600, "its port needs MAV_1_CONFIG = 102, SER_TEL2_BAUD = 57600, and a restart"),
        (None, 115200, "SERIALn_BAUD = 115 (ArduPilot), or MAV_1_CONFIG = 102, SER_TEL2_BAUD = 115200 (PX4)"),
    ],
)
def test_it_is_one_line(firmware: FirmwareName | None, baud: int, words: str) -> None:
    assert words in port_needs(firmware, baud)

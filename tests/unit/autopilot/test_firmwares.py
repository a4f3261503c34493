"""The firmware objects: who asks which firmware it is, and what an unknown one answers."""

from __future__ import annotations

import ast
from pathlib import Path
from typing import get_args

import pytest

from companion.autopilot.firmware.ardupilot import ArduPilot
from companion.autopilot.firmware.base import Firmware
from companion.autopilot.firmware.firmwares import FIRMWARES, OTHER, UNHEARD, firmware_named, firmware_with, port_needs
from companion.autopilot.firmware.px4 import PX4
from companion.autopilot.parameters.reading import FirmwareName
from companion.errors import AutopilotError

ROOT = Path(__file__).parents[3]
AT_HOME = ("companion/autopilot/firmware/", "companion/autopilot/parameters/reading.py")


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
    assert firmware_named(None) is UNHEARD


@pytest.mark.parametrize("firmware", [UNHEARD, OTHER])
def test_an_unknown_one_has_nothing_to_measure_or_to_write(firmware: Firmware) -> None:
    assert (firmware.imu_messages, firmware.ranges, firmware.rivals, firmware.gyro_calibration) == ({}, {}, {}, None)
    assert firmware.forwarding_words([]) == (True, "none heard")
    with pytest.raises(AutopilotError):
        firmware.heading_names()


# --- the companion's port


def test_px4_telem2_is_to_run_at_our_speed_and_to_forward() -> None:
    found = {"MAV_1_CONFIG": 102.0, "SER_TEL2_BAUD": 57600.0, "MAV_1_FORWARD": 0.0}
    assert found.keys() == set(PX4.port_names)
    rows = {row.parameter: row.wanted for row in PX4().port_rows(found, 921600)}
    assert rows == {"MAV_1_CONFIG": 102, "SER_TEL2_BAUD": 921600, "MAV_1_FORWARD": 1}
    # By UDP, or on another port, the speed of TELEM 2 is nobody's business.
    assert "SER_TEL2_BAUD" not in {row.parameter for row in PX4().port_rows(found, None)}
    assert "SER_TEL2_BAUD" not in {row.parameter for row in PX4().port_rows(found | {"MAV_1_CONFIG": 0.0}, 921600)}


def test_ardupilots_mavlink_ports_are_named_and_others_not() -> None:
    found = {"SERIAL1_PROTOCOL": 2.0, "SERIAL1_BAUD": 57.0, "SERIAL2_PROTOCOL": 1.0, "SERIAL3_PROTOCOL": 5.0}
    assert found.keys() < set(ArduPilot.port_names)
    rows = {row.parameter: (row.now, row.wanted) for row in ArduPilot().port_rows(found, 921600)}
    assert rows == {"SERIAL1_PROTOCOL": (2, 2), "SERIAL1_BAUD": (57, 57), "SERIAL2_PROTOCOL": (1, 2)}


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

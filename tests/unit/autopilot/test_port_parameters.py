"""What the companion's port needs on either firmware: names and numbers as their documents have them."""

from __future__ import annotations

import pytest

from companion.autopilot.firmware.ardupilot import ArduPilot
from companion.autopilot.firmware.firmwares import port_needs
from companion.autopilot.firmware.px4 import PX4
from companion.autopilot.parameters.reading import FirmwareName
from companion.configured.models import baud_of


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


def test_only_serial_lines_have_a_speed() -> None:
    assert baud_of("serial:/dev/serial0:921600") == 921600
    assert baud_of("udpin:0.0.0.0:14550") is None

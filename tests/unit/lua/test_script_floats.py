"""Floats of every IMU from the script that we install on ArduPilot, under Lua 5.3 with faked bindings."""

from __future__ import annotations

import struct

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.autopilot.firmware.imu_messages import SCRIPT, SCRIPT_ASK, all_zero
from companion.lua import to_script
from companion.samples import ImuSample
from tests.unit.lua.test_arming_script import LUA, SILENT, Script, received, script, sent

__all__ = ["script"]
pytestmark = [
    pytest.mark.skipif(LUA is None, reason="needs lua5.3 (Debian: apt install lua5.3)"),
    pytest.mark.real_clock,
]


def floats(said: str) -> list[mavlink.MAVLink_debug_float_array_message]:
    """Decode what the script has sent; all of it by port 1."""
    found = []
    for words in said.split(";"):
        if words.startswith("sent "):
            _, port, number, payload = words.split(" ")
            assert (port, number) == ("1", "350")
            values = struct.unpack("<QH10s58f", bytes.fromhex(payload))
            found.append(mavlink.MAVLink_debug_float_array_message(values[0], values[2], values[1], list(values[3:])))
    return found


def told(said: str, instance: int) -> list[ImuSample]:
    decoded = [SCRIPT[instance].decode(message, 0.0) for message in floats(said)]
    assert all(isinstance(each, ImuSample) for each in decoded)
    return [each for each in decoded if isinstance(each, ImuSample)]


@pytest.mark.parametrize("kind", ["both", "4.5", "colon"])
def test_floats_come_for_three_seconds_after_each_request(kind: str) -> None:
    script = Script(kind)
    assert floats(script("run 1000")[2]) == []
    script(received(to_script(7, SCRIPT_ASK)))
    script("run 250")  # until it looks
    assert 10 <= len(floats(script("run 1000")[2])) <= 13
    script("run 3000")
    assert floats(script("run 1000")[2]) == []
    script.close()


def test_they_are_means_of_four_readings_of_every_imu_with_their_time(script: Script) -> None:
    script("fly rate -0.5")
    script(received(to_script(7, SCRIPT_ASK)))
    said = script("run 600")[2]
    first, second = told(said, 1), told(said, 2)
    assert first[0].gyro_rad_s == (0.0, 0.0, -0.5)
    assert second[0].gyro_rad_s == (0.125, 0.0, -0.5)
    # Two IMUs are read in turn, each reading being 1 more: 1, 3, 5, 7 and 2, 4, 6, 8.
    assert first[0].accel_m_s2 == (4.0, 0.0, -9.75)
    assert second[0].accel_m_s2 == (5.0, 1.0, -9.75)
    assert second[1].accel_m_s2 == (13.0, 1.0, -9.75)
    assert (first[0].temperature_degc, second[0].temperature_degc) == (40.5, 41.5)
    assert (second[1].t_device_s or 0.0) - (second[0].t_device_s or 0.0) == pytest.approx(0.08)
    assert all(all_zero(reading) for reading in told(said, 3))


def test_armed_nothing_is_sent(script: Script) -> None:
    script("fly armed 1")
    script(received(to_script(7, SCRIPT_ASK)))
    assert floats(script("run 2000")[2]) == []


def test_an_unhealthy_imu_is_left_out(script: Script) -> None:
    script("fly sick 0")
    script(received(to_script(7, SCRIPT_ASK)))
    said = script("run 600")[2]
    assert all(all_zero(reading) for reading in told(said, 1))
    assert not any(all_zero(reading) for reading in told(said, 2))


def test_a_board_with_one_imu_has_two_of_zeros() -> None:
    script = Script("both", imus=1)
    script(received(to_script(7, SCRIPT_ASK)))
    said = script("run 600")[2]
    assert told(said, 1)
    assert all(all_zero(reading) for instance in (2, 3) for reading in told(said, instance))
    script.close()


def test_requests_leave_the_gate_as_it_is(script: Script) -> None:
    script(received(sent()))
    assert script("run 200")[0] == "passed"
    for _ in range(6):
        script(received(to_script(7, SCRIPT_ASK)))
        script("run 500")
    assert script("run 400")[:2] == ("failed", SILENT)

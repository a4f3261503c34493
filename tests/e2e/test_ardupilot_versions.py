"""ArduPilot's releases: what differs between them never changes what a calibration leaves (autopilots 1, 2)."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.ardupilot.parameters import offset_names
from sim.imu_model import DEG_H, MG
from tests.e2e.test_calibration import calibrated, started
from tests.support.rig import Rig

RENAMED = re.compile(r"SR\d_|MAV\d?_|SYSID_|ARMING_CHECK|ARMING_SKIPCHK|SERIAL\d_OPTIONS")
"""Names that 4.7 changed."""


def slow(folder: Path, **more: Any) -> Rig:
    """At rates that are enough where no noise is averaged: minutes of settling cost less."""
    return Rig(folder, max_s=12.0, imu_rate_hz=20.0, device_rate_hz=5.0, feed_s=0.4, **more)


@dataclasses.dataclass
class Traffic:
    """Requests and commands to the autopilot: parameter names and command numbers."""

    rig: Rig
    names: set[str] = dataclasses.field(default_factory=set)
    commands: list[int] = dataclasses.field(default_factory=list)

    def __post_init__(self) -> None:
        send = self.rig.link.send

        def noted(message: mavlink.MAVLink_message, *allowed: Callable[[], bool]) -> bool:
            if isinstance(message, mavlink.MAVLink_param_set_message | mavlink.MAVLink_param_request_read_message):
                self.names.add(message.param_id)
            elif isinstance(message, mavlink.MAVLink_command_long_message | mavlink.MAVLink_command_int_message):
                self.commands.append(message.command)
            return send(message, *allowed)

        self.rig.link.send = noted  # type: ignore[method-assign]


@pytest.mark.parametrize("version", ["4.5", "4.7"])
async def test_from_4_5_on_a_calibration_is_right_and_needs_no_name_that_4_7_changed(
    tmp_path: Path, version: str
) -> None:
    rig = Rig(tmp_path, max_s=12.0, version=version, script=True, imu_rate_hz=50.0, device_rate_hz=5.0, feed_s=0.4)
    traffic = Traffic(rig)
    async with rig.running():
        await rig.ready()
        result, record = await calibrated(rig, timeout_s=400.0)
        assert result.outcome == "done", result
        kind = rig.service.devices.imus["fc"].stream.kind
        assert kind is not None
        assert kind.name == ("HIGHRES_IMU" if version == "4.7" else "floats of the script")
        assert list(record.imus[0].written) == [*offset_names(1, "accel"), *offset_names(1, "gyro")]
        left = rig.double.residual(1, rig.now_s)
        assert np.abs(left.gyro_rad_s).max() < 20 * DEG_H
        assert np.abs(left.accel_m_s2).max() < 0.3 * MG
        assert {"INS_GYROFFS_X", "AHRS_ORIENTATION"} <= traffic.names
        assert not [name for name in traffic.names if RENAMED.match(name)]


@pytest.mark.parametrize("firmware", ["ardupilot", "px4"])
async def test_preflight_storage_is_never_sent_and_the_firmwares_gyro_calibration_at_most_once(
    tmp_path: Path, firmware: str
) -> None:
    part = "icm42688p" if firmware == "ardupilot" else "bmi088"
    rig = slow(tmp_path, firmware=firmware, part=part)
    traffic = Traffic(rig)
    async with rig.running():
        await rig.ready()
        await calibrated(rig, timeout_s=200.0)
        await started(rig.service.calibrating.manager.start_undo("test")).finished
    assert mavlink.MAV_CMD_PREFLIGHT_STORAGE not in traffic.commands
    assert traffic.commands.count(mavlink.MAV_CMD_PREFLIGHT_CALIBRATION) == (firmware == "ardupilot")
    harmless = {
        mavlink.MAV_CMD_SET_MESSAGE_INTERVAL,
        mavlink.MAV_CMD_REQUEST_MESSAGE,
        mavlink.MAV_CMD_PREFLIGHT_CALIBRATION,
    }
    assert set(traffic.commands) <= harmless

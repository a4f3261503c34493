"""docs/ros2/companion_ros2.py: message contents, by known rotations; rclpy is not needed."""

from __future__ import annotations

import contextlib
import math
import runpy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.support.rig import Rig

EXAMPLE = runpy.run_path(str(Path(__file__).parents[3] / "docs/ros2/companion_ros2.py"))
RECORD = {
    "state": "done",
    "undone_at": None,
    "pose": {"sigma_deg": {"theta": 0.1, "gamma": 0.2, "psi": 1.0}},
    "imus": [{"name": "fc", "covariance": np.arange(1.0, 37.0).reshape(6, 6).tolist()}],
}
READING = {"gyro_rad_s": [0.1, 0.2, 0.3], "accel_m_s2": [0.0, 0.0, -9.8]}


def fields(pose: Any = None, record: Any = RECORD) -> dict[str, Any]:
    found: dict[str, Any] = EXAMPLE["imu"]({"pose": pose, "imus": {"fc": READING}}, record, "fc")
    return found


@pytest.mark.parametrize(
    ("roll_deg", "pitch_deg", "heading_deg", "forward", "left"),
    [
        (0.0, 0.0, 90.0, (1, 0, 0), (0, 1, 0)),  # Nose to the east: the axes of ENU
        (0.0, 0.0, 0.0, (0, 1, 0), (-1, 0, 0)),  # Nose to the north, the left wing to the west
        (0.0, 0.0, 225.0, (-math.sqrt(0.5), -math.sqrt(0.5), 0), (math.sqrt(0.5), -math.sqrt(0.5), 0)),
        (0.0, 30.0, 90.0, (math.sqrt(0.75), 0, 0.5), (0, 1, 0)),  # Nose up
        (30.0, 0.0, 0.0, (0, 1, 0), (-math.sqrt(0.75), 0, 0.5)),  # Right wing down: the left one is up
    ],
)
def test_orientation_is_that_of_flu_axes_in_enu(
    roll_deg: float, pitch_deg: float, heading_deg: float, forward: Any, left: Any
) -> None:
    found = fields({"roll_deg": roll_deg, "pitch_deg": pitch_deg, "heading_deg": heading_deg})
    turn = Rotation.from_quat([found["orientation"][axis] for axis in "xyzw"])
    np.testing.assert_allclose(turn.apply([[1, 0, 0], [0, 1, 0]]), [forward, left], atol=1e-12)


def test_any_orientation_agrees_with_the_rotation_between_both_worlds() -> None:
    enu_from_ned, frd_from_flu = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]]), np.diag([1, -1, -1])
    for yaw, pitch, roll in np.random.default_rng(1).uniform(-80.0, 80.0, (20, 3)):
        found = fields({"roll_deg": roll, "pitch_deg": pitch, "heading_deg": yaw % 360.0})["orientation"]
        ned_from_frd = Rotation.from_euler("ZYX", [yaw, pitch, roll], degrees=True).as_matrix()
        turn = Rotation.from_quat([found[axis] for axis in "xyzw"]).as_matrix()
        np.testing.assert_allclose(turn, enu_from_ned @ ned_from_frd @ frd_from_flu, atol=1e-12)


def test_readings_and_covariances_are_in_flu() -> None:
    found = fields({"roll_deg": 0.0, "pitch_deg": 0.0, "heading_deg": 0.0})
    assert found["angular_velocity"] == {"x": 0.1, "y": -0.2, "z": -0.3}
    assert found["linear_acceleration"]["z"] == 9.8  # At rest, up is positive (REP 145)
    assert found["angular_velocity_covariance"] == [1, -2, -3, -7, 8, 9, -13, 14, 15]
    assert found["linear_acceleration_covariance"] == [22, -23, -24, -28, 29, 30, -34, 35, 36]
    sigma_rad = np.sqrt(np.diag(np.reshape(found["orientation_covariance"], (3, 3))))
    np.testing.assert_allclose(sigma_rad, np.radians([0.2, 0.1, 1.0]))


@pytest.mark.parametrize("record", [None, {**RECORD, "state": "failed"}, {**RECORD, "undone_at": "2026-11-28"}])
def test_what_is_not_known_is_marked_so(record: Any) -> None:
    found = fields({"roll_deg": 0.0, "pitch_deg": 0.0, "heading_deg": 0.0}, record)
    assert [value[0] for name, value in found.items() if name.endswith("covariance")] == [-1.0] * 3
    without_heading = fields({"roll_deg": 0.0, "pitch_deg": 0.0, "heading_deg": None})
    assert without_heading["orientation_covariance"][0] == -1.0
    assert without_heading["angular_velocity_covariance"][0] == 1.0


async def test_the_daemons_stream_fills_the_messages(tmp_path: Path) -> None:
    monitor = {"command": "monitor", "pose": True, "samples": True}
    async with Rig(tmp_path, min_still_s=3.0, max_s=6.0).running() as rig:
        await rig.ready()
        answers = [reply async for reply in rig.service.faces.answer({"command": "calibrate", "wait": True})]
        assert answers[-1]["record"]["state"] == "done"
        replies, listeners = [], rig.service.devices.imus["fc"].on_sample
        before = len(listeners)
        answer: Any = rig.service.faces.answer(monitor)
        async with contextlib.aclosing(answer) as stream:
            async for reply in stream:
                replies.append(reply)
                if len(replies) == 5:
                    break
        await rig.until(lambda: len(listeners) == before, 1.0)
        found = EXAMPLE["imu"](replies[-1], replies[0]["record"], "fc")
        truth = rig.aircraft.truth_at(rig.now_s)
        force: Any = [sign * value for sign, value in zip((1, -1, -1), truth.force_m_s2, strict=True)]
        assert list(found["linear_acceleration"].values()) == pytest.approx(force, abs=0.02)
        turn = Rotation.from_quat([found["orientation"][axis] for axis in "xyzw"])
        up_m_s2 = turn.apply(list(found["linear_acceleration"].values()))
        np.testing.assert_allclose(up_m_s2, [0.0, 0.0, float(np.linalg.norm(force))], atol=0.03)
        assert 0.0 < found["linear_acceleration_covariance"][0] < 0.01**2
        state, *devices = EXAMPLE["diagnostics"](replies[0]["status"])["status"]
        assert state["level"] == b"\0"
        assert state["message"].startswith("READY: calibrated")
        assert {each["name"] for each in devices} >= {"companion: fc", "companion: gradienter"}

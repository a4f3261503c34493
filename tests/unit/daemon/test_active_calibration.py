"""State of the sensors: after an undo, and with a faces alignment beside the calibration."""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from companion.config import parse
from companion.daemon.process.service import Service
from companion.estimation.records.validity import Held, Why
from tests.support.mqtt_daemon import ALONE

pytestmark = pytest.mark.real_clock

SECOND = '[[imu]]\nname = "second"\nsource = "autopilot"\ninstance = 2\n'


async def test_a_triad_that_no_window_can_measure_is_left_out_after_an_undo(tmp_path: Path) -> None:
    config = parse(ALONE.format(folder=tmp_path, more=SECOND), "test.toml")
    in_force = (readiness := Service(config).arming.readiness).in_force
    first, *others = in_force._triads
    assert others
    for state in in_force._triads.values():
        state.held = Why.UNDONE
    imu = SimpleNamespace(
        name=first[0], temperature_degc=None, use_covariance=np.eye(6), covariance=np.eye(6), biases=(None, None)
    )
    solution: Any = SimpleNamespace(imus=(imu,), unknown={first})
    in_force._note(solution, 20.0, 10.0)
    assert not in_force._triads[first].judged
    assert [in_force._triads[key].held for key in others] == [Why.UNDONE] * len(others)
    assert in_force.findings(20.0)
    assert str(readiness.status()["in_force"]).endswith("; gyros of fc left out (telemetry too coarse)")


@pytest.mark.parametrize(("by_faces", "shown"), [(0.0003, 0.0003), (0.02, 0.009), (None, 0.009)])
async def test_accelerometers_have_the_smaller_sigma_of_calibration_and_faces(
    tmp_path: Path, by_faces: float | None, shown: float
) -> None:
    in_force: Any = Service(parse(ALONE.format(folder=tmp_path, more=""), "test.toml")).arming.readiness.in_force
    ((name, _),) = in_force._triads
    held = Held(
        calibrated_s=0.0, confirmed_s=0.0, temperature_degc=25.0, sigma_use=(0.009, 0.004, 0.004),
        sigma=(0.009, 0.004, 0.004), expected=(0.0, 0.0, 0.0), seen=True, averaged_s=60.0,
    )  # fmt: skip
    in_force._triads[name, "accel"] = SimpleNamespace(held=held)
    in_force.faces = SimpleNamespace(sigma_m_s2=lambda _name, _degc: by_faces, measured_s=lambda _name: 0.0)
    assert in_force.sigma("accel") == shown


@pytest.mark.parametrize(
    ("faces_s", "sigma_m_s2", "shown"),
    [
        (100.0, 0.5e-3 * 9.80665, "calibrated 20 min ago, 13 deg/h, 0.50 mg"),
        (1240.0, 0.5e-3 * 9.80665, "calibrated 20 min ago, 13 deg/h; accel 60 s ago, 0.50 mg"),
        (-math.inf, 0.5e-3 * 9.80665, "calibrated 20 min ago, 13 deg/h; accel before this start, 0.50 mg"),
        (1240.0, None, "calibrated 20 min ago, 13 deg/h; accel not calibrated: companion align faces --write"),
    ],
)
async def test_ready_shows_when_gyros_and_accelerometers_were_measured(
    tmp_path: Path, faces_s: float, sigma_m_s2: float | None, shown: str
) -> None:
    readiness: Any = Service(parse(ALONE.format(folder=tmp_path, more=""), "test.toml")).arming.readiness
    in_force = readiness.in_force
    ((name, _),) = in_force._triads
    gyro = (13.0 * math.radians(1.0) / 3600.0,) * 3
    in_force._triads[name, "gyro"].held = Held(
        calibrated_s=100.0, confirmed_s=1300.0, temperature_degc=25.0, sigma_use=gyro,
        sigma=gyro, expected=(0.0, 0.0, 0.0), seen=True, averaged_s=60.0,
    )  # fmt: skip
    in_force.faces = SimpleNamespace(
        record="measured once", sigma_m_s2=lambda _name, _degc: sigma_m_s2, measured_s=lambda _name: faces_s
    )
    assert readiness._figures(1300.0, "calibrated", in_force.calibrated_s) == shown

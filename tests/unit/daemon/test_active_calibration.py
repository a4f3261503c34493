"""State of the sensors: after an undo, and with a faces alignment beside the calibration."""

from __future__ import annotations

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
    in_force = Service(config).arming.readiness.in_force
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
    in_force._faces = SimpleNamespace(sigma_m_s2=lambda _name, _degc: by_faces)
    assert in_force.sigma("accel") == shown

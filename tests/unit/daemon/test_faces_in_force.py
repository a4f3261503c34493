"""A six-position calibration used later: under other offsets, on another day, on another sensor."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from companion.autopilot.firmware.ardupilot import ArduPilotParameters
from companion.autopilot.firmware.imu_calibration import ImuCalibration, output_step, whole_accelerometer
from companion.cli.client import six_position_lines
from companion.config import parse
from companion.daemon.core import Core
from companion.daemon.poses.alignment import ActiveSixPosition
from companion.estimation.alignment.faces import BIAS, SCALE
from companion.estimation.records.align_record import Determined, FacesImuRecord, FacesRecord, Running
from companion.physics.frames import rotation_matrix, vector
from companion.physics.units import MG
from companion.samples import Vector
from companion.storage.records import this_boot
from tests.support.rig import inline
from tests.support.virtual_time import run_virtual

BIAS_MG, ERROR = (3.0, -2.0, 1.0), (0.004, -0.003, 0.002)
TURN = rotation_matrix("ROTATION_YAW_90")


def calibration(
    offset: Vector = (0.1, 0.2, -0.1), scale: Vector = (1.01, 0.99, 1.0), accel_id: int = 7
) -> ImuCalibration:
    return ImuCalibration(
        instance=1,
        parameters=ArduPilotParameters(1),
        gyro_offset_rad_s=(0.0, 0.0, 0.0),
        accel_offset_m_s2=offset,
        accel_scale=scale,
        gyro_id=1,
        accel_id=accel_id,
        orientation=TURN,
    )


HOST, UP_S = this_boot(), 5000.0


def running(at_s: float = UP_S) -> Running:
    """Calibration of the sensor that started at 0."""
    return Running(host=HOST, started_s=0.0, up_s=at_s)


def record(when: Running | None) -> FacesRecord:
    known = (True, True, True)
    imu = FacesImuRecord(
        name="fc",
        accel_id=7,
        corrections=calibration().corrections,
        temperature_degc=25.0,
        running=when,
        accel_bias_mg=Determined(value=BIAS_MG, sigma=(0.03, 0.03, 0.03), known=known),
        accel_scale=Determined(value=ERROR, sigma=(4e-5, 4e-5, 4e-5), known=known),
        accel_shear=Determined(value=(0.0, 0.0, 0.0), sigma=(4e-5, 4e-5, 4e-5), known=known),
        left_out=(),
        scatter_mg=0.02,
        written={},
    )
    return FacesRecord(measured_at="2026-01-01T00:00:00+00:00", gravity_m_s2=9.81, stands=(), imus=(imu,))


class There(ActiveSixPosition):
    """Active six-position calibration of a daemon that knows how long the sensor has been on."""

    def running(self, name: str) -> Running | None:
        return running()


def kept(folder: Path, when: Running | None) -> ActiveSixPosition:
    text = f"""
[mavlink]
url = "udpout:127.0.0.1:9"
[[imu]]
name = "fc"
source = "autopilot"
profile = "icm42688p"
[storage]
directory = "{folder}"
"""

    async def made() -> ActiveSixPosition:
        core = Core(parse(text, "a.toml"), None, inline, None)
        await There(core, {}).keep(record(when))
        again = There(core, {})
        again.load()
        return again

    return run_virtual(made())


def test_under_the_same_offsets_it_is_what_was_measured(tmp_path: Path) -> None:
    found = kept(tmp_path, running()).known("fc", calibration(), 25.0)
    assert found is not None
    np.testing.assert_allclose(found.figures[BIAS] / MG, BIAS_MG, atol=1e-6)
    np.testing.assert_allclose(found.figures[SCALE], ERROR, atol=1e-9)
    np.testing.assert_allclose(found.sigma[BIAS] / MG, 0.03, rtol=1e-3)


@pytest.mark.parametrize("up", [(0.0, 0.0, -1.0), (1.0, 0.0, 0.0), (0.6, -0.8, 0.0)])
def test_what_is_written_moves_the_output_to_the_truth_on_every_side(up: Vector) -> None:
    """By the firmware's own formula: R diag(scale) (raw - offset)."""
    before, force = calibration(), 9.81 * np.array(up)
    raw_scale, raw_offset = np.array(before.accel_scale), np.array(before.accel_offset_m_s2)
    # An output of (1 + error) truth + bias in the sensor's axes.
    output = (1.0 + np.array(ERROR)) * (TURN.T @ force) + np.array(BIAS_MG) * MG
    raw = output / raw_scale + raw_offset
    changes = whole_accelerometer(before, vector(np.array(BIAS_MG) * MG), ERROR)
    after = {change.parameter: change.after for change in changes}
    offset = np.array([after[name] for name in before.parameters.accel_offset])
    scale = np.array([after[name] for name in before.parameters.accel_scale])
    corrected = TURN @ (scale * (raw - offset))
    np.testing.assert_allclose(corrected, force, atol=2e-6)
    _, step = output_step(before, changes, vector(TURN @ output))
    np.testing.assert_allclose(TURN @ output + step, corrected, atol=2e-6)


def sigma_mg(found: Any) -> float:
    return float(found.sigma[0]) / MG


@pytest.mark.parametrize(
    "when", [None, Running(host="another", started_s=0.0, up_s=UP_S), Running(host=HOST, started_s=-100.0, up_s=UP_S)]
)
def test_in_another_power_up_the_bias_may_be_another(tmp_path: Path, when: Running | None) -> None:
    assert sigma_mg(kept(tmp_path, when).known("fc", calibration(), 25.0)) == pytest.approx(2.0, rel=0.01)


@pytest.mark.parametrize(("left_mg", "sigma"), [(0.0, 2.0), (1.0, None)])
def test_offsets_that_were_undone_do_not_count_however_wide_sigma_is(
    tmp_path: Path, left_mg: float, sigma: float | None
) -> None:
    there, source, before = kept(tmp_path, None), Source(), calibration()
    right = np.array(before.accel_offset_m_s2) + np.array(BIAS_MG) * MG / np.array(before.accel_scale)
    source.calibration = calibration(vector(right - left_mg * MG))
    there._imus = {"fc": source}  # type: ignore[dict-item]
    found = there.sigma_m_s2("fc", 25.0)
    assert found == (sigma and pytest.approx(sigma * MG, rel=0.01))


def test_of_another_sensor_nothing_is_known(tmp_path: Path) -> None:
    there = kept(tmp_path, running())
    assert there.known("fc", calibration(accel_id=8), 25.0) is None
    assert there.known("other", calibration(), 25.0) is None


def test_what_is_in_force_is_shown_with_its_sigma(tmp_path: Path) -> None:
    there = kept(tmp_path, running())
    assert there.status() == [], "its offsets are not known at the moment"
    there._imus = {"fc": Source()}  # type: ignore[dict-item]
    (shown,) = there.status()
    assert shown["name"] == "fc"
    assert shown["bias_left_mg"] == pytest.approx(BIAS_MG)
    assert shown["scale_left"] == pytest.approx(ERROR)
    (first, bias, scale) = six_position_lines([shown])
    assert first == "fc: faces alignment, 2026-01-01T00:00:00 UTC; errors left in its output:"
    assert "x +3.000 +- 0.030" in bias
    assert "x +0.4000 +- 0.0040" in scale


class Source:
    """An IMU whose offsets have been read."""

    calibration = calibration()

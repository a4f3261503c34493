"""What was measured on all sides, used later: under other offsets, on another day, on another sensor."""

from __future__ import annotations

import dataclasses
import datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from companion.autopilot.firmware.ardupilot import parameters_of
from companion.autopilot.firmware.imu_calibration import ImuCalibration, output_step, whole_accelerometer
from companion.calibration.alignment.align_record import Determined
from companion.calibration.alignment.faces import BIAS, SCALE
from companion.calibration.solution.faces_record import FacesImuRecord, FacesRecord
from companion.config import parse
from companion.daemon.calibrating.faces_in_force import FacesInForce
from companion.physics.frames import rotation_matrix, vector
from companion.physics.units import MG
from companion.samples import Vector
from tests.support.virtual_time import run_virtual

BIAS_MG, ERROR = (3.0, -2.0, 1.0), (0.004, -0.003, 0.002)
TURN = rotation_matrix("ROTATION_YAW_90")


def calibration(
    offset: Vector = (0.1, 0.2, -0.1), scale: Vector = (1.01, 0.99, 1.0), accel_id: int = 7
) -> ImuCalibration:
    return ImuCalibration(
        instance=1,
        parameters=parameters_of(1),
        gyro_offset_rad_s=(0.0, 0.0, 0.0),
        accel_offset_m_s2=offset,
        accel_scale=scale,
        gyro_id=1,
        accel_id=accel_id,
        orientation=TURN,
    )


def record(hours: float = 0.0) -> FacesRecord:
    measured_at = datetime.datetime.now(tz=datetime.UTC) - datetime.timedelta(hours=hours)
    known = (True, True, True)
    imu = FacesImuRecord(
        name="fc",
        accel_id=7,
        corrections=calibration().corrections,
        temperature_degc=25.0,
        accel_bias_mg=Determined(value=BIAS_MG, sigma=(0.03, 0.03, 0.03), known=known),
        accel_scale=Determined(value=ERROR, sigma=(4e-5, 4e-5, 4e-5), known=known),
        accel_shear=Determined(value=(0.0, 0.0, 0.0), sigma=(4e-5, 4e-5, 4e-5), known=known),
        left_out=(),
        scatter_mg=0.02,
        written={},
    )
    return FacesRecord(measured_at=measured_at.isoformat(), gravity_m_s2=9.81, stands=(), imus=(imu,))


def kept(folder: Path, hours: float = 0.0) -> FacesInForce:
    async def inline(function: Any, *arguments: Any) -> Any:
        return function(*arguments)

    text = f"""
[mavlink]
url = "udpout:127.0.0.1:9"
[[imu]]
name = "fc"
source = "autopilot"
[storage]
directory = "{folder}"
"""
    config = parse(text, "a.toml")
    first = FacesInForce(config, inline)
    run_virtual(first.keep(record(hours)))
    again = FacesInForce(config, inline)
    again.load()
    return again


def test_under_the_same_offsets_it_is_what_was_measured(tmp_path: Path) -> None:
    found = kept(tmp_path).known("fc", calibration(), 25.0)
    assert found is not None
    np.testing.assert_allclose(found.figures[BIAS] / MG, BIAS_MG, atol=1e-6)
    np.testing.assert_allclose(found.figures[SCALE], ERROR, atol=1e-9)
    np.testing.assert_allclose(np.sqrt(np.diag(found.covariance))[BIAS] / MG, 0.03, rtol=1e-3)


def test_once_written_nothing_is_left_of_it(tmp_path: Path) -> None:
    before = calibration()
    changes = whole_accelerometer(before, vector(np.array(BIAS_MG) * MG), ERROR)
    after = {change.parameter: change.after for change in changes}
    names = before.parameters
    written = dataclasses.replace(
        before,
        accel_offset_m_s2=vector(np.array([after[name] for name in names.accel_offset])),
        accel_scale=vector(np.array([after[name] for name in names.accel_scale])),
    )
    found = kept(tmp_path).known("fc", written, 25.0)
    assert found is not None
    np.testing.assert_allclose(found.figures[BIAS] / MG, 0.0, atol=1e-3)
    np.testing.assert_allclose(found.figures[SCALE], 0.0, atol=1e-6)


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


def test_hours_and_kelvins_widen_the_biases(tmp_path: Path) -> None:
    def sigma_mg(found: Any) -> float:
        return float(np.sqrt(found.covariance[0, 0])) / MG

    fresh = kept(tmp_path)
    assert sigma_mg(fresh.known("fc", calibration(), 30.0)) == pytest.approx(1.0, rel=0.01)
    old = kept(tmp_path, hours=5.0)
    assert sigma_mg(old.known("fc", calibration(), 25.0)) == pytest.approx(0.3, rel=0.02)
    assert sigma_mg(old.known("fc", calibration(), None)) > 1.0


def test_of_another_sensor_nothing_is_known(tmp_path: Path) -> None:
    there = kept(tmp_path)
    assert there.known("fc", calibration(accel_id=8), 25.0) is None
    assert there.known("other", calibration(), 25.0) is None

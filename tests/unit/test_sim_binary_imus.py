"""Simulated binary IMUs against the truth of their aircraft; the decoders were written apart from them."""

from __future__ import annotations

import numpy as np
import pytest

from companion.samples import ImuSample, Sample, TiltSample
from sim.aircraft import Pose, VirtualAircraft
from sim.binary_imus import Stim300
from sim.devices import SerialDevice
from sim.families import GRADIENTERS, IMUS
from sim.imu_model import ImuModel
from tests.support.decoders import make_decoder

POSE = Pose(pitch_deg=5.0, roll_deg=-3.0, heading_deg=40.0)
FLU = np.array([1.0, -1.0, -1.0])
"""Device axes of what lies on its base with Z up, as parts of forward, right, down."""


def decoded(device: SerialDevice, seconds: float) -> tuple[list[Sample], dict[str, int]]:
    decoder = make_decoder("imu", device.protocol)
    data = device.power_on(0.0) + b"".join(frame.data for frame in device.frames_until(seconds))
    samples = decoder.feed(data, 1.0)
    return samples, dict(decoder.rejected)


@pytest.mark.parametrize(("name", "signs", "replies"), [("mip", np.ones(3), 0), ("xsens", FLU, 1), ("stim300", FLU, 3)])
def test_the_mean_of_what_is_decoded_is_the_truth_in_the_device_s_axes(
    name: str, signs: np.ndarray, replies: int
) -> None:
    aircraft = VirtualAircraft(POSE)
    device = IMUS[name](ImuModel(aircraft, "adis16470", seed=3))
    samples, rejected = decoded(device, 20.0)
    readings = [sample for sample in samples if isinstance(sample, ImuSample)]
    assert len(readings) == 20 * device.rate_hz + 1
    assert rejected == ({"reply": replies} if replies else {})
    model = ImuModel(aircraft, "adis16470", seed=3)
    expected = model.read(np.arange(len(readings)) / device.rate_hz, 1 / device.rate_hz).mean(axis=0)
    gyro = np.mean([sample.gyro_rad_s for sample in readings], axis=0)
    accel = np.mean([sample.accel_m_s2 for sample in readings], axis=0)
    assert gyro == pytest.approx(expected[:3] * signs, abs=2e-5)
    assert accel == pytest.approx(expected[3:] * signs, abs=2e-4)
    assert np.sign(accel[2]) == -signs[2]


@pytest.mark.parametrize("range_g", [5, 10, 30, 80])
@pytest.mark.parametrize("crlf", [False, True])
def test_a_stim300_of_any_range_tells_it_at_power_on(range_g: int, *, crlf: bool) -> None:
    device = Stim300(ImuModel(VirtualAircraft(POSE), "adis16470", seed=3), range_g=range_g, crlf=crlf)
    samples, rejected = decoded(device, 1.0)
    forces = [np.linalg.norm(sample.accel_m_s2) for sample in samples if isinstance(sample, ImuSample)]
    assert len(forces) == 251
    assert np.mean(forces) == pytest.approx(9.8, abs=0.1)
    assert rejected == {"reply": 3}


def test_a_stim300_as_a_gradienter_tells_the_tilt_and_is_older_by_its_latency() -> None:
    device = GRADIENTERS["stim300"](VirtualAircraft(POSE), 4)
    tilts = [sample for sample in decoded(device, 1.0)[0] if isinstance(sample, TiltSample)]
    assert np.mean([tilt.y_deg for tilt in tilts]) == pytest.approx(5.0, abs=1e-3)
    assert np.mean([tilt.x_deg for tilt in tilts]) == pytest.approx(-2.98859, abs=1e-3)
    frame = device.frames_until(1.1)[-1]
    assert frame.complete_s - frame.sampled_s == pytest.approx(506e-6 + device.line_time_s(len(frame.data)))
    assert {tilt.t_s for tilt in tilts} == {1.0 - 506e-6}


def test_an_xsens_counts_and_tells_its_own_time() -> None:
    samples, _ = decoded(IMUS["xsens"](ImuModel(VirtualAircraft(POSE), "adis16470", seed=3)), 1.0)
    readings = [sample for sample in samples if isinstance(sample, ImuSample)]
    assert [sample.sequence for sample in readings] == list(range(201))
    assert [sample.t_device_s for sample in readings] == pytest.approx([k / 200 for k in range(201)])

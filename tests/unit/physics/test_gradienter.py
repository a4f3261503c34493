"""The level reversal behind docs/alignment.md by hand, against the zero that the virtual gradienter really has."""

from __future__ import annotations

import math

import numpy as np
import pytest

from companion.physics.gradienter import attitude_from_readings
from companion.samples import TiltSample
from sim.aircraft import Pose, VirtualAircraft
from sim.devices import Gradienter, Law
from sim.scenario import site_at
from tests.support.decoders import make_decoder

ZERO_DEG = (0.31, -0.22)
TABLE = Pose(pitch_deg=1.2, roll_deg=-0.9, heading_deg=40.0)
TURNED = Pose(pitch_deg=-1.2, roll_deg=0.9, heading_deg=220.0)
"""On the same marks: the plate's own axes have turned about its normal."""


def pitch_and_roll_deg(pose: Pose, law: Law) -> tuple[float, float]:
    """What `calibrate` says of the pose with offset_deg = [0, 0]."""
    device = Gradienter(VirtualAircraft(pose, site_at(40.0, 116.0, 50.0)), law=law, offset_deg=ZERO_DEG)
    device.power_on(0.0)
    decoder = make_decoder("gradienter", "inclinometer_xy")
    frames = list(device.frames_until(20.0))
    samples = [sample for frame in frames for sample in decoder.feed(frame.data, frame.complete_s)]
    readings = np.array([(sample.x_deg, sample.y_deg) for sample in samples if isinstance(sample, TiltSample)])
    assert len(readings) > 150
    theta, gamma = attitude_from_readings(law, *readings.mean(axis=0))
    return math.degrees(theta), math.degrees(gamma)


@pytest.mark.parametrize("law", ["axis", "slope", "euler"])
def test_half_of_the_sums_is_the_zero(law: Law) -> None:
    there, turned = pitch_and_roll_deg(TABLE, law), pitch_and_roll_deg(TURNED, law)
    x_deg, y_deg = (there[1] + turned[1]) / 2, (there[0] + turned[0]) / 2
    assert (x_deg, y_deg) == pytest.approx(ZERO_DEG, abs=0.002)

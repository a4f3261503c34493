"""Samples for each role of one device."""

from __future__ import annotations

import pytest

from companion.protocols.registry import PROTOCOLS, Kind, ProtocolInfo, part_for
from companion.samples import CompassSample, ImuSample, MagSample, Sample, TiltSample

IMU = ImuSample(1.0, (0.1, 0.2, 0.3), (0.0, 0.0, -9.8))
TILT = TiltSample(1.0, -3.0, 5.0, 20.0)
HEADING = CompassSample(1.0, 40.0)
WITH_TILT = CompassSample(1.0, 40.0, pitch_deg=5.0, roll_deg=-3.0)


@pytest.mark.parametrize(
    ("role", "sample", "part"),
    [
        ("imu", IMU, IMU),
        ("imu", TILT, None),
        ("imu", WITH_TILT, None),
        ("gradienter", IMU, None),
        ("gradienter", TILT, TILT),
        ("gradienter", HEADING, None),
        # x: right side down, which is roll; y: nose up, which is pitch.
        ("gradienter", WITH_TILT, TiltSample(1.0, -3.0, 5.0)),
        ("compass", IMU, None),
        ("compass", TILT, None),
        ("compass", WITH_TILT, WITH_TILT),
        ("imu", MagSample(1.0, counts=(1, 2, 3)), None),
        ("compass", MagSample(1.0, counts=(1, 2, 3)), MagSample(1.0, counts=(1, 2, 3))),
    ],
)
def test_a_role_takes_its_part(role: Kind, sample: Sample, part: Sample | None) -> None:
    assert part_for(role, sample) == part


def test_a_device_is_the_same_under_each_of_its_roles() -> None:
    seen: dict[str, ProtocolInfo] = {}
    for infos in PROTOCOLS.values():
        for info in infos.values():
            first = seen.setdefault(info.name, info)
            assert (first.decoder, first.dialogue, first.baud, first.parity) == (
                info.decoder,
                info.dialogue,
                info.baud,
                info.parity,
            )

"""Which of the autopilot's messages a recorded sample is: the next with its time that came and is still remembered."""

from __future__ import annotations

from typing import Any

import msgspec
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.recording import topics
from companion.replay.engine import Telemetry
from companion.samples import ImuSample

DIALECT: Any = mavlink


@pytest.mark.parametrize(
    ("reading", "found"), [(99, True), (71, True), (70, True), (69, False), (3, False), (100, False), (104, False)]
)
def test_what_came_too_long_ago_or_not_yet_is_not_found(
    reading: int, found: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A sample behind a hundred readings that nobody counted, of which thirty are remembered."""
    monkeypatch.setattr("companion.replay.engine.PENDING", 30)
    codec = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    telemetry = Telemetry()
    for number in range(100):
        frame = DIALECT.MAVLink_raw_imu_message(10_000 * number, number, *range(8), 0, 0).pack(codec)
        telemetry.receive(bytes(frame), 5.0 + 0.01 * number)
    accel = (reading * 9.80665e-3, 0.0, 9.80665e-3)
    t_s, t_device_s = 5.0 + 0.01 * reading, 10_000 * reading * 1e-6
    entry = topics.ImuEntry(t_s, (2e-3, 3e-3, 4e-3), accel, None, None, t_device_s, "RAW_IMU")
    sample, strange = telemetry.sample(entry)
    assert strange == (None if found else "a sample is not in the MAVLink bytes")
    assert (sample.t_s, sample.t_device_s) == (t_s, t_device_s)
    assert sample.gyro_rad_s + sample.accel_m_s2 == pytest.approx((2e-3, 3e-3, 4e-3, *accel))


def test_a_sample_made_of_two_messages_is_taken_as_recorded_with_what_it_may_be_off_by() -> None:
    recorded = ImuSample(
        5.0, (2e-3, 3e-3, 4e-3), (0.1, 0.2, -9.8), 30.0, None, 4.0, shared_variance=(1e-12,) * 3 + (1e-8,) * 3
    )
    text = topics.imu_json(recorded, "HIGHRES_IMU+SCALED_IMU")
    sample, strange = Telemetry().sample(msgspec.json.decode(text, type=topics.ImuEntry))
    assert strange is None
    assert sample == recorded

"""The daemon's attitude in parts: what of a record is subtracted, when something is due, how two attitudes compare."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from scipy.spatial.transform import Rotation

from companion.attitude.estimator import Attitude
from companion.attitude.quaternion import Quaternion
from companion.autopilot.firmware.ardupilot import ArduPilot
from companion.autopilot.firmware.base import OtherFirmware
from companion.autopilot.firmware.px4 import PX4
from companion.autopilot.telemetry.attitude_messages import vision_position_estimate
from companion.config import parse
from companion.config.sections import Imu
from companion.configured import models
from companion.daemon.heading.attitude_service import AttitudeService, Sender
from companion.daemon.heading.carrier import settings_of, without_truncation
from companion.errors import AutopilotError
from companion.estimation.records.record import ImuRecord, Outcome, WrittenParameter
from companion.estimation.solution.site import Whereabouts, local_earth
from companion.links.mavlink.link import MavlinkLink
from companion.samples import ImuSample

HERE = local_earth(Whereabouts(40.0, 116.0, 50.0, "test", None))
SERIAL = Imu(name="own", source="serial", port="/dev/null", protocol="vectornav")
STREAM = Imu(name="fc", source="autopilot")


def quaternion(roll_deg: float, pitch_deg: float, yaw_deg: float) -> Quaternion:
    """Body to NED, by another package."""
    x, y, z, w = Rotation.from_euler("ZYX", [yaw_deg, pitch_deg, roll_deg], degrees=True).as_quat()
    return (float(w), float(x), float(y), float(z))


def attitude(t_s: float = 12.5, *, yaw_deg: float = -170.0, sigma_deg: float = 2.0) -> Attitude:
    angles = (3.0, -5.0, yaw_deg)
    roll, pitch, yaw = (math.radians(angle) for angle in angles)
    sigma = math.radians(sigma_deg)
    return Attitude(t_s, quaternion(*angles), roll, pitch, yaw, (0.1, -0.2, 0.3), (0.01, 0.02, sigma))


def record(outcome: Outcome | None) -> ImuRecord:
    written = {}
    if outcome is not None:
        for name in ("INS_GYROFFS_X", "INS_ACCOFFS_X"):
            written[name] = WrittenParameter(before=0.0, after=1.0, read_back=1.0, outcome=outcome)
    return ImuRecord(
        name="x",
        samples=1000,
        temperature_degc=None,
        gyro_bias_rad_s=(1.0, 2.0, 3.0),
        gyro_sigma_stat_rad_s=(1e-5,) * 3,
        gyro_sigma_use_rad_s=(2e-5,) * 3,
        accel_bias_m_s2=(0.1, 0.2, 0.3),
        accel_sigma_stat_m_s2=(1e-3,) * 3,
        accel_sigma_use_m_s2=(2e-3,) * 3,
        covariance=None,
        residual_gyro_rad_s=(0.01, 0.02, 0.03),
        residual_accel_m_s2=(0.001, 0.002, 0.003),
        written=written,
    )


@pytest.mark.parametrize(
    ("imu", "outcome", "gyro", "accel"),
    [
        (SERIAL, None, (1.0, 2.0, 3.0), (0.1, 0.2, 0.3)),
        (SERIAL, "stored", (1.0, 2.0, 3.0), (0.1, 0.2, 0.3)),  # what an autopilot subtracts, our port does not
        (STREAM, None, (0.01, 0.02, 0.03), (0.001, 0.002, 0.003)),
        (STREAM, "verified", (0.0,) * 3, (0.0,) * 3),
        (STREAM, "rolled_back", (0.01, 0.02, 0.03), (0.001, 0.002, 0.003)),
    ],
)
def test_what_is_subtracted(
    imu: Imu, outcome: Outcome | None, gyro: tuple[float, ...], accel: tuple[float, ...]
) -> None:
    """Serial IMU: the whole bias; stream: the residual after a write."""
    found = settings_of(imu, record(outcome), HERE, 0.0)
    assert found is not None
    assert (found.gyro_bias_rad_s, found.accel_bias_m_s2) == (gyro, accel)
    assert np.sqrt(np.diag(found.gyro_covariance)) == pytest.approx(2e-5)


def test_whole_milliradians_widen_the_sigma_and_are_taken_in_their_middle() -> None:
    found = settings_of(STREAM, record("verified"), HERE, 1e-3)
    assert found is not None
    assert math.sqrt(found.gyro_covariance[0, 0]) == pytest.approx(math.hypot(2e-5, 1e-3 / math.sqrt(12.0)))
    sample = without_truncation(ImuSample(1.0, (0.002, -0.002, 0.0), (0.0, 0.0, -9.8)), 1e-3)
    assert sample.gyro_rad_s == pytest.approx((0.0025, -0.0025, 0.0))
    rates = np.random.default_rng(1).normal(0.0, 0.05, 20_000)
    cut = [without_truncation(ImuSample(0.0, (float(np.trunc(r * 1e3)) / 1e3, 0, 0), (0, 0, 0)), 1e-3) for r in rates]
    turning = np.abs(rates) > 0.01
    assert (
        abs(np.mean([s.gyro_rad_s[0] for s, t in zip(cut, turning, strict=True) if t]) - rates[turning].mean()) < 2e-5
    )


def over_the_wire(message: mavlink.MAVLink_message) -> Any:
    sender, receiver = mavlink.MAVLink(None, srcSystem=1, srcComponent=191), mavlink.MAVLink(None)
    messages = receiver.parse_buffer(message.pack(sender))
    assert messages is not None
    return messages[0]


def test_ardupilot_adds_the_variances_so_only_one_is_sent() -> None:
    heard = over_the_wire(vision_position_estimate(ArduPilot(), attitude(), 3))
    cov = heard.covariance
    assert math.sqrt(cov[15] + cov[18] + cov[20]) == pytest.approx(math.radians(2.0), rel=1e-6)
    assert (heard.x, heard.y, heard.z) == (0.0, 0.0, 0.0)
    assert heard.usec == 12_500_000
    assert heard.reset_counter == 3
    assert (heard.roll, heard.pitch, heard.yaw) == pytest.approx(tuple(map(math.radians, (3.0, -5.0, -170.0))))


def test_px4_gets_each_variance_and_no_position() -> None:
    heard = over_the_wire(vision_position_estimate(PX4(), attitude(), 259))
    assert all(map(math.isnan, (heard.x, heard.y, heard.z)))
    assert [heard.covariance[k] for k in (15, 18, 20)] == pytest.approx([1e-4, 4e-4, math.radians(2.0) ** 2])
    assert all(map(math.isfinite, heard.covariance))
    assert heard.reset_counter == 3


@pytest.mark.parametrize(
    ("rate_hz", "samples_hz"), [(30.0, 200.0), (50.0, 200.0), (50.0, 1000.0), (50.0, 137.0), (40.0, 25.0)]
)
def test_the_rate_on_the_average_and_the_spacing_always(rate_hz: float, samples_hz: float) -> None:
    """Samples come with a jitter of 2 ms, as from a busy reader."""
    sender = Sender(MavlinkLink(), rate_hz, full=False)
    jitter = np.random.default_rng(3).uniform(0.0, 0.002, round(20 * samples_hz))
    sent: list[tuple[float, float]] = []
    for k, late_s in enumerate(jitter):
        t_s, now_s = 5.0 + k / samples_hz, 5.0 + k / samples_hz + float(late_s)
        if sender.is_due(t_s, now_s):
            sender.send(ArduPilot(), attitude(t_s), attitude(t_s), 0, now_s)
            sent.append((t_s, now_s))
    gaps = np.diff(np.array(sent), axis=0)
    assert gaps.min() >= 0.02 - 1e-5
    assert len(sent) / 20.0 <= 50.0 + 1.0
    assert len(sent) / 20.0 > 0.75 * min(rate_hz, samples_hz)


def test_the_autopilot_gets_what_is_levelled_and_people_what_is_ours() -> None:
    """PX4 leaps to a heading whose tilt is not its own."""
    sent: list[Any] = []

    def send(message: object) -> bool:
        sent.append(message)
        return True

    link: Any = SimpleNamespace(send=send)
    ours, levelled = attitude(yaw_deg=40.0), attitude(yaw_deg=41.0)
    service: Any = SimpleNamespace(
        _vehicle=SimpleNamespace(kind=PX4()),
        health=SimpleNamespace(pushing=True),
        sender=Sender(link, 30.0, full=True),
        carrier=SimpleNamespace(heard_s=12.5, now=lambda: ours, reset_counter=0),
        difference=SimpleNamespace(levelled=lambda found, _now_s: levelled if found is ours else None),
    )
    AttitudeService._push(service, 12.5)
    pushed, shown, _ = sent
    assert math.degrees(pushed.yaw) == pytest.approx(41.0)
    assert math.degrees(shown.yaw) == pytest.approx(40.0)


@pytest.mark.parametrize(
    ("url", "rate_hz"),
    [("udpin:127.0.0.1:14550", 30.0), ("serial:/dev/ttyAMA0:921600", 30.0), ("serial:/dev/ttyAMA0:57600", 22.3)],
)
def test_a_slow_line_keeps_half_of_itself(url: str, rate_hz: float) -> None:
    """129 bytes a message, ten bits a byte."""
    text = f'[mavlink]\nurl = "{url}"\n[[imu]]\nname = "fc"\nsource = "autopilot"\n[push]\nattitude = "yaw"\n'
    assert models.attitude_rate_hz(parse(text, "test")) == pytest.approx(rate_hz, abs=0.1)


def test_other_bits_of_the_mask_stay() -> None:
    found = {"EKF2_EV_CTRL": 7.0, "EKF2_EV_NOISE_MD": 0.0, "EKF2_EVA_NOISE": 0.05}
    (change,) = PX4().heading_changes(found)
    assert (change.parameter, change.before, change.after) == ("EKF2_EV_CTRL", 7.0, 15.0)
    assert PX4().heading_changes(found | {"EKF2_EV_CTRL": 15.0}) == []


def test_an_autopilot_without_external_navigation_is_refused() -> None:
    with pytest.raises(AutopilotError, match="VISO_TYPE"):
        ArduPilot().heading_changes({"EK3_SRC1_YAW": 1.0})
    with pytest.raises(AutopilotError, match="neither ArduPilot nor PX4"):
        OtherFirmware().heading_names()

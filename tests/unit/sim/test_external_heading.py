"""The doubles take a heading from outside by the rules of the real ones (autopilots 6), message by message."""

from __future__ import annotations

import asyncio
import contextlib
import math
from collections.abc import AsyncIterator
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.aircraft import Pose, VirtualAircraft
from sim.ardupilot.double import ArduPilotDouble
from sim.imu_model import ImuModel
from sim.px4.double import PX4Double
from tests.support.component import Ground
from tests.support.wire import Wire

NAN = math.nan
TRUE_DEG = 40.0
ARDUPILOT = {"VISO_TYPE": 1.0, "EK3_SRC1_YAW": 6.0, "INS_GYR_CAL": 0.0}
PX4 = {"EKF2_EV_CTRL": 8, "EKF2_EVA_NOISE": 0.05}


class Line:
    """An autopilot and somebody who sends headings."""

    def __init__(self, double: Any, peer: Ground) -> None:
        self.double, self.peer = double, peer

    def send(self, yaw_deg: float, **fields: Any) -> None:
        """VISION_POSITION_ESTIMATE, stamped now unless it is said."""
        now_s = asyncio.get_running_loop().time()
        covariance = [0.0] * 21
        covariance[20] = fields.get("variance", 1e-4)
        covariance[15] = fields.get("roll_variance", 0.0)
        x, y, z = fields.get("position", (0.0, 0.0, 0.0))
        self.peer.send(
            mavlink.MAVLink_vision_position_estimate_message(
                fields.get("usec", round(now_s * 1e6)), x, y, z, 0.0, 0.0, math.radians(yaw_deg), covariance,
                fields.get("counter", 0),
            )
        )  # fmt: skip

    async def stream(self, yaw_deg: float, seconds: float, **fields: Any) -> None:
        """At 30 Hz."""
        for _ in range(round(seconds * 30)):
            self.send(yaw_deg, **fields)
            await asyncio.sleep(1.0 / 30.0)

    def wrong_deg(self) -> float:
        yaw = self.double.estimated_angles_rad(asyncio.get_running_loop().time())[2]
        return math.degrees(math.remainder(yaw - math.radians(TRUE_DEG), 2.0 * math.pi))


@contextlib.asynccontextmanager
async def line(kind: type[Any], parameters: dict[str, float]) -> AsyncIterator[Line]:
    aircraft = VirtualAircraft(Pose(heading_deg=TRUE_DEG))
    double = kind(aircraft, [ImuModel(aircraft, "perfect")], parameters=parameters)
    peer = Ground(1, 191)
    wire = Wire(peer, double)
    running = asyncio.create_task(double.run())
    await asyncio.sleep(0.1)
    try:
        yield Line(double, peer)
    finally:
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)
        wire.unplug()


async def test_ekf3_has_no_heading_until_the_first_message_and_then_that_one() -> None:
    async with line(ArduPilotDouble, ARDUPILOT) as on:
        assert on.wrong_deg() == pytest.approx(-TRUE_DEG, abs=0.5)
        await on.stream(TRUE_DEG + 25.0, 1.0)
        assert on.wrong_deg() == pytest.approx(25.0, abs=0.5)
        await on.stream(TRUE_DEG, 12.0)
        assert abs(on.wrong_deg()) < 0.5


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        ({"position": (NAN, NAN, NAN)}, "position"),
        ({"position": (0.0, 0.0, NAN)}, "position"),
        ({"variance": -1.0}, "angle"),
    ],
)
async def test_ardupilot_rejects_what_is_not_a_number(fields: dict[str, Any], reason: str) -> None:
    async with line(ArduPilotDouble, ARDUPILOT) as on:
        await on.stream(90.0, 1.0, **fields)
        assert on.double.external_nav.consumed == 0
        assert on.double.external_nav.rejected[reason] == 30
        assert on.wrong_deg() == pytest.approx(-TRUE_DEG, abs=0.5)


async def test_ardupilot_adds_the_variances_with_a_floor() -> None:
    async with line(ArduPilotDouble, ARDUPILOT) as on:
        await on.stream(TRUE_DEG, 0.2, variance=1e-4)
        assert on.double.external_nav.sigma_rad == pytest.approx(0.2)
        await on.stream(TRUE_DEG, 0.2, variance=0.09, roll_variance=0.16)
        assert on.double.external_nav.sigma_rad == pytest.approx(0.5)


async def test_px4_takes_its_parameter_unsquared_for_the_least_variance() -> None:
    async with line(PX4Double, PX4) as on:
        await on.stream(TRUE_DEG, 0.2, variance=1e-4)
        assert math.degrees(on.double.vision.sigma_rad) == pytest.approx(12.8, abs=0.05)
        await on.stream(TRUE_DEG, 0.2, variance=0.09)
        assert on.double.vision.sigma_rad == pytest.approx(0.3)


async def test_ardupilot_drops_what_comes_within_20_ms_by_its_stamp() -> None:
    async with line(ArduPilotDouble, ARDUPILOT) as on:
        for k in range(40):
            on.send(TRUE_DEG, usec=1_000_000 + 10_000 * k)
            await asyncio.sleep(0.01)
        assert on.double.external_nav.consumed == 20
        assert on.double.external_nav.rejected["too soon"] == 20


async def test_ekf2_begins_with_the_stream_follows_it_and_ends_without() -> None:
    async with line(PX4Double, PX4) as on:
        vision = on.double.vision
        on.send(TRUE_DEG, position=(NAN,) * 3)
        await asyncio.sleep(0.3)  # too long a gap to begin with
        on.send(TRUE_DEG, position=(NAN,) * 3)
        await asyncio.sleep(0.05)
        assert not vision.active
        await on.stream(TRUE_DEG + 5.0, 12.0, position=(NAN,) * 3)
        assert vision.active
        assert on.wrong_deg() == pytest.approx(5.0, abs=0.5)
        await asyncio.sleep(0.5)
        on.wrong_deg()
        assert not vision.active
        await asyncio.sleep(60.0)  # the magnetometer goes on
        assert abs(on.wrong_deg()) < 0.5


async def test_ekf2_resets_by_the_counter_and_by_failing_and_only_with_its_bit() -> None:
    async with line(PX4Double, PX4) as on:
        await on.stream(TRUE_DEG, 2.0)
        await on.stream(TRUE_DEG + 90.0, 0.1, counter=1)
        assert on.wrong_deg() == pytest.approx(90.0, abs=0.5)
        await on.stream(TRUE_DEG - 90.0, 0.5, counter=1)
        assert on.wrong_deg() == pytest.approx(90.0, abs=0.5)  # outside the gate, not yet failed
        await on.stream(TRUE_DEG - 90.0, 1.0, counter=1)
        assert on.wrong_deg() == pytest.approx(-90.0, abs=0.5)
    async with line(PX4Double, PX4 | {"EKF2_EV_CTRL": 7}) as on:
        await on.stream(TRUE_DEG + 5.0, 5.0)
        assert not on.double.vision.active
        assert abs(on.wrong_deg()) < 0.5

from __future__ import annotations

import asyncio
import contextlib
import itertools
from collections.abc import AsyncIterator, Callable
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.autopilot.firmware import imu_messages
from companion.autopilot.firmware.imu_messages import ImuMessage
from companion.autopilot.telemetry.imu_stream import ImuStream
from companion.autopilot.telemetry.px4_console import EkfBias, Px4Console
from companion.autopilot.vehicle.vehicle import Vehicle
from companion.links.mavlink.link import MavlinkLink
from companion.samples import ImuSample
from tests.support.scripted_autopilot import ScriptedAutopilot, flying_on
from tests.support.wire import Wire

HIGHRES, SCALED, SCALED2, SCALED3 = 105, 26, 116, 129
DENIED, UNSUPPORTED = mavlink.MAV_RESULT_DENIED, mavlink.MAV_RESULT_UNSUPPORTED


class HeardStream:
    def __init__(self) -> None:
        self.samples: list[ImuSample] = []
        self.kinds: list[str | None] = []

    def kind(self, kind: ImuMessage | None) -> None:
        self.kinds.append(None if kind is None else kind.name)


def kind_of(stream: ImuStream) -> str | None:
    return None if stream.kind is None else stream.kind.name


@contextlib.asynccontextmanager
async def aboard(
    autopilot: ScriptedAutopilot, instance: int = 1, *, rate_hz: float = 100.0, **wire: float
) -> AsyncIterator[tuple[ImuStream, HeardStream, Wire]]:
    link = MavlinkLink()
    vehicle = Vehicle(link)
    heard = HeardStream()
    ekf_bias = EkfBias(Px4Console(link, vehicle), vehicle)
    ekf_bias.settled.set()  # nobody asks for it
    stream = ImuStream(
        link, vehicle, instance, heard.samples.append, rate_hz=rate_hz, ekf_bias=ekf_bias, on_kind_change=heard.kind
    )
    async with flying_on(link, autopilot, **wire) as cable:  # type: ignore[arg-type]
        task = asyncio.create_task(stream.run())
        yield stream, heard, cable
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task
    vehicle.close()


def answering(answers: dict[int, int], slowest_ok_hz: float | None = None) -> Callable[[Any], int]:
    def result(message: Any) -> int:
        if message.command != mavlink.MAV_CMD_SET_MESSAGE_INTERVAL:
            return int(mavlink.MAV_RESULT_ACCEPTED)
        if slowest_ok_hz is not None and message.param2 < 1e6 / slowest_ok_hz - 1:
            return int(DENIED)
        return answers.get(int(message.param1), int(mavlink.MAV_RESULT_ACCEPTED))

    return result


async def test_instance_1_is_highres_with_the_imus_own_temperature() -> None:
    autopilot = ScriptedAutopilot()
    async with aboard(autopilot) as (stream, heard, _):
        await asyncio.sleep(5.0)
        assert kind_of(stream) == "HIGHRES_IMU"
        assert stream.problem == ""
        assert stream.samples == len(heard.samples) > 400
        last = heard.samples[-1]
        assert last.gyro_rad_s == pytest.approx((0.001, -0.002, 0.003), rel=1e-6)
        assert last.accel_m_s2 == pytest.approx((0.1, -0.2, -9.8), rel=1e-6)
        assert last.temperature_degc == pytest.approx(27.15)
        assert last.t_s - last.t_device_s == pytest.approx(900.0, abs=0.3)  # type: ignore[operator]
        assert autopilot.intervals[SCALED] == pytest.approx(0.5)
        assert heard.kinds == ["HIGHRES_IMU"]


@pytest.mark.parametrize("answer", [DENIED, UNSUPPORTED])
async def test_without_highres_it_falls_back_to_scaled_imu(answer: int) -> None:
    autopilot = ScriptedAutopilot()
    autopilot.result_of = answering({HIGHRES: answer})
    async with aboard(autopilot) as (stream, heard, _):
        await asyncio.sleep(5.0)
        assert stream.kind is imu_messages.SCALED
        assert heard.samples[-1].gyro_rad_s == pytest.approx((0.001, -0.002, 0.003))
        # 0.1 m/s^2 is 10.197 mG, cut to 10.
        assert heard.samples[-1].accel_m_s2 == pytest.approx((0.0980665, -0.196133, -9.79684), rel=1e-4)
        assert heard.samples[-1].temperature_degc == pytest.approx(27.15)
        assert autopilot.intervals[SCALED] == pytest.approx(0.01)


async def test_highres_that_is_accepted_but_never_comes() -> None:
    autopilot = ScriptedAutopilot()
    stream_ = autopilot._stream
    autopilot._stream = lambda message_id: None if message_id == HIGHRES else stream_(message_id)  # type: ignore[method-assign]
    async with aboard(autopilot) as (stream, heard, _):
        await asyncio.sleep(12.0)
        assert kind_of(stream) == "SCALED_IMU"
        autopilot._stream = stream_  # type: ignore[method-assign]
        await asyncio.sleep(40.0)
        assert kind_of(stream) == "HIGHRES_IMU"
        assert heard.kinds == ["SCALED_IMU", "HIGHRES_IMU"]


async def test_no_answers_to_commands_wedge_nothing() -> None:
    autopilot = ScriptedAutopilot()
    autopilot.acks = False
    async with aboard(autopilot) as (stream, _, _):
        await asyncio.sleep(8.0)
        assert kind_of(stream) == "HIGHRES_IMU"


@pytest.mark.parametrize("acknowledged", [True, False])
async def test_a_denied_rate_is_stepped_down(*, acknowledged: bool) -> None:
    autopilot = ScriptedAutopilot()
    autopilot.acks = acknowledged
    autopilot.result_of = answering({}, slowest_ok_hz=40.0)
    async with aboard(autopilot, rate_hz=200.0) as (stream, heard, _):
        await asyncio.sleep(5.0 if acknowledged else 40.0)
        assert stream.rate_hz == 40.0
        assert autopilot.intervals[HIGHRES] == pytest.approx(0.025)
        assert kind_of(stream) == "HIGHRES_IMU"
        asked = [1e6 / m.param2 for m in autopilot.requests if getattr(m, "param1", 0) == HIGHRES]
        assert list(dict.fromkeys(round(hz) for hz in asked)) == [200, 100, 50, 40]
        assert heard.samples


async def test_instance_2_is_scaled_imu2() -> None:
    autopilot = ScriptedAutopilot()
    async with aboard(autopilot, 2) as (stream, heard, _):
        await asyncio.sleep(3.0)
        assert kind_of(stream) == "SCALED_IMU2"
        assert heard.samples[-1].gyro_rad_s == pytest.approx((0.010, -0.020, 0.030))
        assert heard.samples[-1].temperature_degc == pytest.approx(27.15)


async def test_a_third_imu_that_is_all_zero_is_none() -> None:
    autopilot = ScriptedAutopilot()
    async with aboard(autopilot, 3) as (stream, heard, _):
        await asyncio.sleep(10.0)
        assert stream.problem == "the autopilot has no IMU 3: SCALED_IMU3 is all zero"
        assert stream.kind is None
        assert heard.samples == []
        autopilot.imu[3] = autopilot.imu[2]
        await asyncio.sleep(10.0)
        assert heard.samples


async def test_highres_of_another_imu_is_not_ours() -> None:
    autopilot = ScriptedAutopilot()
    autopilot.highres_id = 1
    async with aboard(autopilot) as (stream, heard, _):
        await asyncio.sleep(12.0)
        assert kind_of(stream) == "SCALED_IMU"
        assert heard.kinds == ["SCALED_IMU"]


async def test_after_a_restart_it_asks_again() -> None:
    autopilot = ScriptedAutopilot()
    async with aboard(autopilot) as (stream, heard, _):
        await asyncio.sleep(5.0)
        await autopilot.reboot(4.0)
        before = stream.samples
        await asyncio.sleep(6.0)
        assert stream.samples > before + 200
        assert heard.kinds[0] == "HIGHRES_IMU"
        assert heard.kinds[-1] == "HIGHRES_IMU"
        assert None in heard.kinds
        devices = [sample.t_device_s or 0.0 for sample in heard.samples]
        assert sum(b < a for a, b in itertools.pairwise(devices)) == 1


async def test_after_silence_it_asks_again_without_a_change_of_kind() -> None:
    autopilot = ScriptedAutopilot()
    async with aboard(autopilot) as (stream, heard, _):
        await asyncio.sleep(5.0)
        del autopilot.intervals[HIGHRES]
        await asyncio.sleep(2.5)
        before = stream.samples
        await asyncio.sleep(2.0)
        assert stream.samples > before + 100
        assert heard.kinds == ["HIGHRES_IMU"]


async def test_a_lost_link_is_said_and_recovers() -> None:
    autopilot = ScriptedAutopilot()
    async with aboard(autopilot) as (stream, _, wire):
        await asyncio.sleep(5.0)
        wire.cut = True
        await asyncio.sleep(5.0)
        assert stream.problem == "no heartbeat from the autopilot"
        assert stream.kind is None
        wire.cut = False
        await asyncio.sleep(5.0)
        assert kind_of(stream) == "HIGHRES_IMU"
        assert stream.problem == ""


async def test_repeated_packets_count_once_and_strangers_never() -> None:
    autopilot = ScriptedAutopilot()
    stranger = ScriptedAutopilot(system=9)
    stranger.imu[1] = ((1.0, 1.0, 1.0), (9.0, 9.0, 9.0))
    async with aboard(autopilot, duplicate=0.5) as (stream, heard, _):
        link = stream._link
        await asyncio.sleep(1.0)
        stranger.attach(lambda data: link.receive(data, asyncio.get_running_loop().time()))
        stranger._boot_s = autopilot._boot_s
        for _ in range(40):
            stranger._stream(HIGHRES)
            await asyncio.sleep(0.1)
        devices = [sample.t_device_s for sample in heard.samples]
        assert len(devices) == len(set(devices)) > 300
        assert all(sample.gyro_rad_s[0] == pytest.approx(0.001) for sample in heard.samples)


async def test_px4_highres_alone_is_never_used_since_its_estimated_bias_is_taken_off() -> None:
    autopilot = ScriptedAutopilot(autopilot=mavlink.MAV_AUTOPILOT_PX4)
    async with aboard(autopilot) as (stream, _, _):
        autopilot.intervals[HIGHRES] = 0.02
        await asyncio.sleep(5.0)
        assert kind_of(stream) == "SCALED_IMU"


async def test_values_that_are_no_numbers_are_rejected() -> None:
    autopilot = ScriptedAutopilot()
    async with aboard(autopilot) as (_, heard, _):
        await asyncio.sleep(3.0)
        count = len(heard.samples)
        autopilot.imu[1] = ((float("nan"), 0.0, 0.0), (0.1, 0.0, -9.8))
        await asyncio.sleep(1.0)
        assert len(heard.samples) <= count + 1


async def test_nothing_at_all_is_said_in_one_line() -> None:
    autopilot = ScriptedAutopilot()
    autopilot.result_of = answering({HIGHRES: UNSUPPORTED, SCALED: UNSUPPORTED})
    async with aboard(autopilot) as (stream, _, _):
        await asyncio.sleep(5.0)
        assert stream.problem == "no samples of IMU 1: HIGHRES_IMU not supported, SCALED_IMU not supported"
        assert sum(m.get_type() == "COMMAND_LONG" for m in autopilot.requests) < 20


async def test_it_lives_through_a_lossy_link() -> None:
    autopilot = ScriptedAutopilot()
    async with aboard(autopilot, loss=0.3, seed=4) as (stream, _, _):
        await asyncio.sleep(60.0)
        assert kind_of(stream) == "HIGHRES_IMU"
        assert stream.samples > 1000


async def test_a_consumer_that_fails_does_not_stop_the_stream() -> None:
    autopilot = ScriptedAutopilot()
    async with aboard(autopilot) as (stream, _, _):

        def fail(sample: ImuSample) -> None:
            raise RuntimeError

        stream._on_sample = fail
        await asyncio.sleep(4.0)
        assert stream.samples > 200
        assert stream._link.received["handler error"] > 200

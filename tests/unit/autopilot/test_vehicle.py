from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Iterator
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.autopilot.vehicle.heartbeats import ArmingWatch, BootClock
from companion.autopilot.vehicle.parameter_client import ParameterClient
from companion.autopilot.vehicle.vehicle import ArmState, Vehicle
from companion.autopilot.vehicle.whereabouts import Position
from companion.links.mavlink.link import MavlinkLink
from tests.support.scripted_autopilot import ScriptedAutopilot, flying_on

ARDUPILOT, PX4 = mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA, mavlink.MAV_AUTOPILOT_PX4
PARAM_FLOAT = mavlink.MAV_PROTOCOL_CAPABILITY_PARAM_FLOAT
BYTEWISE = mavlink.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE
C_CAST = mavlink.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_C_CAST


@pytest.fixture
def link() -> MavlinkLink:
    return MavlinkLink()


@pytest.fixture
def vehicle(link: MavlinkLink) -> Iterator[Vehicle]:
    found = Vehicle(link)
    yield found
    found.close()


def heartbeat(
    link: MavlinkLink,
    *,
    system: int = 1,
    component: int = 1,
    autopilot: int = mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA,
    kind: int = mavlink.MAV_TYPE_QUADROTOR,
    armed: bool = False,
) -> None:
    codec = mavlink.MAVLink(None, srcSystem=system, srcComponent=component)
    mode = mavlink.MAV_MODE_FLAG_SAFETY_ARMED if armed else 0
    message = mavlink.MAVLink_heartbeat_message(kind, autopilot, mode, 0, 3, 3)
    link.receive(message.pack(codec), asyncio.get_running_loop().time())


def state(vehicle: Vehicle) -> ArmState:
    return vehicle.arm_state


def latched(vehicle: Vehicle) -> int | None:
    return vehicle.system_id


def position(vehicle: Vehicle) -> Position | None:
    return vehicle.place.position


@contextlib.asynccontextmanager
async def aboard(autopilot: ScriptedAutopilot, **wire: float) -> AsyncIterator[tuple[Vehicle, list[str]]]:
    link = MavlinkLink()
    vehicle = Vehicle(link)
    events: list[str] = []
    vehicle.on_event.add(events.append)
    async with flying_on(link, autopilot, **wire):  # type: ignore[arg-type]
        async with asyncio.timeout(30):
            await vehicle.found.wait()
        await asyncio.sleep(0.3)
        yield vehicle, events
    vehicle.close()


async def test_disarmed_is_believed_once_no_armed_heartbeat_has_come_for_three_seconds(
    link: MavlinkLink, vehicle: Vehicle
) -> None:
    events: list[tuple[float, str]] = []
    loop = asyncio.get_running_loop()
    vehicle.on_event.add(lambda event: events.append((round(loop.time() - 1000.0, 3), event)))
    heartbeat(link, armed=True)
    for _ in range(4):
        await asyncio.sleep(0.9)
        assert state(vehicle) is (ArmState.ARMED if loop.time() < 1003.0 else ArmState.DISARMED)
        heartbeat(link)
    assert state(vehicle) is ArmState.DISARMED
    assert events == [(0, "found"), (0, "armed"), (3.6, "disarmed")]


@pytest.mark.parametrize(("own_hz", "forger_hz"), [(1.0, 1.0), (1.0, 500.0), (5.0, 5.0)])
async def test_disarmed_heartbeats_of_a_forger_are_not_believed_and_named(
    link: MavlinkLink, vehicle: Vehicle, own_hz: float, forger_hz: float
) -> None:

    async def beat(rate_hz: float, *, armed: bool, late_s: float) -> None:
        await asyncio.sleep(late_s)
        while True:
            heartbeat(link, armed=armed)
            await asyncio.sleep(1.0 / rate_hz)

    heartbeat(link, armed=True)
    both = [
        asyncio.create_task(beat(own_hz, armed=True, late_s=0.2)),
        asyncio.create_task(beat(forger_hz, armed=False, late_s=0.5)),
    ]
    for _ in range(1200):
        await asyncio.sleep(0.01)
        assert state(vehicle) is not ArmState.DISARMED
    assert state(vehicle) is ArmState.UNKNOWN
    assert vehicle.conflict == "system id 1 reports armed and disarmed alternately: two autopilots, or a forged sender"
    for task in both:
        task.cancel()


async def test_an_armed_heartbeat_of_another_firmware_under_the_same_ids_counts(
    link: MavlinkLink, vehicle: Vehicle
) -> None:
    heartbeat(link)
    assert state(vehicle) is ArmState.DISARMED
    heartbeat(link, autopilot=mavlink.MAV_AUTOPILOT_GENERIC, armed=True)
    heartbeat(link)
    assert state(vehicle) is ArmState.ARMED


async def test_a_restart_that_somebody_pretends_does_not_make_it_disarmed(link: MavlinkLink, vehicle: Vehicle) -> None:
    codec = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    events: list[str] = []
    vehicle.on_event.add(events.append)
    heartbeat(link, armed=True)
    for boot_ms in (60_000, 100):
        link.receive(mavlink.MAVLink_system_time_message(0, boot_ms).pack(codec), asyncio.get_running_loop().time())
    heartbeat(link)
    assert events == ["found", "armed", "rebooted"]
    assert state(vehicle) is ArmState.ARMED


async def test_state_follows_heartbeats_and_is_unknown_two_seconds_after_the_last() -> None:
    link = MavlinkLink()
    vehicle = Vehicle(link)
    events: list[tuple[float, str]] = []
    loop = asyncio.get_running_loop()
    vehicle.on_event.add(lambda event: events.append((round(loop.time() - 1000.0, 3), event)))
    assert (state(vehicle), vehicle.heartbeat_age_s, latched(vehicle)) == (ArmState.UNKNOWN, None, None)
    heartbeat(link)
    assert state(vehicle) is ArmState.DISARMED
    await asyncio.sleep(1.0)
    heartbeat(link, armed=True)
    assert state(vehicle) is ArmState.ARMED
    await asyncio.sleep(1.9)
    assert state(vehicle) is ArmState.ARMED
    await asyncio.sleep(0.2)
    assert state(vehicle) is ArmState.UNKNOWN
    assert vehicle.heartbeat_age_s == pytest.approx(2.1)
    heartbeat(link, armed=True)
    assert events == [(0, "found"), (0, "disarmed"), (1, "armed"), (3, "lost"), (3.1, "found")]
    vehicle.close()
    assert state(vehicle) is ArmState.UNKNOWN


@pytest.mark.parametrize(
    ("autopilot", "kind"),
    [
        (mavlink.MAV_AUTOPILOT_INVALID, mavlink.MAV_TYPE_QUADROTOR),
        (mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA, mavlink.MAV_TYPE_GCS),
        (mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA, mavlink.MAV_TYPE_ONBOARD_CONTROLLER),
        (mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA, mavlink.MAV_TYPE_GIMBAL),
        (mavlink.MAV_AUTOPILOT_GENERIC, mavlink.MAV_TYPE_ADSB),
        (mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA, mavlink.MAV_TYPE_ANTENNA_TRACKER),
    ],
)
async def test_who_is_no_autopilot_is_not_latched(
    link: MavlinkLink, vehicle: Vehicle, autopilot: int, kind: int
) -> None:
    heartbeat(link, system=7, autopilot=autopilot, kind=kind)
    assert latched(vehicle) is None
    heartbeat(link, system=9)
    assert latched(vehicle) == 9
    assert link.system_id == 9
    assert vehicle.firmware == "ardupilot"


async def test_other_vehicles_and_other_components_say_nothing_about_ours(link: MavlinkLink, vehicle: Vehicle) -> None:
    heartbeat(link, system=3)
    heartbeat(link, system=4, armed=True)
    heartbeat(link, system=3, component=154, armed=True)
    heartbeat(link, system=3, kind=mavlink.MAV_TYPE_GIMBAL, armed=True)
    assert state(vehicle) is ArmState.DISARMED
    await asyncio.sleep(1.5)
    heartbeat(link, system=4)
    heartbeat(link, system=3, component=154)
    await asyncio.sleep(0.6)
    assert state(vehicle) is ArmState.UNKNOWN
    assert latched(vehicle) == 3


async def test_only_the_configured_system_is_latched() -> None:
    link = MavlinkLink()
    vehicle = Vehicle(link, system_id=42)
    heartbeat(link, system=1)
    assert latched(vehicle) is None
    heartbeat(link, system=42, autopilot=mavlink.MAV_AUTOPILOT_PX4)
    assert latched(vehicle) == 42
    assert vehicle.firmware == "px4"
    vehicle.close()


async def test_component_1_is_preferred_and_another_is_taken_when_it_stays_silent() -> None:
    link = MavlinkLink()
    vehicle = Vehicle(link)
    heartbeat(link, component=50)
    heartbeat(link, component=1)
    assert (latched(vehicle), vehicle.component_id) == (1, 1)
    vehicle.close()
    alone = Vehicle(link)
    heartbeat(link, component=50)
    assert latched(alone) is None
    await asyncio.sleep(2.0)
    heartbeat(link, component=50)
    assert (latched(alone), alone.component_id) == (1, 50)
    alone.close()


async def test_asks_for_what_it_needs_and_learns_version_time_and_place() -> None:
    autopilot = ScriptedAutopilot()
    async with aboard(autopilot) as (vehicle, _):
        await asyncio.sleep(5.0)
        assert autopilot.intervals[mavlink.MAVLINK_MSG_ID_HEARTBEAT] == pytest.approx(0.2)
        assert vehicle.version == "4.8.0-dev"
        assert vehicle.name == "ArduPilot 4.8.0-dev, system 1"
        assert vehicle.place.position is not None
        assert vehicle.place.position.latitude_deg == pytest.approx(40.0)
        assert vehicle.place.position.height_m == pytest.approx(50.0)
        assert vehicle.place.unix_time_s == pytest.approx(1_800_000_000 + autopilot.uptime_s(), abs=0.01)


async def test_a_version_that_contradicts_the_one_before_is_asked_for_again() -> None:
    autopilot = ScriptedAutopilot()
    async with aboard(autopilot) as (vehicle, _):
        told = (vehicle.version, vehicle.capabilities)
        forged: Any = mavlink.MAVLink_autopilot_version_message
        codec = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
        nothing = [0] * 8
        data = forged(BYTEWISE, 0x01020300, 0, 0, 0, nothing, nothing, nothing, 0, 0, 7).pack(codec)
        asked = len(autopilot.requests)
        vehicle._link.receive(data, asyncio.get_running_loop().time())
        assert (vehicle.version, vehicle.capabilities) != told
        await asyncio.sleep(1.0)
        assert (vehicle.version, vehicle.capabilities) == told
        await asyncio.sleep(20.0)
        again = [each for each in autopilot.requests[asked:] if getattr(each, "param1", 0) == 148]
        assert 1 <= len(again) <= 2, "once both agree nobody asks"


async def test_a_silent_command_server_is_asked_again_and_wedges_nothing() -> None:
    autopilot = ScriptedAutopilot()
    autopilot.on_message = lambda message: False
    async with aboard(autopilot) as (vehicle, _):
        await asyncio.sleep(8.0)
        assert state(vehicle) is ArmState.DISARMED
        asked = [int(m.param1) for m in autopilot.requests if m.get_type() == "COMMAND_LONG" and m.command == 511]
        assert asked.count(mavlink.MAVLINK_MSG_ID_SYSTEM_TIME) >= 2
        assert len(asked) < 20
        autopilot.on_message = lambda message: True
        await asyncio.sleep(40.0)
        assert vehicle.place.unix_time_s is not None


async def test_position_zero_zero_is_no_position_and_gps_serves_instead(link: MavlinkLink, vehicle: Vehicle) -> None:
    heartbeat(link)
    codec = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    for message in (
        mavlink.MAVLink_global_position_int_message(1000, 0, 0, 0, 0, 0, 0, 0, 0),
        mavlink.MAVLink_gps_raw_int_message(1000, 2, 100000000, 200000000, 1000, 0, 0, 0, 0, 9),
    ):
        link.receive(message.pack(codec), 1000.0)
    assert position(vehicle) is None
    for t_s in range(1000, 1004):
        link.receive(
            mavlink.MAVLink_gps_raw_int_message(1000, 3, 100000000, 200000000, 1000, 0, 0, 0, 0, 9).pack(codec), t_s
        )
    assert vehicle.place.position is not None
    assert vehicle.place.position.source == "autopilot GPS_RAW_INT"
    assert vehicle.place.position.longitude_deg == pytest.approx(20.0)


async def test_a_restart_is_seen_and_its_arm_state_unknown_until_the_next_heartbeat() -> None:
    autopilot = ScriptedAutopilot()
    async with aboard(autopilot) as (vehicle, events):
        await asyncio.sleep(2.0)
        events.clear()
        await autopilot.reboot(3.0)
        await asyncio.sleep(3.0)
        assert vehicle.boots == 1
        assert events[:2] == ["lost", "found"]
        assert "rebooted" in events
        assert state(vehicle) is ArmState.DISARMED
        await asyncio.sleep(3.0)
        assert vehicle.version == "4.8.0-dev"


async def test_another_firmware_that_is_flashed_is_no_second_autopilot_though_it_streams_before_its_heartbeat(
    link: MavlinkLink, vehicle: Vehicle
) -> None:
    codec = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)

    def stream(boot_s: float) -> None:
        message = mavlink.MAVLink_system_time_message(0, int(boot_s * 1000))
        link.receive(message.pack(codec), asyncio.get_running_loop().time())

    heartbeat(link, autopilot=PX4)
    stream(100.0)
    await asyncio.sleep(20.0)
    stream(3.0)
    await asyncio.sleep(0.3)
    heartbeat(link, autopilot=ARDUPILOT)
    assert vehicle.firmware == "ardupilot"
    assert vehicle.conflict is None
    assert state(vehicle) is ArmState.DISARMED


async def test_a_restart_leaves_the_state_unknown(link: MavlinkLink, vehicle: Vehicle) -> None:
    heartbeat(link)
    codec = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    for boot_ms in (90_000, 200):
        link.receive(mavlink.MAVLink_system_time_message(0, boot_ms).pack(codec), 1000.0)
    assert vehicle.boots == 1
    assert state(vehicle) is ArmState.UNKNOWN
    heartbeat(link)
    assert state(vehicle) is ArmState.DISARMED


async def test_old_heartbeats_read_after_a_stall_of_our_own_prove_nothing() -> None:
    link = MavlinkLink()
    vehicle = Vehicle(link)
    heartbeat(link)
    loop = asyncio.get_running_loop()
    await asyncio.sleep(0.1)
    loop._jumping.now_s += 5.0  # type: ignore[attr-defined]
    heartbeat(link)  # it waited in a socket's buffer all that time
    assert state(vehicle) is ArmState.UNKNOWN
    await asyncio.sleep(0.05)
    assert state(vehicle) is ArmState.UNKNOWN
    await asyncio.sleep(0.2)
    heartbeat(link)
    assert state(vehicle) is ArmState.DISARMED
    vehicle.close()


def feed(clock: BootClock, *points: tuple[float, float]) -> list[bool]:
    return [clock.rebooted(boot_s, t_s) for boot_s, t_s in points]


def test_boot_clock_time_going_back_is_a_restart() -> None:
    assert feed(BootClock(), (100, 0), (101, 1), (0.3, 2), (1.3, 3)) == [False, False, True, False]


def test_boot_clock_late_and_repeated_packets_are_none() -> None:
    assert not any(feed(BootClock(), (100, 0), (100.02, 0.02), (100.01, 0.02), (100.02, 0.03), (100.03, 0.04)))


def test_boot_clock_restart_during_a_lost_link_is_seen_although_time_has_overtaken() -> None:
    assert feed(BootClock(), (20, 0), (30, 60), (30.6, 60.6)) == [False, False, True]


def test_boot_clock_old_packets_after_a_stall_of_ours_are_none() -> None:
    points = [(100, 0), (100.1, 10), (100.2, 10.01), (110.1, 10.1), (110.9, 10.9), (112, 12)]
    assert not any(feed(BootClock(), *points))


def test_boot_clock_32_bit_wrap_is_none() -> None:
    wrap_s = 2**32 / 1000
    assert not any(feed(BootClock(), (wrap_s - 1, 0), (0.2, 1.2), (1.2, 2.2)))


def test_boot_clock_slow_simulation_and_drift_are_none() -> None:
    assert not any(feed(BootClock(), *[(0.6 * t, t) for t in range(0, 300, 3)]))


@pytest.mark.parametrize(
    ("capabilities", "autopilot", "expected"),
    [
        (None, ARDUPILOT, False),
        (None, PX4, True),
        (PARAM_FLOAT, ARDUPILOT, False),
        (PARAM_FLOAT, PX4, True),
        (PARAM_FLOAT | BYTEWISE, PX4, True),
        (PARAM_FLOAT | C_CAST, ARDUPILOT, False),
        (PARAM_FLOAT | C_CAST, PX4, True),
        (PARAM_FLOAT | BYTEWISE, ARDUPILOT, False),
    ],
)
async def test_integers_are_bytes_on_px4_only_whatever_anybody_says_of_its_capabilities(
    link: MavlinkLink, vehicle: Vehicle, capabilities: int | None, autopilot: int, expected: bool
) -> None:
    heartbeat(link, autopilot=autopilot)
    vehicle.capabilities = capabilities
    assert ParameterClient(link, vehicle).integers_bytewise == expected


def test_boot_clock_an_autopilot_up_for_longer_than_we_heard_nothing_has_not_restarted() -> None:
    # ArduPilot calibrates its gyros, and the machine that simulates it is too busy: little simulated time, no messages.
    assert not any(feed(BootClock(), (60, 0), (60.2, 3.5), (60.5, 4.1), (61, 5.2)))


def test_no_autopilot_restarts_twice_within_a_second() -> None:
    """Two under one id, whose times since boot alternate, seem to."""
    arming = ArmingWatch()
    arming.restarted(10.0)
    arming.restarted(11.0)
    assert arming.conflict(11.0, 1) is None
    arming.restarted(11.5)
    assert arming.conflict(11.5, 1) == "two autopilots have system id 1"

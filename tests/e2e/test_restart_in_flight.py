"""A daemon that dies in flight and is started again: it goes on only where it agrees with the autopilot."""

from __future__ import annotations

import asyncio
import itertools
import math
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.autopilot.vehicle.vehicle import ArmState
from companion.config import parse
from companion.estimation.records.history import PowerUp
from companion.estimation.records.record import Record
from companion.storage.learned import BiasStore
from companion.storage.records import RecordStore
from sim.companion_process import CompanionProcess
from sim.devices import HMR3300
from sim.flight import BankedCircles
from sim.motions import SlowTurn
from tests.e2e.test_attitude_push import Firmware, Flight, Vision, flight
from tests.support.live_aircraft import QUICK, live_aircraft
from tests.support.virtual_time import run_virtual

WITHIN_S = 3.0
STARTS_S = 0.5
"""What a process takes until its first heartbeat leaves, which virtual time does not show."""
DIFFERS = {f"heading differs by {off_deg} deg from the autopilot's" for off_deg in (39, 40, 41)}
READING = (mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, mavlink.MAV_CMD_REQUEST_MESSAGE)


def in_air(flying: Flight, rate_deg_s: float = 12.0) -> None:
    """Armed, and turning from now on."""
    flying.rig.autopilot.arm()
    start_s = flying.rig.aircraft.time_at(flying.rig.now_s) + 0.1
    flying.rig.aircraft.add(SlowTurn(start_s=start_s, duration_s=300.0, rate_deg_s=rate_deg_s))


def worst_deg(flying: Flight, since_s: float) -> float:
    """What the headings that were sent were off by at their own instants."""
    aircraft = flying.rig.aircraft
    sent = flying.witness.of(Vision, since_s)
    truth = [aircraft.angles_rad(message.usec * 1e-6 - aircraft.loop_time_of(0.0))[2] for message in sent]
    wrong = [math.remainder(message.yaw - yaw, 2.0 * math.pi) for message, yaw in zip(sent, truth, strict=True)]
    return math.degrees(max(map(abs, wrong)))


def begun(flying: Flight, since_s: float) -> list[str]:
    """What the new daemon has asked for besides reading."""
    return [
        message.get_type()
        for t_s, message in flying.witness.heard
        if t_s > since_s
        and isinstance(message, mavlink.MAVLink_param_set_message | mavlink.MAVLink_command_long_message)
        and getattr(message, "command", None) not in READING
    ]


@pytest.mark.parametrize(("firmware", "own_imu"), list(itertools.product(["ardupilot", "px4"], [True, False])))
def test_it_goes_on_within_three_seconds_in_a_turn(tmp_path: Path, firmware: Firmware, own_imu: bool) -> None:
    """By the truth, and nothing else is begun: no calibration, no write, no word of an arming that nobody saw."""

    async def main() -> None:
        options: dict[str, Any] = {"own_imu": own_imu, "imu_rate_hz": 50.0, "at_arm": "warn"}
        async with flight(tmp_path, firmware=firmware, **options) as flying:
            in_air(flying)
            await flying.sleep(6.0)
            armings, said = (tmp_path / "armings.json").read_bytes(), len(flying.rig.ground.texts())
            killed_s = flying.rig.now_s
            await flying.rig.restart()
            await flying.pushing(WITHIN_S - STARTS_S)
            await flying.sleep(5.0)
            assert flying.attitude.health.pushing
            assert worst_deg(flying, killed_s) < 2.0
            headline = flying.rig.service.status()["headline"]
            assert headline["word"] == "ARMED"
            assert headline["reason"].startswith("companion started in flight: ")
            assert begun(flying, killed_s) == []
            assert flying.rig.service.calibrating.manager.job is None
            texts = flying.rig.ground.texts()[said:]
            assert "Attitude: heading pushed to the autopilot" in texts
            assert not [text for text in texts if "rmed" in text or "alibrat" in text or "not pushed" in text]
            assert (tmp_path / "armings.json").read_bytes() == armings

    run_virtual(main())


def test_in_a_steep_turn_it_waits_for_the_compass(tmp_path: Path) -> None:
    """Which shows no heading there, and without a heading of our own there is nothing to compare."""

    async def main() -> None:
        route = BankedCircles(start_s=35.0)
        async with flight(tmp_path, route=route, vehicle="plane", feed_s=0.04, imu_rate_hz=25.0) as flying:
            rig = flying.rig
            rig.autopilot.arm()
            await flying.sleep(60.0 - rig.aircraft.time_at(rig.now_s))
            killed_s = rig.now_s
            await rig.restart()
            await flying.sleep(10.0)
            assert not flying.witness.of(Vision, killed_s + 0.1)  # after what was on the wire
            words = "heading unknown: no compass reading fits"
            assert flying.attitude.view()["why_not"] == words
            assert f"Attitude not pushed: {words}" in rig.ground.texts()

    run_virtual(main())


@pytest.mark.parametrize("firmware", ["ardupilot", "px4"])
def test_a_compass_that_lies_since_is_not_followed(tmp_path: Path, firmware: Firmware) -> None:
    """By 40 degrees: nothing is pushed, and everybody is told why, until it is right again."""

    async def main() -> None:
        async with flight(tmp_path, firmware=firmware) as flying:
            rig = flying.rig
            in_air(flying)
            await flying.sleep(6.0)
            compass = rig.devices["compass"]
            assert isinstance(compass, HMR3300)
            compass.heading_error_deg = 40.0
            killed_s = rig.now_s
            await rig.restart()
            await flying.sleep(6.0)
            assert not flying.witness.of(Vision, killed_s)
            assert flying.attitude.view()["why_not"] in DIFFERS
            (text,) = [text for text in rig.ground.texts() if text.startswith("Attitude not pushed: ")]
            assert text.removeprefix("Attitude not pushed: ") in DIFFERS
            status = rig.service.status()
            assert status["headline"]["reason"].startswith("attitude not pushed: heading differs by")
            (line,) = [device for device in status["devices"] if device["kind"] == "attitude"]
            assert not line["good"]
            assert line["summary"].startswith("not pushed: heading differs by")
            compass.heading_error_deg = 0.0
            right_s = rig.now_s
            await flying.pushing(5.0)
            await flying.sleep(5.0)
            assert worst_deg(flying, right_s) < 2.0

    run_virtual(main())


def test_who_may_be_armed_is_carried_as_in_flight(tmp_path: Path) -> None:
    """On the ground, its heartbeats lost: it may have armed, so that no stillness is believed until they are back."""

    async def main() -> None:
        async with flight(tmp_path) as flying:
            rig, carrier = flying.rig, flying.attitude.carrier
            await rig.until(lambda: (carrier.phase, carrier.still) == ("ground", True), 10.0)
            rig.double.faults.heartbeat_off = True
            await rig.until(lambda: rig.service.core.vehicle.arm_state is ArmState.UNKNOWN, 10.0)
            await flying.sleep(2.0)
            assert (carrier.phase, carrier.still) == ("flight", False)
            rig.double.faults.heartbeat_off = False
            await rig.until(lambda: (carrier.phase, carrier.still) == ("ground", True), 10.0)

    run_virtual(main())


def exchanged_part(flying: Flight) -> None:
    flying.rig.double.set_parameter("INS_GYR_ID", flying.rig.double.parameter("INS_GYR_ID") + 1)


def exchanged_profile(flying: Flight) -> None:
    rig = flying.rig
    rig.config = parse(rig.text.replace('profile = "adis16470"', 'profile = "bmi088"'), "rig.toml")


def of_another_power_up(flying: Flight) -> None:
    store, replace = BiasStore(flying.rig.config.storage.path), msgspec.structs.replace
    before = PowerUp(host="before the power cut", since_unix_s=None)
    store.write({
        name: replace(known, points=tuple(replace(point, power_up=before) for point in known.points))
        for name, known in store.all().items()
    })  # fmt: skip


def without_records(flying: Flight) -> None:
    for path in (flying.rig.config.storage.path / "records").iterdir():
        path.unlink()


def undone(flying: Flight) -> None:
    store = RecordStore(flying.rig.config.storage.path)
    (record,) = store.history()
    store.save(msgspec.structs.replace(record, undone_at="2026-11-23T12:00:00+00:00"))


@pytest.mark.parametrize(
    ("own_imu", "happens", "why"),
    [
        (False, exchanged_part, "another IMU than was calibrated (gyro (device id))"),
        (True, exchanged_profile, "another IMU than was calibrated (profile)"),
        (True, of_another_power_up, "the IMU was without power since its calibration"),
        (True, without_records, "no calibration is in force"),
        (True, undone, "no calibration is in force"),
    ],
)
def test_biases_that_are_not_this_imus_now_are_not_used(
    tmp_path: Path, own_imu: bool, happens: Callable[[Flight], None], why: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing is pushed, it is said once, and the disk is not asked again and again."""

    async def main() -> None:
        async with flight(tmp_path, own_imu=own_imu, imu_rate_hz=50.0) as flying:
            in_air(flying)
            await flying.sleep(3.0)
            happens(flying)
            killed_s = flying.rig.now_s + flying.rig.wire.delay_s[1]  # one may be on its way
            looks, history = Counter[str](), RecordStore.history

            def counted(store: RecordStore, limit: int | None = None) -> list[Record]:
                looks["history"] += 1
                return history(store, limit)

            monkeypatch.setattr(RecordStore, "history", counted)
            await flying.rig.restart()
            await flying.sleep(5.0)
            assert looks["history"] == 2  # at the start, and here
            assert not flying.witness.of(Vision, killed_s)
            assert flying.attitude.view()["why_not"] == why
            texts = [text for text in flying.rig.ground.texts() if "not pushed" in text]
            assert texts == [f"Attitude not pushed: {why}"]

    run_virtual(main())


def test_a_cancelled_calibration_hides_none(tmp_path: Path) -> None:
    """One that ran by itself and was ended by arming is the latest record, and changed nothing."""

    async def main() -> None:
        async with flight(tmp_path) as flying:
            in_air(flying)
            await flying.sleep(3.0)
            store = RecordStore(tmp_path)
            (record,) = store.history()
            store.save(msgspec.structs.replace(record, state="cancelled", started_at="later"))
            await flying.rig.restart()
            await flying.pushing(WITHIN_S - STARTS_S)

    run_virtual(main())


def test_an_autopilot_has_outlived_the_power_cut_of_our_board(tmp_path: Path) -> None:
    """Its offsets are as they were, whatever our clock says now."""

    async def main() -> None:
        async with flight(tmp_path, own_imu=False, imu_rate_hz=50.0) as flying:
            in_air(flying)
            await flying.sleep(3.0)
            of_another_power_up(flying)
            await flying.rig.restart()
            await flying.pushing(WITHIN_S - STARTS_S)

    run_virtual(main())


def test_after_the_landing_all_goes_on_as_ever(tmp_path: Path) -> None:
    """Disarmed, the next calibration aligns it anew, and the next arming is one."""

    async def main() -> None:
        # With other dice so quick a calibration may be "not seen to work" in integers.
        async with flight(tmp_path, at_arm="warn", seed=2) as flying:
            rig = flying.rig
            rig.autopilot.arm()
            await flying.sleep(3.0)
            await rig.restart()
            await flying.pushing(WITHIN_S - STARTS_S)
            rig.autopilot.disarm()
            await rig.until(lambda: rig.service.core.vehicle.arm_state is ArmState.DISARMED, 10.0)
            await flying.sleep(5.0)
            await flying.calibrate()
            await flying.pushing()
            await rig.until(lambda: flying.attitude.carrier.alignments == 2, 10.0)
            said = len(rig.ground.texts())
            rig.autopilot.arm()
            await flying.sleep(2.0)
            assert any(text.startswith("Armed: calibrated") for text in rig.ground.texts()[said:])

    run_virtual(main())


def test_killed_and_started_again_as_processes_are(tmp_path: Path) -> None:
    """SIGKILL of a real daemon on ptys and UDP, in a turn."""

    async def main() -> None:
        loop = asyncio.get_running_loop()
        async with live_aircraft(tmp_path, '\n[push]\nattitude = "yaw"\n' + QUICK) as world:
            autopilot = world.autopilot
            came: list[tuple[float, float]] = []  # instant, yaw: how late it arrives is the machine's
            take = autopilot.receive
            codec = mavlink.MAVLink(None)

            def receive(data: bytes, t_s: float) -> None:
                for message in codec.parse_buffer(data) or ():
                    if isinstance(message, Vision):
                        came.append((message.usec * 1e-6, message.yaw))
                take(data, t_s)

            autopilot.receive = receive  # type: ignore[method-assign]

            async def pushed(count: int) -> None:
                came.clear()
                while len(came) < count:
                    await asyncio.sleep(0.05)

            async with CompanionProcess(tmp_path) as daemon:
                await daemon.ready()
                record = await daemon.calibrate(60.0)
                assert record["state"] == "done", record["reason"]
                await pushed(1)
                autopilot.arm()
                start_s = world.aircraft.time_at(loop.time()) + 0.1
                world.aircraft.add(SlowTurn(start_s=start_s, duration_s=300.0, rate_deg_s=10.0))
                await pushed(60)
                daemon.kill()
                await daemon.ended(60.0)
            started_s = loop.time()
            async with CompanionProcess(tmp_path):
                await pushed(30)
            truth = [world.aircraft.angles_rad(world.aircraft.time_at(t_s))[2] for t_s, _ in came]
            wrong = [math.remainder(yaw - true, 2.0 * math.pi) for (_, yaw), true in zip(came, truth, strict=True)]
            print(f"pushed {came[0][0] - started_s:.2f} s after the start")
            assert math.degrees(max(map(abs, wrong))) < 2.0

    asyncio.run(main())

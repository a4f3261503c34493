"""A daemon that dies in flight and is started again: it goes on only where it agrees with the autopilot."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.autopilot.vehicle.vehicle import ArmState
from companion.estimation.records.history import PowerUp
from companion.estimation.records.record import Record
from companion.storage.records import BiasStore, RecordStore
from sim.devices import HMR3300
from sim.motions import SlowTurn
from tests.e2e.test_attitude_push import Firmware, Flight, Vision, flight

WITHIN_S = 3.0
STARTS_S = 0.5
"""Start time of a process until its first heartbeat, which virtual time does not show."""
DIFFERS = {f"heading differs by {off_deg} deg from the autopilot's" for off_deg in (39, 40, 41)}
READING = (mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, mavlink.MAV_CMD_REQUEST_MESSAGE)


def in_air(flying: Flight, rate_deg_s: float = 12.0) -> None:
    """Armed, and turning from now on."""
    flying.rig.autopilot.arm()
    start_s = flying.rig.aircraft.time_at(flying.rig.now_s) + 0.1
    flying.rig.aircraft.add(SlowTurn(start_s=start_s, duration_s=300.0, rate_deg_s=rate_deg_s))


def worst_deg(flying: Flight, since_s: float) -> float:
    """Largest error of the sent headings at their own instants."""
    aircraft = flying.rig.aircraft
    sent = flying.witness.of(Vision, since_s)
    truth = [aircraft.angles_rad(message.usec * 1e-6 - aircraft.loop_time_of(0.0))[2] for message in sent]
    wrong = [math.remainder(message.yaw - yaw, 2.0 * math.pi) for message, yaw in zip(sent, truth, strict=True)]
    return math.degrees(max(map(abs, wrong)))


def begun(flying: Flight, since_s: float) -> list[str]:
    """List what the new daemon started besides reading."""
    return [
        message.get_type()
        for t_s, message in flying.witness.heard
        if t_s > since_s
        and isinstance(message, mavlink.MAVLink_param_set_message | mavlink.MAVLink_command_long_message)
        and getattr(message, "command", None) not in READING
    ]


@pytest.mark.parametrize(("firmware", "own_imu"), [("ardupilot", False), ("px4", True)])
async def test_it_goes_on_within_three_seconds_in_a_turn(tmp_path: Path, firmware: Firmware, own_imu: bool) -> None:
    """The heading is right, and nothing else starts: no calibration, no write, no message about arming."""

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


async def test_a_compass_that_lies_since_is_not_followed(tmp_path: Path) -> None:
    """A compass off by 40 degrees: nothing is pushed, and the reason is reported, until it is right again."""

    async with flight(tmp_path, firmware="px4") as flying:
        rig = flying.rig
        in_air(flying)
        await flying.sleep(6.0)
        compass = rig.devices["compass"]
        assert isinstance(compass, HMR3300)
        compass.heading_error_deg = 40.0
        killed_s = rig.now_s
        await rig.restart()
        await flying.sleep(6.0)
        # The last one from before the restart may still have been on its way.
        assert not [m for m in flying.witness.of(Vision, killed_s) if m.usec * 1e-6 > killed_s]
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


async def test_who_may_be_armed_is_carried_as_in_flight(tmp_path: Path) -> None:
    """On the ground, its heartbeats lost: it may have armed, so that no stillness is believed until they are back."""

    async with flight(tmp_path) as flying:
        rig, carrier = flying.rig, flying.attitude.carrier
        await rig.until(lambda: (carrier.phase, carrier.still) == ("ground", True), 10.0)
        rig.double.faults.heartbeat_off = True
        await rig.until(lambda: rig.service.core.vehicle.arm_state is ArmState.UNKNOWN, 10.0)
        await flying.sleep(2.0)
        assert (carrier.phase, carrier.still) == ("flight", False)
        rig.double.faults.heartbeat_off = False
        await rig.until(lambda: (carrier.phase, carrier.still) == ("ground", True), 10.0)


def exchanged_part(flying: Flight) -> None:
    flying.rig.double.set_parameter("INS_GYR_ID", flying.rig.double.parameter("INS_GYR_ID") + 1)


def of_another_power_up(flying: Flight) -> None:
    store, replace = BiasStore(flying.rig.config.storage.path), msgspec.structs.replace
    before = PowerUp(host="before the power cut", since_unix_s=None)
    store.write({
        name: replace(known, points=tuple(replace(point, power_up=before) for point in known.points))
        for name, known in store.all().items()
    })  # fmt: skip


def undone(flying: Flight) -> None:
    store = RecordStore(flying.rig.config.storage.path)
    (record,) = store.history()
    store.save(msgspec.structs.replace(record, undone_at="2026-11-23T12:00:00+00:00"))


@pytest.mark.parametrize(
    ("own_imu", "happens", "why"),
    [
        (False, exchanged_part, "the IMU was changed (gyro (device id)) since its calibration"),
        (True, of_another_power_up, "the IMU was without power since its calibration"),
        (True, undone, "no calibration is active"),
    ],
)
async def test_biases_that_are_not_this_imus_now_are_not_used(
    tmp_path: Path, own_imu: bool, happens: Callable[[Flight], None], why: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing is pushed, it is said once, and the disk is not asked again and again."""

    async with flight(tmp_path, own_imu=own_imu, imu_rate_hz=50.0) as flying:
        in_air(flying)
        await flying.sleep(3.0)
        happens(flying)
        killed_s = flying.rig.now_s + flying.rig.wire.delay_s[1]  # one may be on its way
        looks, history = list[int | None](), RecordStore.history

        def counted(store: RecordStore, limit: int | None = None) -> list[Record]:
            looks.append(limit)
            return history(store, limit)

        monkeypatch.setattr(RecordStore, "history", counted)
        await flying.rig.restart()
        await flying.sleep(5.0)
        assert len(looks) == 1
        # The last one from before the restart may still have been on its way.
        assert not [m for m in flying.witness.of(Vision, killed_s) if m.usec * 1e-6 > killed_s]
        assert flying.attitude.view()["why_not"] == why
        texts = [text for text in flying.rig.ground.texts() if "not pushed" in text]
        assert texts == [f"Attitude not pushed: {why}"]


async def test_an_autopilot_has_outlived_the_power_cut_of_our_board(tmp_path: Path) -> None:
    """The offsets of the autopilot are unchanged, whatever our clock says."""

    async with flight(tmp_path, own_imu=False, imu_rate_hz=50.0) as flying:
        in_air(flying)
        await flying.sleep(3.0)
        of_another_power_up(flying)
        await flying.rig.restart()
        await flying.pushing(WITHIN_S - STARTS_S)

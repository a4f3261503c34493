"""The flying bench's pure parts: what sensors see of a told truth, and what is made of a flight's record."""

from __future__ import annotations

import math

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.flying.ardupilot import state_of
from sim.flying.px4 import GroundTruth, source_changes
from sim.flying.vehicle import FlyingAircraft, State
from sim.flying.verdict import Event, Record, figures, row
from sim.imu_model import ImuModel
from sim.scenario import site_at

STEP_S = 0.001
STRUCK_S = 20.0


def yawed(yaw_rad: float) -> tuple[float, float, float, float]:
    return (math.cos(yaw_rad / 2.0), 0.0, 0.0, math.sin(yaw_rad / 2.0))


def turning(speed: float, rate_rad_s: float, seconds: float = 4.0) -> FlyingAircraft:
    """An aircraft that turns, told by a firmware whose clock runs at `speed` times the wall's."""
    aircraft = FlyingAircraft(site_at(40.0, 116.0, 50.0), heading_deg=30.0, unix_s=1_795_219_200.0)
    aircraft.begin(100.0)
    jitter = np.random.default_rng(3).uniform(0.0, 0.002, round(seconds / STEP_S))
    for k, late_s in enumerate(jitter):
        own_s = k * STEP_S
        force = (0.0, 0.0, -9.80665)
        state = State(own_s, yawed(rate_rad_s * own_s), (0.0, 0.0, rate_rad_s), force, (0.0,) * 3, (0.0,) * 3)
        aircraft.take(state, 100.0 + own_s / speed + late_s)
    return aircraft


@pytest.mark.parametrize("speed", [1.0, 0.9])
def test_an_imu_integrates_to_the_attitude_however_slow_the_firmware_is(speed: float) -> None:
    aircraft = turning(speed, 1.0)
    times = 4.0 / speed + np.arange(-0.8, -0.05, 0.005)
    readings = ImuModel(aircraft, "perfect").read(times, 0.005)
    turned = (readings[:, 2] - aircraft.truth_at(0.0).rate_rad_s[2]).sum() * 0.005
    seen = aircraft.angles_rad(times[-1])[2] - aircraft.angles_rad(times[0] - 0.005)[2]
    assert turned == pytest.approx(seen, abs=2e-3)
    assert seen == pytest.approx(0.75 * speed, abs=0.01)
    assert readings[:, 5] == pytest.approx(-9.80665, abs=1e-3)


def test_what_arrives_late_is_not_lost_to_an_imu() -> None:
    """States in bursts of 40 ms: the gyro turns by as much as the aircraft."""
    aircraft = FlyingAircraft(site_at(40.0, 116.0, 50.0), heading_deg=30.0, unix_s=1_795_219_200.0)
    aircraft.begin(100.0)
    model, turned = ImuModel(aircraft, "perfect"), []
    for burst in range(100):
        for k in range(10 * burst, 10 * burst + 10):
            own_s = 0.004 * k
            state = State(own_s, yawed(own_s), (0.0, 0.0, 1.0), (0.0, 0.0, -9.80665), (0.0,) * 3, (0.0,) * 3)
            aircraft.take(state, 100.0 + own_s)
        turned += model.read(0.04 * burst + np.arange(0.0, 0.04, 0.005) + 0.04, 0.005)[:, 2].tolist()
    earth = aircraft.truth_at(-1.0).rate_rad_s[2]
    assert (np.array(turned[80:]) - earth).sum() * 0.005 == pytest.approx(3.6, abs=0.02)


def test_what_ardupilot_tells_a_slave() -> None:
    line = (
        b'\n{"timestamp":1.500000,"imu":{"gyro":[0.1,0.2,0.3],"accel_body":[1.0,2.0,-9.8]},"position":[4.0,5.0,-6.0],'
        b'"quaternion":[1.0,0.0,0.0,0.0],"velocity":[7.0,8.0,9.0],"no_time_sync":1}\n'
    )
    state = state_of(line)
    assert state is not None
    assert (state.own_s, list(state.rate_rad_s), list(state.position_m)) == (1.5, [0.1, 0.2, 0.3], [4.0, 5.0, -6.0])
    assert state_of(b'{"timestamp": 1.0}') is None
    assert state_of(b"noise") is None


def hovered(**off: float) -> Record:
    """A hover of 40 s at 10 m, struck at 20 s; `off` is reached linearly from then on."""
    own_s = np.arange(0.0, 40.0, 0.02)
    share = np.clip((own_s - STRUCK_S) / 20.0, 0.0, 1.0)
    truth = np.zeros((len(own_s), 10))
    truth[:, 0], truth[:, 3], truth[:, 6] = own_s, 3.0, -10.0 + off.get("falls_m", 0.0) * share
    truth[:, 5] = off.get("drifts_m", 0.0) * share
    truth[:, 1] = off.get("rolls_rad", 0.0) * share
    record = Record("kill", "script", (5.0, 90.0), truth, struck_s=STRUCK_S)
    yaw = 3.0 + 0.01 + math.radians(off.get("yaw_deg", 0.0)) * share
    record.estimate = np.column_stack([own_s, (yaw + math.pi) % math.tau - math.pi, np.zeros(len(own_s))])
    record.place = np.column_stack(
        [own_s, 7.0 + truth[:, 4], truth[:, 5] + off.get("misled_m", 0.0) * share, truth[:, 6]]
    )
    return record


def test_a_good_flight() -> None:
    record = hovered(yaw_deg=4.0, drifts_m=1.0)
    record.events = [Event(10.0, "mode", "5"), Event(20.7, "set", "3"), Event(33.0, "set", "1")]
    found = figures(record)
    assert found.yaw_deg == pytest.approx(4.0 + math.degrees(0.01), abs=0.05)
    assert found.fallback_s == pytest.approx(0.7)
    assert (found.estimate_m, found.spot_m) == pytest.approx((0.0, 1.0), abs=0.01)
    assert not found.wrong
    assert row(record, found).endswith("good")


def circled(**off: float) -> Record:
    """A plane on a circle of 120 m about 50 m north of its start, once in 40 s; from the fault on it goes outwards."""
    record = hovered()
    angle = record.truth[:, 0] / 40.0 * math.tau
    radius_m = 121.0 + off.get("outwards_m", 0.0) * np.clip((record.truth[:, 0] - STRUCK_S) / 20.0, 0.0, 1.0)
    record.truth[:, 4], record.truth[:, 5] = 50.0 + radius_m * np.cos(angle), radius_m * np.sin(angle)
    record.place[:, 1:3] = record.truth[:, 4:6]
    record.circle = (50.0, 0.0, 120.0)
    return record


def test_a_plane_is_to_stay_on_its_circle_as_well_as_before() -> None:
    assert figures(circled()).spot_m == pytest.approx(0.0, abs=0.01)
    assert figures(circled(outwards_m=2.0)).spot_m == pytest.approx(2.0, abs=0.01)
    assert figures(circled(outwards_m=4.0)).wrong == ["place above 3 m"]


@pytest.mark.parametrize(
    ("off", "words"),
    [
        ({"yaw_deg": 12.0}, "yaw above 10 deg"),
        ({"drifts_m": 3.5}, "place above 3 m"),
        ({"misled_m": 3.5}, "place above 3 m"),
        ({"falls_m": 9.5}, "came down"),
        ({"rolls_rad": 2.0}, "tipped over"),
    ],
)
def test_a_flight_that_is_not_good(off: dict[str, float], words: str) -> None:
    assert figures(hovered(**off)).wrong == [words]


def test_changes_that_nobody_asked_for() -> None:
    record = hovered()
    record.events = [Event(21.0 + k, "set", str(1 + k % 2)) for k in range(3)]
    record.events += [Event(30.0, "mode", "9"), Event(31.0, "disarmed", "")]
    assert figures(record).wrong == ["3 changes of the source set", "1 changes of mode", "disarmed in the air"]


def test_px4_says_by_its_flags_which_heading_it_uses() -> None:
    """Flags as `listener` prints them; without either heading there is no event."""

    def printed(own_us: int, **flags: bool) -> str:
        lines = [f"    {name}: {on}" for name, on in flags.items()]
        return "\033[2J\n\033[H\nTOPIC: estimator_status_flags instance 0 #1\n" + "\n".join(
            [
                " estimator_status_flags",
                f"    timestamp: {own_us} (0.004000 seconds ago)",
                "    timestamp_sample: 1",
                *lines,
                "",
            ]
        )

    text = (
        printed(9_000_000, cs_ev_yaw=True, cs_mag_hdg=False, cs_mag=True)
        + printed(10_000_000, cs_ev_yaw=True, cs_mag_hdg=False)
        + printed(10_400_000, cs_ev_yaw=False, cs_mag_hdg=False)
        + printed(10_500_000, cs_ev_yaw=False, cs_mag_3d=True)
        + printed(11_500_000, cs_ev_yaw=False, cs_mag_hdg=True)
        + printed(20_000_000, cs_ev_yaw=True, cs_mag_hdg=False)
    )
    assert source_changes(text) == [Event(10.5, "set", "2"), Event(20.0, "set", "1")]
    assert source_changes("never published\n") == []


def test_what_px4_tells_of_its_truth_is_an_aircraft_that_turns_and_speeds_up() -> None:
    """Attitudes to rates, whole cm/s to forces; a clock that begins again is a boot."""
    aircraft = FlyingAircraft(site_at(40.0, 116.0, 50.0), heading_deg=30.0, unix_s=1_795_219_200.0)
    aircraft.begin(100.0)
    truth, codec = GroundTruth(aircraft, 1), mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    truth.attach(None)
    for k in range(1000):
        t_s = 0.004 * k
        told = mavlink.MAVLink_hil_state_quaternion_message(
            int(t_s * 1e6), [math.cos(0.5 * t_s), 0.0, 0.0, math.sin(0.5 * t_s)], 0.0, 0.0, 0.0,
            400_000_000 + round(1e7 * t_s**2 / 111_320.0), 1_160_000_000, 50_000 + round(1e3 * t_s),
            round(200.0 * t_s), 0, -100, 0, 0, 0, 0, 0,
        )  # fmt: skip
        truth.receive(told.pack(codec), 100.0 + t_s)
    rate, force = aircraft.truth(np.arange(2.0, 3.5, 0.01))
    assert (rate[:, 2] - aircraft.truth_at(-1.0).rate_rad_s[2]) == pytest.approx(1.0, abs=2e-3)
    ahead = np.hypot(force[:, 0], force[:, 1])
    assert ahead.mean() == pytest.approx(2.0, abs=0.02)
    assert force[:, 2] == pytest.approx(-9.80665, abs=1e-3)
    own_s, _, _, yaw, north, _, down, *_ = aircraft.recorded[-1]
    assert (yaw, north, down) == pytest.approx((own_s, own_s**2, -own_s), abs=0.06)
    assert truth.boots == 1
    truth.receive(mavlink.MAVLink_hil_state_quaternion_message(0, [1.0, 0, 0, 0], *[0] * 14).pack(codec), 110.0)
    assert truth.boots == 2
    assert not aircraft.has_state

"""STIM300 datagrams: contents, status, ranges, tilt in all quadrants."""

from __future__ import annotations

import itertools
import math
from functools import partial

import pytest

from companion.physics.gradienter import attitude_from_readings
from companion.protocols.imus.stim300 import Stim300Decoder, is_whole
from companion.samples import ImuSample, Sample, TiltSample
from sim.aircraft import Pose, VirtualAircraft
from sim.binary_imus import Stim300
from sim.imu_model import ImuModel
from tests.support import decoders
from tests.support.frames import (
    STIM_CONTENTS,
    STIM_SPECIAL_SIZES,
    crc32_mpeg2,
    stim,
    stim300,
    stim_bytes,
    stim_configuration,
)

G = 9.80665
DEG = math.pi / 180
DATAGRAM = stim300()

feed = partial(decoders.feed, Stim300Decoder)


def imus(samples: list[Sample]) -> list[ImuSample]:
    return [sample for sample in samples if isinstance(sample, ImuSample)]


def tilts(samples: list[Sample]) -> list[TiltSample]:
    return [sample for sample in samples if isinstance(sample, TiltSample)]


def test_the_crc_is_crc_32_mpeg_2_over_filled_words() -> None:
    assert crc32_mpeg2(b"123456789") == 0x0376E6E7  # the catalogue's check value
    for size in range(1, 60):
        body = bytes(range(7, 7 + size))
        assert is_whole(stim(body))
        assert not is_whole(stim(body, crc=crc32_mpeg2(body + bytes(-size % 4)) ^ 1))


@pytest.mark.parametrize("identifier", STIM_CONTENTS)
def test_each_datagram_is_read_to_its_end_and_gives_what_it_holds(identifier: int) -> None:
    contents = STIM_CONTENTS[identifier]
    datagram = stim300(identifier, latency_us=500)
    assert len(datagram) == stim_bytes(identifier)
    samples, rejected = feed(datagram + DATAGRAM)
    assert samples[-2:] == feed(DATAGRAM)[0]
    warm = {"r": 25.0, "i": 25.0 + 5.0 * contents.index("i") if "i" in contents else None}
    own: list[Sample] = []
    if "a" in contents:
        rate = (DEG, -2 * DEG, 0.5 * DEG)
        own.append(ImuSample(1.0 - 500e-6, rate, (0.0, 0.0, G), warm["r"] if "t" in contents else None, 225))
    if "i" in contents:
        own.append(TiltSample(1.0 - 500e-6, 0.0, 0.0, warm["i"] if "t" in contents else None))
    assert samples[:-2] == own
    assert rejected == ({} if own else {"nothing of use": 1})


def test_a_cr_lf_after_each_datagram_is_no_loss() -> None:
    decoder = Stim300Decoder()
    assert len(decoder.feed(10 * (DATAGRAM + b"\r\n"), 1.0)) == 20
    assert not decoder.rejected


def test_what_is_sent_at_start_up_is_stepped_over() -> None:
    specials = b"".join(stim(bytes([name]) + bytes(size - 5)) for name, size in STIM_SPECIAL_SIZES.items())
    samples, rejected = feed(specials + DATAGRAM)
    assert len(samples) == 2
    assert rejected == {"reply": len(STIM_SPECIAL_SIZES)}


@pytest.mark.parametrize(
    ("status", "reason"),
    [
        (0x80, "fault reported"),
        (0x40, "starting up"),
        (0x20, "outside operating conditions"),
        (0x11, "over range"),
        (0x0A, "fault reported"),
    ],
)
def test_a_status_with_a_complaint_spoils_its_cluster(status: int, reason: str) -> None:
    for cluster in "ra":
        samples, rejected = feed(stim300(status={cluster: status}))
        assert [type(sample) for sample in samples] == [TiltSample]
        assert feed(stim300(0x91, status={cluster: status})) == ([], {reason: 1})
    samples, rejected = feed(stim300(status={"i": status}))
    assert [type(sample) for sample in samples] == [ImuSample]
    assert rejected == {reason: 1}
    assert feed(stim300(0x92, status={"i": status})) == ([], {reason: 1})
    (warm,) = feed(stim300(0xA5, status={"t": status}))[0]
    assert isinstance(warm, ImuSample)
    assert warm.temperature_degc is None


def test_the_configuration_tells_the_range_of_the_accelerometers() -> None:
    for code, bits in ((0, 19), (3, 20), (4, 18), (6, 16)):
        datagram = stim300(0x91, accel=(1 << bits, -1 << bits, 3 << bits - 1))
        (sample,) = feed(stim_configuration(code) + datagram)[0]
        assert isinstance(sample, ImuSample)
        assert sample.accel_m_s2 == (G, -G, 1.5 * G)


@pytest.mark.parametrize(
    ("units", "imu", "tilt"),
    [
        ((0, 0, 0), True, True),
        ((8, 0, 0), True, True),
        ((1, 0, 0), False, True),
        ((3, 0, 0), False, True),
        ((0, 1, 0), False, True),
        ((0, 4, 0), False, True),
        ((0, 0, 1), True, False),
        ((0, 0, 4), True, False),
    ],
)
def test_angles_and_velocities_are_not_taken_for_rates_and_forces(
    units: tuple[int, int, int], *, imu: bool, tilt: bool
) -> None:
    samples, rejected = feed(stim_configuration(units=units) + DATAGRAM)
    assert (bool(imus(samples)), bool(tilts(samples))) == (imu, tilt)
    assert rejected.get("output unit", 0) == (0 if tilt or not imu else 1)


@pytest.mark.parametrize("bits", [16, 18, 20, 21])
def test_an_unknown_range_is_found_by_gravity_and_nothing_wrong_is_passed_on(bits: int) -> None:
    decoder = Stim300Decoder()
    accel = (round(0.6 * 2**bits), 0, round(0.8 * 2**bits))
    for number in range(300):
        samples = decoder.feed(stim300(0x91, gyro=(0, 0, 1 << 10), accel=accel, counter=number * 16 % 256), 1.0)
        # 16 of the 2000 internal samples a second lie between two datagrams: the first second has 125 of them.
        assert bool(samples) == (number >= 125)
        if samples:
            assert imus(samples)[0].accel_m_s2 == pytest.approx((0.6 * G, 0.0, 0.8 * G), abs=1e-3)
    assert decoder.rejected == {"accelerometer range not known": 125}
    decoder.interrupted()
    assert decoder.feed(stim300(0x91, accel=accel), 2.0) == []


def test_a_manoeuvre_is_not_taken_for_another_range() -> None:
    decoder = Stim300Decoder()
    for number in range(400):
        turning = stim300(0x91, gyro=(0, 0, 20 << 14), accel=(0, 0, 2 << 19), counter=number * 16 % 256)
        assert decoder.feed(turning, 1.0) == []
    assert imus(decoder.feed(stim300(0x91), 5.0))[0].accel_m_s2 == (0.0, 0.0, G)


def test_a_unit_of_10_g_is_read_at_once_and_beyond_1_g_once_it_has_rested() -> None:
    decoder = Stim300Decoder()
    for number in range(126):
        assert decoder.feed(stim300(0x91, gyro=(0, 0, 0), counter=number * 16 % 256), 1.0)
    assert imus(decoder.feed(stim300(0x91, accel=(0, 0, 8 << 19)), 2.0))[0].accel_m_s2 == (0.0, 0.0, 8 * G)


@pytest.mark.parametrize("upside_down", [False, True])
def test_tilt_in_all_quadrants_on_either_side(*, upside_down: bool) -> None:
    angles_deg = (-35.0, -10.0, 0.0, 10.0, 35.0)
    for pitch_deg, roll_deg in itertools.product(angles_deg, angles_deg):
        aircraft = VirtualAircraft(Pose(pitch_deg, roll_deg, 70.0))
        device = Stim300(ImuModel(aircraft, "adis16470", seed=1), upside_down=upside_down, inclination_noise_g=0.0)
        data = device.power_on(0.0) + b"".join(frame.data for frame in device.frames_until(0.1))
        tilt = tilts(feed(data)[0])[-1]
        pitch, roll = math.radians(pitch_deg), math.radians(roll_deg)
        assert tilt.y_deg == pytest.approx(pitch_deg, abs=1e-4)
        assert tilt.x_deg == pytest.approx(math.degrees(math.asin(math.sin(roll) * math.cos(pitch))), abs=1e-4)
        assert attitude_from_readings("axis", tilt.x_deg, tilt.y_deg) == pytest.approx((pitch, roll), abs=1e-5)


def test_the_strength_of_gravity_does_not_change_the_tilt() -> None:
    for gravity in (0.99, 1.0, 1.01):
        counts = (round(0.5 * gravity * 2**22), 0, round(math.sqrt(0.75) * gravity * 2**22))
        (tilt,) = tilts(feed(stim300(0x92, inclination=counts))[0])
        assert tilt.y_deg == pytest.approx(30.0, abs=1e-4)


@pytest.mark.parametrize(
    ("inclination", "reason"),
    [
        ((0, 0, 0), "out of range"),
        ((0, 0, 2**21 - 1), "out of range"),
        ((2**22, 0, 2**21), "over range"),
        ((0, -(2**22), 0), "over range"),
    ],
)
def test_an_inclination_that_tells_no_tilt_is_counted(inclination: tuple[int, ...], reason: str) -> None:
    assert feed(stim300(0x92, inclination=inclination)) == ([], {reason: 1})
    samples, rejected = feed(stim300(inclination=inclination))
    assert (len(imus(samples)), tilts(samples), rejected) == (1, [], {reason: 1})

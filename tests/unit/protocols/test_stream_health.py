"""Health of a stream, on made-up times."""

from __future__ import annotations

from companion.protocols.imus.imu_line import ImuLineDecoder
from companion.protocols.inclinometers.inclinometer_xy import InclinometerXyDecoder
from companion.protocols.stream_health import SILENT_AFTER_S, StreamHealth
from companion.samples import CompassSample, ImuSample, TiltSample
from tests.support.chatter import imu_frame


def imu(t_s: float, clock_s: float | None = None, x: float = 0.0) -> ImuSample:
    return ImuSample(t_s, (x, 0.0, 0.0), (0.0, 0.0, -9.8), None, None, clock_s)


def test_equal_digits_of_a_still_gradienter_or_compass_prove_nothing() -> None:
    for sample in (TiltSample(0.0, 0.43, -0.084), CompassSample(0.0, 123.4, 18.6, -0.5)):
        health = StreamHealth("any", InclinometerXyDecoder())
        for tick in range(3000):
            health.took(b"x", [sample], 0.1 * tick)
        assert health.trouble(300.0) is None
        assert health.unchanged_since_s == 0.0


def test_equal_readings_of_an_imu_do_after_a_second_and_twenty() -> None:
    fast = StreamHealth("imu_line", ImuLineDecoder())
    for tick in range(60):
        fast.took(b"x", [imu(0.001 * tick)], 0.001 * tick)
    assert fast.trouble(0.06) is None, "60 samples, but not a second"
    slow = StreamHealth("imu_line", ImuLineDecoder())
    for tick in range(40):
        slow.took(b"x", [imu(0.25 * tick)], 0.25 * tick)
        found = slow.trouble(0.25 * tick)
        assert (found is not None) == (tick >= 20), tick
    slow.took(b"x", [imu(10.0, x=1e-6)], 10.0)
    assert slow.trouble(10.0) is None


def test_what_was_damaged_two_seconds_ago_is_over() -> None:
    decoder = ImuLineDecoder()
    health = StreamHealth("imu_line", decoder)
    now_s = 0.0
    for tick in range(500):
        now_s = 0.02 * tick
        frame = imu_frame(tick)
        if 200 <= tick < 300 and tick % 3 == 0:
            frame = frame.replace(b"-9.8", b"-9.7")
        health.took(frame, decoder.feed(frame, now_s), now_s)
        found = health.trouble(now_s)
        if tick < 200 or tick > 300 + 130:
            assert found is None, (tick, found)
        if 260 <= tick < 300:
            assert found is not None
            assert found.key == "damaged"
            assert "checksum" in found.words
    assert now_s > 9.9


def damaged_for_a_second() -> tuple[ImuLineDecoder, StreamHealth]:
    """Every third frame of the last second is damaged, up to 2 s on its clock."""
    decoder = ImuLineDecoder()
    health = StreamHealth("imu_line", decoder)
    for tick in range(100):
        frame = imu_frame(tick)
        if tick >= 50 and tick % 3 == 0:
            frame = frame.replace(b"-9.8", b"-9.7")
        health.took(frame, decoder.feed(frame, 0.02 * tick), 0.02 * tick)
        health.trouble(0.02 * tick)
    return decoder, health


def test_damage_that_is_explained_is_not_held_against_the_frames_that_follow() -> None:
    for explained in (False, True):
        decoder, health = damaged_for_a_second()
        if explained:
            health.excuse()
        frame = imu_frame(100)
        health.took(frame, decoder.feed(frame, 2.0), 2.0)
        assert (health.trouble(2.0) is None) == explained


def test_silence_beats_everything_that_was_said_before() -> None:
    decoder = ImuLineDecoder()
    health = StreamHealth("imu_line", decoder)
    frame = imu_frame(1, rate="nan")
    health.took(frame, decoder.feed(frame, 0.0), 0.0)
    assert decoder.rejected["non-finite"] == 1
    found = health.trouble(SILENT_AFTER_S + 0.1)
    assert found is not None
    assert found.key == "silent"


def test_the_tail_is_bounded() -> None:
    decoder = InclinometerXyDecoder()
    health = StreamHealth("inclinometer_xy", decoder)
    for _ in range(1000):
        health.took(b"\x00" * 4096, [], 1.0)
        health.trouble(4.0)
    assert len(health._tail) <= 1024
    assert len(health._marks) < 20

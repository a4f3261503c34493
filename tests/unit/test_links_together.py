"""What waits for a fast stream's reads: order, bounds, and that nothing is lost when the stream ends."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.links.mavlink.link import MavlinkLink
from companion.links.system.together import MOST_WAITING, SECOND_S, TURNS, Together

READ_S = 0.0205
START_S = 1000.2
"""Away from the full second."""


class Taker:
    def __init__(self) -> None:
        self.got: list[tuple[bytes, float]] = []

    def __call__(self, data: bytes, t_s: float) -> None:
        self.got.append((data, t_s))


def codec() -> mavlink.MAVLink:
    return mavlink.MAVLink(None, srcSystem=1, srcComponent=1)


def attitude(boot_ms: int) -> bytes:
    packed: bytes = mavlink.MAVLink_attitude_message(boot_ms, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0).pack(codec())
    return packed


def heartbeat() -> bytes:
    packed: bytes = mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3).pack(codec())
    return packed


class TestWaiting:
    def test_without_a_stream_everything_is_taken_at_once(self) -> None:
        together, taker = Together(), Taker()
        together.put(taker, b"a", 1.0)
        assert (taker.got, len(together._waiting), together.driven) == ([(b"a", 1.0)], 0, False)

    def test_waits_for_one_of_the_next_reads_in_its_order_with_its_own_time(self) -> None:
        together, taker = Together(), Taker()
        together.drive()
        for number in range(3):
            together.put(taker, bytes((number,)), START_S + 0.001 * number)
        for turn in range(1, TURNS):
            together.turn(START_S + turn * READ_S)
            assert taker.got == []
        together.turn(START_S + TURNS * READ_S)
        assert taker.got == [(bytes((number,)), START_S + 0.001 * number) for number in range(3)]

    @pytest.mark.parametrize(("fraction_s", "taken"), [(0.0, True), (SECOND_S - 1e-6, True), (SECOND_S + 1e-6, False)])
    def test_behind_a_full_second_each_read_takes_it(self, fraction_s: float, taken: bool) -> None:
        together, taker = Together(), Taker()
        together.drive()
        together.put(taker, b"last of a second", 999.995)
        together.turn(1000.0 + fraction_s)
        assert bool(taker.got) == taken

    def test_a_flood_does_not_pile_up(self) -> None:
        together, taker = Together(), Taker()
        together.drive()
        most = 0
        for number in range(1000):
            together.put(taker, b"", float(number))
            most = max(most, len(together._waiting))
        assert most == MOST_WAITING - 1
        together.drain()
        assert [t_s for _, t_s in taker.got] == [float(number) for number in range(1000)]

    def test_nothing_is_lost_when_the_last_stream_ends(self) -> None:
        together, taker = Together(), Taker()
        together.drive()
        together.drive()
        together.put(taker, b"a", 1.0)
        together.rest()
        assert taker.got == [], "another one still drives"
        together.rest()
        assert taker.got == [(b"a", 1.0)]

    def test_a_taker_that_fails_costs_the_others_nothing(self, caplog: pytest.LogCaptureFixture) -> None:
        def fail(data: bytes, t_s: float) -> None:
            raise ZeroDivisionError

        together, taker = Together(), Taker()
        together.drive()
        together.put(fail, b"", 1.0)
        together.put(taker, b"a", 2.0)
        together.drain()
        assert taker.got == [(b"a", 2.0)]
        assert "taking what has waited failed" in caplog.text

    def test_what_is_put_while_others_are_taken_is_taken_behind_them(self) -> None:
        together, taker = Together(), Taker()

        def first(data: bytes, t_s: float) -> None:
            together.put(taker, b"late", t_s)
            together.drain()  # asks again from within, to no harm
            taker(data, t_s)

        together.drive()
        together.put(first, b"first", 1.0)
        together.put(taker, b"second", 1.0)
        together.drain()
        assert [data for data, _ in taker.got] == [b"first", b"second", b"late"]


class TestMavlink:
    @staticmethod
    def heard(link: MavlinkLink) -> list[tuple[str, float]]:
        got: list[tuple[str, float]] = []

        def note(name: str) -> Callable[[object, float], None]:
            return lambda _message, t_s: got.append((name, t_s))

        link.subscribe(mavlink.MAVLink_attitude_message, note("ATTITUDE"))
        link.subscribe(mavlink.MAVLink_heartbeat_message, note("HEARTBEAT"))
        link.subscribe(mavlink.MAVLink_timesync_message, note("TIMESYNC"))
        return got

    def test_telemetry_waits_and_keeps_the_time_at_which_it_came(self) -> None:
        link = MavlinkLink()
        got = self.heard(link)
        link.together.drive()
        link.arrived(attitude(1), 5.001, link.receive)
        link.arrived(attitude(2) + attitude(3), 5.002, link.receive)
        assert got == []
        link.together.drain()
        assert got == [("ATTITUDE", 5.001), ("ATTITUDE", 5.002), ("ATTITUDE", 5.002)]

    @pytest.mark.parametrize("place", ["alone", "before telemetry", "behind telemetry"])
    def test_anything_else_is_taken_at_once_behind_what_waits(self, place: str) -> None:
        link = MavlinkLink()
        got = self.heard(link)
        link.together.drive()
        link.arrived(attitude(1), 5.001, link.receive)
        question = heartbeat()
        link.arrived(
            {"alone": b"", "before telemetry": b"", "behind telemetry": attitude(2)}[place]
            + question
            + (attitude(2) if place == "before telemetry" else b""),
            5.002,
            link.receive,
        )
        assert got[0] == ("ATTITUDE", 5.001)
        assert ("HEARTBEAT", 5.002) in got

    def test_what_is_asked_of_us_goes_ahead_of_telemetry_that_waits(self) -> None:
        link = MavlinkLink()
        got = self.heard(link)
        link.together.drive()
        link.arrived(attitude(1), 5.001, link.receive)
        link.arrived(mavlink.MAVLink_timesync_message(0, 77).pack(codec()), 5.002, link.receive)
        assert got == [("TIMESYNC", 5.002)]
        link.together.drain()
        assert got == [("TIMESYNC", 5.002), ("ATTITUDE", 5.001)]

    @pytest.mark.parametrize("damage", ["cut", "noise behind", "signed", "version 1", "empty"])
    def test_what_is_not_whole_plain_frames_is_not_kept_waiting(self, damage: str) -> None:
        frame = attitude(1)
        data = {
            "cut": frame[:-1],
            "noise behind": frame + b"\xfd",
            "signed": frame[:2] + b"\x01" + frame[3:] + bytes(13),
            "version 1": mavlink.MAVLink_attitude_message(1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0).pack(
                codec(), force_mavlink1=True
            ),
            "empty": b"",
        }[damage]
        link = MavlinkLink()
        link.together.drive()
        link.arrived(data, 5.0, link.receive)
        assert len(link.together._waiting) == 0

    def test_without_a_fast_stream_nothing_waits(self) -> None:
        link = MavlinkLink()
        got = self.heard(link)
        link.arrived(attitude(1), 5.0, link.receive)
        assert got == [("ATTITUDE", 5.0)]

    def test_what_came_over_the_transport_before_is_taken_before_another_is_attached(self) -> None:
        link = MavlinkLink()
        got = self.heard(link)
        link.together.drive()
        link.arrived(attitude(1), 5.0, link.receive)
        link.attach(None)
        assert got == [("ATTITUDE", 5.0)]

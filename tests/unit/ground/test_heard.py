"""Interpretation of traffic on the ground: stations, texts, and the advice when nothing is heard."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from companion.ground import heard as ground_heard
from companion.ground.heard import Address, AutopilotSeen, Fields, GroundListener

ARDUPILOT, PX4, NO_AUTOPILOT = 3, 12, 8
QUADROTOR, GCS, ONBOARD = 2, 6, 18


def beat(heard: GroundListener, system: int, component: int, *, now_s: float = 10.0, **fields: int) -> None:
    defaults = {"type": ONBOARD, "autopilot": NO_AUTOPILOT, "base_mode": 0, "system_status": 3}
    heard.update("HEARTBEAT", Address(system, component), {**defaults, **fields}, now_s)


def say(heard: GroundListener, text: str, *, component: int = 191) -> None:
    fields: Fields = {"severity": 6, "text": text}
    heard.update("STATUSTEXT", Address(1, component), fields, 10.0)


def said(heard: GroundListener) -> list[str]:
    return [text.words for text in heard.texts]


def test_the_vehicle_as_its_heartbeats_show_it() -> None:
    heard = GroundListener(191)
    beat(heard, 1, 191, now_s=10.0)
    assert heard.companions() == [1]
    assert heard.vehicle(1, 10.0) == AutopilotSeen(1, None, "unknown")
    beat(heard, 1, 1, type=QUADROTOR, autopilot=PX4, base_mode=0x80 | 1, now_s=11.0)
    assert heard.vehicle(1, 12.0) == AutopilotSeen(1, "PX4", "armed")
    beat(heard, 1, 1, type=QUADROTOR, autopilot=PX4, base_mode=1, now_s=12.0)
    assert heard.vehicle(1, 12.5) == AutopilotSeen(1, "PX4", "disarmed")
    assert heard.vehicle(1, 16.0) == AutopilotSeen(1, "PX4", "unknown"), "that heartbeat says nothing about now"


def test_lines_that_go_on_are_one_text() -> None:
    heard = GroundListener(191)
    say(heard, "Calibration failed: armed in the middle;")
    say(heard, "... old values restored")
    say(heard, "another vehicle's autopilot", component=1)
    say(heard, "Hold still 5 s")
    assert said(heard) == ["Calibration failed: armed in the middle;", "... old values restored", "Hold still 5 s"]
    whole = [text.words for text in heard.texts_of(1, 0.0)]
    assert whole == ["Calibration failed: armed in the middle; old values restored", "Hold still 5 s"]


def test_what_a_terminal_would_obey_is_not_passed_on() -> None:
    heard = GroundListener(191)
    say(heard, "calm \x1b[31mred\x07 \ufffd 5\u00b0")
    assert said(heard) == ["calm ?[31mred? ? 5 deg"]


anything = st.sampled_from([None, True, -1, 0, 2**70, 1.5, float("nan"), "", "x" * 50, "\0", [1], {"a": 1}])


@given(
    st.lists(
        st.tuples(
            st.sampled_from(["HEARTBEAT", "STATUSTEXT", "ATTITUDE"]),
            st.dictionaries(st.sampled_from(["type", "autopilot", "base_mode", "id", "chunk_seq", "text"]), anything),
        )
    )
)
def test_nothing_on_the_wire_raises(messages: list[tuple[str, dict[str, object]]]) -> None:
    heard = GroundListener(191)
    for name, fields in messages:
        heard.update(name, Address(1, 191), fields, 0.0)
    heard.summary()


def test_nobody_there_is_one_line_with_what_was_heard_and_what_to_try() -> None:
    heard = GroundListener(191)
    nothing = ground_heard.nobody_heard(heard, "udpin:0.0.0.0:14550", None, 5.0)
    for part in ("nothing heard", "udpin:0.0.0.0:14550", "5 s", "--url"):
        assert part in nothing
    beat(heard, 255, 190, type=GCS)
    assert "only 255/190 (a ground station)" in ground_heard.nobody_heard(heard, "url", None, 5.0)
    beat(heard, 1, 1, type=QUADROTOR, autopilot=PX4)
    px4 = ground_heard.nobody_heard(heard, "url", 3, 5.0)
    for part in ("component 191", "of system 3", "system 1 (PX4)", "companion status", "MAV_1_FORWARD"):
        assert part in px4
    beat(heard, 1, 1, type=QUADROTOR, autopilot=ARDUPILOT)
    ardupilot = ground_heard.nobody_heard(heard, "url", None, 5.0)
    assert "MAV_1_FORWARD" not in ardupilot
    assert "forwarded" in ardupilot
    for line in (nothing, px4, ardupilot):
        assert "\n" not in line

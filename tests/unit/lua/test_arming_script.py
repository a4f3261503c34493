"""The script that we install on ArduPilot, under Lua 5.3 with faked bindings (autopilots 5.3, "Aux auth")."""

from __future__ import annotations

import math
import shutil
import struct
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.component.component import ArmingScript
from companion.component.service import ArmAnswer
from companion.links.mavlink.link import MavlinkLink
from companion.lua import ARMING_SCRIPT
from tests.support.component import ScriptedGate

LUA = shutil.which("lua5.3")
pytestmark = [
    pytest.mark.skipif(LUA is None, reason="needs lua5.3 (Debian: apt install lua5.3)"),
    pytest.mark.real_clock,
]
HARNESS = Path(__file__).parents[2] / "support" / "fake_ardupilot.lua"
SILENT = "Companion silent: arming blocked"


class Script:
    """The script in a Lua process; every call gives (state, reason, texts)."""

    def __init__(self, kind: str, imus: int = 2) -> None:
        assert LUA is not None
        self.process = subprocess.Popen(
            [LUA, str(HARNESS), str(ARMING_SCRIPT), kind, str(imus)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self.first = self._read()

    def _read(self) -> tuple[str, str, str]:
        assert self.process.stdout is not None
        line = self.process.stdout.readline().rstrip("\n")
        state, reason, said = line.split("|")
        return state, reason, said

    def __call__(self, command: str) -> tuple[str, str, str]:
        assert self.process.stdin is not None
        print(command, file=self.process.stdin, flush=True)
        return self._read()

    def close(self) -> None:
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.close()
        self.process.wait(timeout=60)
        self.process.stdout.close()


@pytest.fixture
def script() -> Iterator[Script]:
    one = Script("both")
    yield one
    one.close()


def sent(verdict: str = "accept", words: str = "", at_arm: str = "gate") -> mavlink.MAVLink_tunnel_message:
    """The message that the companion really sends for system 7."""
    link, gate = MavlinkLink(), ScriptedGate()
    link.join((7, 1))
    gate.asks_script, gate.at_arm, gate.says = True, at_arm, ArmAnswer(verdict, words)  # type: ignore[assignment, arg-type]
    data: list[bytes] = []
    link.attach(data.append)
    assert ArmingScript(link, gate).step(0.0) < math.inf
    message = mavlink.MAVLink(None).parse_char(data[0])
    assert isinstance(message, mavlink.MAVLink_tunnel_message)
    return message


def received(message: mavlink.MAVLink_tunnel_message, system: int = 7, component: int = 191, number: int = 385) -> str:
    """`receive` with the bytes as ArduPilot's scripts get them: the C structure of a message, payload at byte 12."""
    header = struct.pack("<HBBBBBBB", 0, 0xFD, 133, 0, 0, 5, system, component) + number.to_bytes(3, "little")
    payload = struct.pack(
        "<HBBB", message.payload_type, message.target_system, message.target_component, message.payload_length
    ) + bytes(message.payload)
    return "receive " + (header + payload.ljust(255, b"\0")).hex()


def test_arming_is_blocked_from_the_first_line_on(script: Script) -> None:
    assert script.first[:2] == ("failed", SILENT)
    assert script("run 10000")[:2] == ("failed", SILENT)


def test_an_accept_opens_the_gate_and_three_seconds_of_silence_close_it(script: Script) -> None:
    script(received(sent()))
    assert script("run 200")[0] == "passed"
    assert script("run 2800")[0] == "passed"
    assert script("run 400")[:2] == ("failed", SILENT)


@pytest.mark.parametrize("verdict", ["wait", "refuse"])
def test_the_reason_is_what_the_pilot_reads_in_at_most_41_characters(script: Script, verdict: str) -> None:
    script(received(sent(verdict, "hold still 6 s")))
    assert script("run 200")[:2] == ("failed", "Companion: hold still 6 s")
    script(received(sent(verdict, "no data from gradienter for 3600 s, look at its cable")))
    state, reason, _ = script("run 200")
    assert state == "failed"
    assert reason == "Companion: no data from gradienter for"
    script(received(sent(verdict, "hold still 49 s: calibrates by itself")))
    assert script("run 200")[1] == "Companion: hold still 49 s"


def test_a_companion_that_no_longer_gates_lets_go(script: Script) -> None:
    script(received(sent("refuse", "x", at_arm="warn")))
    assert script("run 200")[0] == "passed"


@pytest.mark.parametrize(
    "wrong",
    [
        {"system": 8},
        {"component": 190},
        {"component": 1},
        {"number": 384},
    ],
)
def test_only_our_own_companion_counts(script: Script, wrong: dict[str, int]) -> None:
    script(received(sent(), **wrong))
    assert script("run 200")[:2] == ("failed", SILENT)


def test_other_payloads_do_not_count(script: Script) -> None:
    for change in ("payload_type", "target_system", "target_component"):
        message = sent()
        setattr(message, change, getattr(message, change) + 1)
        script(received(message))
    message = sent()
    message.payload = [ord("X"), *message.payload[1:]]
    script(received(message))
    message = sent()
    message.payload_length = 5  # the mark and nothing behind it
    script(received(message))
    assert script("run 400")[:2] == ("failed", SILENT)


def test_the_gate_can_be_switched_off_and_on(script: Script) -> None:
    script("set CMPG_ENABLE 0")
    assert script("run 200")[0] == "passed"
    script("set CMPG_ENABLE 1")
    assert script("run 200")[:2] == ("failed", SILENT)


def test_a_fault_in_the_script_closes_the_gate_and_it_goes_on(script: Script) -> None:
    script(received(sent()))
    assert script("run 200")[0] == "passed"
    script("break")
    state, reason, said = script("run 200")
    assert (state, reason) == ("failed", "Companion script error")
    assert "Companion gate:" in said
    script(received(sent()))
    assert script("run 1000")[0] == "passed"


def test_silence_is_seen_across_the_wrap_of_the_millisecond_counter(script: Script) -> None:
    script(f"skip {2**32 - 1000}")
    script(received(sent()))
    assert script("run 200")[0] == "passed"
    assert script("run 2600")[0] == "passed"
    assert script("run 600")[:2] == ("failed", SILENT)


@pytest.mark.parametrize("kind", ["4.5", "colon"])
def test_mavlink_is_called_as_each_version_wants_it(kind: str) -> None:
    script = Script(kind)
    script(received(sent()))
    assert script("run 200")[0] == "passed"
    script.close()


def test_before_4_5_no_script_hears_mavlink_and_the_gate_says_so() -> None:
    script = Script("4.4")
    assert script("run 200")[:2] == ("failed", "Companion gate needs ArduPilot 4.5")
    script.close()


def test_another_script_that_has_taken_mavlink_is_named() -> None:
    script = Script("taken")
    assert script("run 200")[:2] == ("failed", "Companion gate: MAVLink used elsewhere")
    script.close()


SET_UP = ("set EK3_SRC1_YAW 6", "set EK3_SRC2_YAW 1", "set EK3_SRC3_YAW 0", "set EK3_SRC3_VELXY 3")


@pytest.fixture
def flown(script: Script) -> Script:
    """Script after `companion autopilot params`, with the stream present, armed."""
    for each in (*SET_UP, "fly healthy 1", "fly armed 1", "run 2000"):
        script(each)
    return script


def source(script: Script) -> str:
    return script("source")[2]


def test_a_stream_that_ends_in_flight_leaves_the_heading_to_the_gyros_within_half_a_second(flown: Script) -> None:
    """And not to a compass that may have come to lie."""
    flown("fly healthy 0")
    assert flown("run 250")[2] == ""
    assert flown("run 150")[2] == "4:Heading: gyros, none from companion"
    flown("run 600000")
    assert source(flown) == "set 3"


def test_on_the_ground_it_is_the_compass(flown: Script) -> None:
    flown("fly armed 0")
    flown("fly healthy 0")
    assert flown("run 400")[2] == "4:Heading: compass, none from companion"
    assert source(flown) == "set 2"


def test_a_gap_of_a_moment_does_nothing(flown: Script) -> None:
    for _ in range(20):
        flown("fly healthy 0")
        flown("run 200")
        flown("fly healthy 1")
        flown("run 50")
    assert source(flown) == "set 1"


def test_the_companions_heading_is_taken_again_after_ten_good_seconds_in_a_row(flown: Script) -> None:
    flown("fly healthy 0")
    flown("run 1000")
    flown("fly healthy 1")
    flown("run 9000")
    flown("fly healthy 0")
    flown("run 100")
    flown("fly healthy 1")
    assert flown("run 9900")[2] == ""
    assert source(flown) == "set 3"
    assert flown("run 200")[2] == "4:Heading: companion"
    assert source(flown) == "set 1"


def test_a_heading_that_turns_by_itself_is_left_until_the_aircraft_is_disarmed(flown: Script) -> None:
    flown(f"fly turns {math.radians(3.0)}")
    assert flown("run 1500")[2] == ""
    assert flown("run 1500")[2] == "4:Heading: gyros, companion's drifts"
    flown("fly turns 0")
    flown("run 60000")
    assert source(flown) == "set 3"
    flown("fly armed 0")
    assert flown("run 200")[2] == "4:Heading: companion"


def test_a_turn_that_the_gyros_see_is_none_of_the_headings(flown: Script) -> None:
    for rate_deg_s in (3.0, 90.0, -200.0):
        flown(f"fly turns {math.radians(rate_deg_s)}")
        flown(f"fly rate {math.radians(rate_deg_s + 0.5)}")
        assert flown("run 20000")[2] == ""
    assert source(flown) == "set 1"


def test_somebody_elses_choice_of_sources_stays(flown: Script) -> None:
    flown("fly set 1")
    flown("run 60000")
    assert source(flown) == "set 2"
    flown("fly set 2")
    flown("run 60000")
    assert source(flown) == "set 3"


@pytest.mark.parametrize("otherwise", [
    "set EK3_SRC1_YAW 1", "set EK3_SRC2_YAW 6", "set EK3_SRC3_YAW 1", "set EK3_SRC3_VELXY 0", "set CMPG_HEADING 0",
])  # fmt: skip
def test_where_the_sets_are_not_ours_nothing_is_switched(flown: Script, otherwise: str) -> None:
    flown(otherwise)
    flown("run 1000")
    flown("fly healthy 0")
    flown("run 60000")
    assert source(flown) == "set 1"


@pytest.mark.parametrize("kind", ["4.5", "colon", "taken", "full"])
def test_the_heading_is_guarded_whatever_becomes_of_the_gate(kind: str) -> None:
    script = Script(kind)
    for each in (*SET_UP, "fly armed 1", "run 2000", "fly healthy 0", "run 500"):
        script(each)
    assert source(script) == "set 3"
    script.close()

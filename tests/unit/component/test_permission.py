"""Senders that component 191 obeys: `mavlink.allow`."""

from __future__ import annotations

import asyncio
import logging
from contextlib import AbstractAsyncContextManager

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.component.commands import MAX_REMEMBERED, Permission
from companion.component.own_parameters import Parameter
from companion.config import parse
from companion.config.sections import EVERYBODY, Senders
from companion.errors import ConfigError
from tests.support.component import (
    ACCEPTED,
    CALIBRATE,
    CANCEL,
    DENIED,
    PREFLIGHT,
    UNDO,
    ComponentBench,
    Ground,
    bench,
    command_message,
)
from tests.unit.config.test_config import GOOD


def allowing(*entries: str) -> AbstractAsyncContextManager[ComponentBench]:
    return bench(allow=entries, parameters=[Parameter("CMP_PUSH", 1.0, 0.0, 1.0, lambda _value: None)])


@pytest.mark.parametrize(
    ("entry", "inside", "outside"),
    [
        ("*", [(0, 0), (1, 1), (255, 255)], []),
        ("255", [(255, 0), (255, 190), (255, 255)], [(254, 190), (1, 255)]),
        ("255:190", [(255, 190)], [(255, 191), (190, 255)]),
        ("250-255", [(250, 1), (255, 190)], [(249, 190)]),
        ("1:1-5", [(1, 1), (1, 5)], [(1, 6), (1, 0), (2, 1)]),
        ("*:190", [(1, 190), (255, 190)], [(255, 191)]),
        ("254-255:190-191", [(254, 191)], [(253, 191), (254, 192)]),
    ],
)
def test_what_an_entry_means(entry: str, inside: list[tuple[int, int]], outside: list[tuple[int, int]]) -> None:
    senders = Senders([entry])
    assert all(sender in senders for sender in inside)
    assert not any(sender in senders for sender in outside)
    config = parse(GOOD.replace("[[imu]]", f'allow = ["{entry}"]\n[[imu]]', 1), "x.toml")
    assert config.mavlink.allow == (entry,)


@pytest.mark.parametrize(
    "entry", ["", "256", "-1", "a", "1:", ":1", "1:2:3", "5-4", "1-", "1:300", "1,2", " 1", "1 ", "**", "1-2-3", "٣"]
)
def test_what_is_no_entry(entry: str) -> None:
    with pytest.raises(ConfigError, match=r"x\.toml: 'mavlink\.allow': found .*allowed: \"SYSTEM\" or"):
        parse(GOOD.replace("[[imu]]", f'allow = ["255", "{entry}"]\n[[imu]]', 1), "x.toml")


@pytest.mark.parametrize("value", ['"255"', "[255]", "255"])
def test_what_is_no_list_of_texts(value: str) -> None:
    with pytest.raises(ConfigError, match=r"'mavlink\.allow.*': found .*allowed: a list, each a text"):
        parse(GOOD.replace("[[imu]]", f"allow = {value}\n[[imu]]", 1), "x.toml")


def test_everybody_may_unless_the_configuration_says_otherwise() -> None:
    """QGroundControl, Mission Planner, MAVProxy and MAVSDK have ids of their users' choice: 255, 254, 250, 245 ..."""
    assert parse(GOOD, "x.toml").mavlink.allow == ("*",)
    assert Permission(Senders(EVERYBODY)).refuses((252, 190), "calibration") == ""


@pytest.mark.parametrize("int_", [False, True], ids=["LONG", "INT"])
@pytest.mark.parametrize(
    ("command", "params", "name"),
    [(CALIBRATE, (0,), "Calibration"), (PREFLIGHT, (1,), "Calibration"), (CANCEL, (), "Cancel"), (UNDO, (), "Undo")],
)
async def test_who_is_not_named_is_denied_with_the_reason(
    command: int, params: tuple[float, ...], name: str, int_: bool
) -> None:
    async with allowing("254", "255:1-189") as b:
        b.ground.command(command, *params, int_=int_)
        await asyncio.sleep(1)
        assert b.ground.acks() == [DENIED]
        assert b.ground.texts() == [f"{name} refused: 255/190 not in mavlink.allow"]
        assert len(b.ground.texts()[0]) <= 50
        assert b.service.started == []


async def test_who_is_named_may() -> None:
    async with allowing("255:190") as b:
        b.ground.command(CALIBRATE, 0)
        await asyncio.sleep(0.5)
        assert len(b.service.started) == 1
        b.ground.command(CANCEL)
        await asyncio.sleep(1)
        assert b.ground.finals(CANCEL) == [ACCEPTED]


async def test_a_stranger_cannot_cancel_what_another_has_started() -> None:
    async with allowing("255") as b:
        b.ground.command(CALIBRATE, 0)
        await asyncio.sleep(0.5)
        stranger = Ground(77, 190)
        b.link.receive(stranger.pack(command_message(CANCEL)), asyncio.get_running_loop().time())
        await asyncio.sleep(1)
        assert not b.service.jobs[0].finished.done()
        assert b.component.permission.refused == {(77, 190): 1}


def push(b: ComponentBench) -> float:
    return b.component.parameters.get("CMP_PUSH")


def set_push(ground: Ground, value: float) -> bytes:
    return ground.pack(mavlink.MAVLink_param_set_message(1, 191, b"CMP_PUSH", value, 9))


async def test_a_parameter_is_answered_with_the_value_that_stays() -> None:
    async with allowing("254") as b:
        b.ground.send_raw(set_push(b.ground, 0.0))
        await asyncio.sleep(1)
        assert push(b) == 1.0
        values = [m.param_value for _, m in b.ground.received if isinstance(m, mavlink.MAVLink_param_value_message)]
        assert values == [1.0]
        assert b.ground.texts() == ["CMP_PUSH not set: 255/190 not in mavlink.allow"]


async def test_reading_is_everybodys() -> None:
    async with allowing() as b:
        b.ground.send(mavlink.MAVLink_param_request_read_message(1, 191, b"CMP_PUSH", -1))
        b.ground.command(512, mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION)
        await asyncio.sleep(1)
        names = [m.get_type() for _, m in b.ground.received]
        assert "PARAM_VALUE" in names
        assert "AUTOPILOT_VERSION" in names
        assert b.ground.acks() == [ACCEPTED]


async def test_nobody_sets_a_parameter_under_our_own_ids() -> None:
    async with allowing("*") as b:
        b.link.receive(set_push(Ground(1, 191), 0.0), asyncio.get_running_loop().time())
        await asyncio.sleep(1)
        assert push(b) == 1.0


def test_a_refusal_is_logged_once_for_each_sender_and_strangers_are_bounded(caplog: pytest.LogCaptureFixture) -> None:
    permission = Permission(Senders([]))
    with caplog.at_level(logging.WARNING):
        for number in range(3 * 100):
            assert permission.refuses((number % 100, 190), "calibration") != ""
    assert len(permission.refused) == MAX_REMEMBERED == len(caplog.records)
    assert permission.refused[(0, 190)] == 3
    assert "calibration by 0/190 is refused: mavlink.allow does not name it" in caplog.text


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        ('signing = "require"', "'mavlink.signing_key_file' is missing"),
        (
            'signing = "on"\nsigning_key_file = "k"',
            '\'mavlink.signing\': found \'on\'; allowed: "off", "sign", "require"',
        ),
        ('signing_key_file = "keys/k"', "allowed: a path that begins with /, or the bare name of a systemd credential"),
    ],
)
def test_signing_that_cannot_be(lines: str, words: str) -> None:
    with pytest.raises(ConfigError) as caught:
        parse(GOOD.replace("[[imu]]", f"{lines}\n[[imu]]", 1), "x.toml")
    assert words in str(caught.value)


def test_a_key_file_alone_means_that_signatures_are_required(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CREDENTIALS_DIRECTORY", "/run/credentials/companion.service")

    assert parse(GOOD, "x.toml").mavlink.signing_mode == "off"
    found = parse(GOOD.replace("[[imu]]", 'signing_key_file = "mavlink.key"\n[[imu]]', 1), "x.toml").mavlink
    assert found.signing_mode == "require"
    assert str(found.signing_key_path) == "/run/credentials/companion.service/mavlink.key"
    off = parse(GOOD.replace("[[imu]]", 'signing = "off"\nsigning_key_file = "/etc/k"\n[[imu]]', 1), "x.toml").mavlink
    assert off.signing_mode == "off"
    assert str(off.signing_key_path) == "/etc/k"

"""Requests over MQTT: answered once or twice, never obeyed twice, and no flood of them grows into anything."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator
from typing import Any

import pytest

from companion.mqtt.daemon import MAX_PENDING, REMEMBER_S, REMEMBERED, Request, Requests, parse

Object = dict[str, Any]


class Daemon:
    """Answers as the daemon does: a calibration takes until `end`, while one runs another is refused."""

    def __init__(self) -> None:
        self.asked: list[Object] = []
        self.responses: list[tuple[str, Object]] = []
        self.end = asyncio.Event()
        self.running = False
        self.fault: Exception | None = None
        self.refusal: tuple[str, str] | None = None
        self.requests = Requests(self.answer, "companion/1/request/", self.respond)

    async def answer(self, request: Object) -> AsyncGenerator[Object, None]:
        self.asked.append(request)
        if self.fault is not None:
            raise self.fault
        if self.refusal is not None or (self.running and request["command"] == "calibrate"):
            kind, reason = self.refusal or ("busy", "a calibration is running (hold still 3 s)")
            yield {"kind": "error", "refusal": kind, "reason": reason}
            return
        if request["command"] == "cancel":
            await self.end.wait()
            yield {"kind": "result", "state": "cancelled", "reason": "cancelled by mqtt cancel"}
            return
        self.running = True
        while not self.end.is_set():
            yield {"kind": "progress", "state": "waiting", "percent": 0, "text": "hold still"}
            await asyncio.sleep(0.2)
        self.running = False
        yield {"kind": "result", "record": {"state": "done", "reason": "sigma 3 deg/h"}}

    def respond(self, command: str, response: Object) -> None:
        self.responses.append((command, response))

    def states(self) -> list[str]:
        return [response["state"] for _, response in self.responses]

    async def take(self, payload: bytes, command: str = "calibrate", *, retained: bool = False) -> None:
        self.requests.accept(command, payload, retained=retained)
        await asyncio.sleep(0.3)


async def test_a_calibration_is_answered_twice_with_its_transaction() -> None:
    daemon = Daemon()
    await daemon.take(b'{"transaction": "a b", "what": "gyros", "timeout_s": 60, "reboot": true}')
    assert daemon.asked == [{"command": "calibrate", "what": "gyros", "timeout_s": 60, "reboot": True, "wait": True}]
    daemon.end.set()
    await asyncio.sleep(1.0)
    assert daemon.responses == [
        ("calibrate", {"transaction": "a b", "state": "accepted", "reason": "calibration started"}),
        (
            "calibrate",
            {
                "transaction": "a b",
                "state": "done",
                "reason": "sigma 3 deg/h",
                "record": {"state": "done", "reason": "sigma 3 deg/h"},
            },
        ),
    ]


async def test_a_repeated_transaction_gets_the_same_answer_and_starts_nothing() -> None:
    daemon = Daemon()
    await daemon.take(b'{"transaction": 1}')
    await daemon.take(b'{"transaction": 1}')
    assert len(daemon.asked) == 1
    assert daemon.responses[1][1] == {**daemon.responses[0][1], "repeated": True}
    await daemon.take(b'{"transaction": 1, "what": "gyros"}')
    assert daemon.responses[2][1]["refusal"] == "request"
    daemon.end.set()
    await daemon.take(b"{}", "cancel")
    await daemon.take(b'{"transaction": 1}')
    assert daemon.states()[-1] == "done"
    assert [request["command"] for request in daemon.asked] == ["calibrate", "cancel"]
    await asyncio.sleep(REMEMBER_S)
    await daemon.take(b'{"transaction": 1}')
    assert len(daemon.asked) == 3


async def test_what_was_refused_may_be_asked_again_under_its_transaction() -> None:
    daemon = Daemon()
    daemon.refusal = ("armed", "armed: disarm first")
    await daemon.take(b'{"transaction": "x"}')
    daemon.refusal = None
    await daemon.take(b'{"transaction": "x"}')
    assert daemon.responses[0] == (
        "calibrate",
        {"transaction": "x", "state": "refused", "refusal": "armed", "reason": "armed: disarm first"},
    )
    assert daemon.states() == ["refused", "accepted"]
    await daemon.requests.close(0.0)


async def test_a_flood_is_refused_as_busy_and_leaves_nothing_behind() -> None:
    daemon = Daemon()
    for number in range(5000):
        daemon.requests.accept("cancel", b'{"transaction": %d}' % number, retained=False)
    assert len(asyncio.all_tasks()) == MAX_PENDING + 1
    assert daemon.states() == ["refused"] * (5000 - MAX_PENDING)
    assert {response["refusal"] for _, response in daemon.responses} == {"busy"}
    daemon.end.set()
    await asyncio.sleep(1.0)
    for number in range(5000):
        await daemon.take(b'{"transaction": %d}' % number, "cancel")
    assert len(daemon.requests._known) <= REMEMBERED
    assert len(asyncio.all_tasks()) == 1


async def test_a_fault_of_the_program_is_answered_too() -> None:
    daemon = Daemon()
    daemon.fault = ZeroDivisionError()
    await daemon.take(b"")
    assert daemon.responses[0][1]["state"] == "failed"
    assert "internal error" in daemon.responses[0][1]["reason"]


async def test_a_retained_request_is_reported_once_and_its_deletion_is_no_request(
    caplog: pytest.LogCaptureFixture,
) -> None:
    daemon = Daemon()
    for _ in range(3):  # three connections
        await daemon.take(b'{"transaction": "old"}', retained=True)
    assert [record.getMessage().partition(" is ignored")[0] for record in caplog.records] == [
        "mqtt: the retained request at companion/1/request/calibrate"
    ]
    assert daemon.states() == ["refused"] * 3
    await daemon.take(b"")  # on MQTT 3.1.1 its deletion looks like this
    assert daemon.asked == []
    await daemon.take(b"")
    assert len(daemon.asked) == 1
    await daemon.take(b'{"transaction": "old"}', retained=True)
    await daemon.take(b"", retained=True)  # on MQTT 5 like this
    await daemon.take(b"", "cancel")
    assert [request["command"] for request in daemon.asked] == ["calibrate", "cancel"]
    daemon.end.set()
    await daemon.requests.close(1.0)


@pytest.mark.parametrize(
    ("command", "payload", "words"),
    [
        ("calibrate", b"{", ["not JSON", "a JSON object, or nothing"]),
        ("calibrate", b"\xff\xfe", ["not JSON"]),
        ("calibrate", b"[" * 4000, ["not JSON"]),
        ("calibrate", b"[1]", ["the payload is [1]", "a JSON object, or nothing"]),
        ("calibrate", b'"on"', ['the payload is "on"']),
        ("calibrate", b" " * 5000, ["5000 bytes", "at most 4096"]),
        ("calibrate", b'{"what": "gyro"}', ["'what'", '"gyro"', '"both", "gyros", "accelerometers"']),
        ("calibrate", b'{"what": ["gyros"]}', ["'what'", '["gyros"]']),
        ("calibrate", b'{"timeout": 3}', ['unknown key "timeout"', "did you mean 'timeout_s'?"]),
        ("calibrate", b'{"timeout_s": 0}', ["'timeout_s'", "found 0", "above 0"]),
        ("calibrate", b'{"timeout_s": true}', ["'timeout_s'", "found true", "above 0"]),
        ("calibrate", b'{"timeout_s": "5"}', ["'timeout_s'", 'found "5"']),
        ("calibrate", b'{"reboot": 1}', ["'reboot'", "found 1", "true or false"]),
        ("cancel", b'{"what": "both"}', ['unknown key "what"', "allowed: transaction"]),
        ("undo", b'{"force": null}', ["'force'", "found null"]),
        ("undo", b'{"transaction": {"a": 1}}', ["'transaction'", "a whole number"]),
        ("undo", b'{"transaction": 1.5}', ["'transaction'", "found 1.5"]),
        ("undo", b'{"transaction": true}', ["'transaction'", "found true"]),
        ("undo", b'{"transaction": "%s"}' % (b"x" * 129), ["'transaction'", "128 characters"]),
        ("undo", b'{"transaction": 1%s}' % (b"0" * 400), ["'transaction'"]),
        ("calibrate", b'{"timeout_s": 1%s}' % (b"0" * 400), ["'timeout_s'"]),
        ("reboot", b"", ["unknown request 'reboot'", "calibrate, cancel, undo"]),
    ],
)
def test_a_request_that_is_none_gets_one_clear_reason(command: str, payload: bytes, words: list[str]) -> None:
    problem = parse(command, payload).problem
    for word in words:
        assert word in problem
    assert "\n" not in problem
    assert len(problem) < 300


@pytest.mark.parametrize("payload", [b"", b"  \n", b"{}", b'{"transaction": null}'])
def test_an_empty_request_is_one(payload: bytes) -> None:
    assert parse("calibrate", payload) == Request("calibrate", None, {})

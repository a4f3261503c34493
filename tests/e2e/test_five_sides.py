"""One daemon seen from five sides at once: a ground station, MQTT, the page, the monitor and the command line.

All on real processes and sockets. Everybody is told the same, in the same order, whoever has begun or ended it.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import re
import sys
from collections.abc import AsyncIterator, Awaitable, Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests.e2e.test_commands import DONE, FAILED, FlightLine, companion, flight_line
from tests.e2e.test_monitor import Watched, monitor
from tests.support.broker import Peer, broker, free_port, peer
from tests.support.component import CALIBRATE, CANCEL, CANCELLED, Ground
from tests.support.wire import Wire

ORDER = ["waiting", "collecting", "solving", "writing", "verifying", "done"]
WORDS = ["waiting", "measuring", "writing", "checking", "settling"]
"""What a person reads in the shell."""
BASE = "companion/1"
WITHIN_S = 150.0


@dataclass
class Page:
    """A browser's part: the events of the page, and its buttons."""

    port: int
    seen: list[dict[str, Any]] = field(default_factory=list)
    token: str = ""

    async def listen(self) -> None:
        async with self._connected() as (reader, writer):
            writer.write(f"GET /events HTTP/1.1\r\nHost: 127.0.0.1:{self.port}\r\n\r\n".encode())
            kind = ""
            while line := await reader.readline():
                words = line.decode().strip("\r\n")
                if words.startswith("event: "):
                    kind = words.removeprefix("event: ")
                elif words.startswith("data: "):
                    said = json.loads(words.removeprefix("data: "))
                    if kind == "hello":
                        self.token, kind = said["token"], ""
                    else:
                        self.seen.append(said)

    async def press(self, action: str) -> None:
        async with self._connected() as (reader, writer):
            head = [f"POST /{action} HTTP/1.1", f"Host: 127.0.0.1:{self.port}", f"X-Companion-Token: {self.token}"]
            head += ["Content-Type: application/json", "Content-Length: 2", "Connection: close", "", "{}"]
            writer.write("\r\n".join(head).encode())
            answer = await reader.read()
            assert answer.startswith(b"HTTP/1.1 200"), answer

    @contextlib.asynccontextmanager
    async def _connected(self) -> AsyncIterator[tuple[asyncio.StreamReader, asyncio.StreamWriter]]:
        reader, writer = await asyncio.open_connection("127.0.0.1", self.port)
        try:
            yield reader, writer
        finally:
            writer.close()
            with contextlib.suppress(OSError):
                await writer.wait_closed()


@dataclass
class Sides:
    """Everybody who looks, and what each was told so far."""

    line: FlightLine
    ground: Ground
    broker: Peer
    page: Page
    monitor: Watched

    def by_mqtt(self) -> list[dict[str, Any]]:
        return [heard.json for heard in self.broker.heard if heard.topic == f"{BASE}/calibration/progress"]

    def by_monitor(self) -> list[dict[str, Any]]:
        return [json.loads(text) for text in self.monitor.text.splitlines(keepends=True) if text.endswith("\n")]

    async def until(self, true: Callable[[], Any]) -> None:
        async with asyncio.timeout(WITHIN_S):
            while not true():
                await asyncio.sleep(0.02)

    def states(self) -> dict[str, list[str]]:
        """The states that each of the three streams has shown, in their order."""
        return {
            "mqtt": in_order(said["state"] for said in self.by_mqtt()),
            "page": in_order(said["state"] for said in self.page.seen),
            "monitor": in_order(said["state"] for said in self.by_monitor()),
        }

    async def until_all_say(self, state: str) -> str:
        """The reason that all three streams give for a state."""

        def reasons() -> set[str | None]:
            streams = (self.by_mqtt(), self.page.seen, self.by_monitor())
            return {s[-1].get("reason", s[-1].get("text")) if s and s[-1]["state"] == state else None for s in streams}

        await self.until(lambda: len(reasons()) == 1 and None not in reasons())
        return str(reasons().pop())


def in_order(states: Any) -> list[str]:
    found: list[str] = []
    for state in states:
        if found[-1:] != [state]:
            found.append(state)
    return found


@contextlib.asynccontextmanager
async def sides(folder: Path, **line_: Any) -> AsyncIterator[Sides]:
    async with contextlib.AsyncExitStack() as stack:
        one = await stack.enter_async_context(broker(folder))
        page = Page(free_port())
        more = f'{one.section()}[web]\nbind = "127.0.0.1:{page.port}"\n'
        line = await stack.enter_async_context(flight_line(folder, more=more, **line_))
        ground = Ground()
        radio = Wire(ground, line.scenario.autopilot.ground)
        stack.callback(radio.unplug)
        watcher = await stack.enter_async_context(peer(one))
        stack.push_async_callback(ended, asyncio.create_task(page.listen()))
        watched = await stack.enter_async_context(monitor(line.config, "--json"))
        them = Sides(line, ground, watcher, page, watched)
        stack.push_async_callback(ended, asyncio.create_task(beat(ground)))
        await watcher.until(f"{BASE}/status", lambda heard: heard.payload == b"online")
        await them.until(lambda: page.token and page.seen and them.by_monitor())
        yield them


async def ended(task: asyncio.Task[None]) -> None:
    task.cancel()
    with contextlib.suppress(asyncio.CancelledError, OSError):
        await task


async def beat(ground: Ground) -> None:
    while True:
        ground.send(mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_GCS, 8, 0, 0, 4, 3))
        await asyncio.sleep(1.0)


def test_one_calibration_is_the_same_story_from_five_sides(tmp_path: Path) -> None:
    async def main() -> None:
        async with sides(tmp_path) as them:
            said = await companion("-c", str(them.line.config), "calibrate", "--wait", "--json", within_s=90.0)
            assert said.code == DONE, said.err
            record = said.json
            reason = await them.until_all_say("done")
            assert reason == record["reason"]
            shell = in_order(re.findall(r"^\[ *\d+ %\] (\w+):", said.err, re.MULTILINE))
            for side, states in {**them.states(), "shell": shell}.items():
                # Short states may fall between two looks; none comes out of its turn, none is made up.
                story = [state for state in states if state != "idle"]
                order = WORDS if side == "shell" else ORDER
                assert [state for state in order if state in story] == story, (side, states)
                assert {"writing", "verifying", "checking"} & set(story), (side, states)
            kept = await them.broker.until(f"{BASE}/calibration/state", lambda heard: heard.json["state"] == "done")
            assert kept.json == record
            texts = them.ground.texts()
            started = next(n for n, text in enumerate(texts) if text.startswith("Calibration started"))
            ended = next(n for n, text in enumerate(texts) if text.startswith("Calibration done"))
            assert started < ended
            figures = re.findall(r"[\d.]+ (?:deg/h|mg)", reason)
            assert figures
            assert all(figure in texts[ended] for figure in figures), (reason, texts[ended])

    asyncio.run(main())


def test_a_cancel_from_any_side_is_seen_by_all(tmp_path: Path) -> None:
    async def main() -> None:
        # None of them is done before everybody has seen it and it has been cancelled.
        async with sides(tmp_path, still_s=(600.0, 600.0)) as them:
            config = str(them.line.config)

            async def by_shell() -> None:
                assert (await companion("-c", config, "cancel")).code == DONE

            async def by_radio() -> None:
                them.ground.command(CANCEL)

            async def by_mqtt() -> None:
                await them.broker.publish(f"{BASE}/request/cancel", {"transaction": "stop"})

            ways: dict[str, Callable[[], Awaitable[None]]] = {
                "companion cancel": by_shell,
                "ground station": by_radio,
                "mqtt cancel": by_mqtt,
                "page": lambda: them.page.press("cancel"),
            }
            reasons = set()
            for who, cancel in ways.items():
                them.broker.forget()
                them.page.seen.clear()
                acks = len(them.ground.acks(CALIBRATE))
                waiting = await asyncio.create_subprocess_exec(
                    *(sys.executable, "-m", "companion", "-c", config, "calibrate", "--wait", "--json"),
                    stdout=asyncio.subprocess.PIPE,
                    stderr=asyncio.subprocess.DEVNULL,
                )
                await them.until(lambda: {"waiting", "collecting"} & {said["state"] for said in them.page.seen})
                # The same request from the ground station joins nobody's: it is told that one is running.
                them.ground.command(CALIBRATE)
                await them.until(lambda: len(them.ground.acks(CALIBRATE)) > acks)  # noqa: B023 - awaited at once
                assert them.ground.acks(CALIBRATE)[-1] == mavlink.MAV_RESULT_TEMPORARILY_REJECTED
                await cancel()
                out, _ = await waiting.communicate()
                assert waiting.returncode == FAILED
                reason = await them.until_all_say("cancelled")
                assert json.loads(out)["reason"] == reason
                assert json.loads(out)["state"] == "cancelled"
                reasons.add(reason)
                await them.until(lambda: reason in " ".join(them.ground.texts()))  # noqa: B023 - awaited at once
                assert "cancelled" in reason, who
            assert len(reasons) == len(ways), reasons  # each says who it was

            # And one that the ground station has asked for, cancelled on the page: its request gets its one answer.
            them.ground.command(CALIBRATE)
            await them.until(lambda: them.page.seen and them.page.seen[-1]["state"] != "cancelled")
            await them.page.press("cancel")
            await them.until(lambda: them.ground.acks(CALIBRATE)[-1] == CANCELLED)

    asyncio.run(main())

"""The whole daemon, a real broker and a collector: what happens on the aircraft is in the fleet's hands afterwards."""

from __future__ import annotations

import asyncio
import contextlib
import json
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import aiomqtt
import pytest

from companion.daemon.process.check import run_check
from tests.support.broker import BEST, Broker, broker, hurry
from tests.support.fleet import Collector
from tests.support.mqtt_daemon import alone, until_connected
from tests.support.rig import Rig

UID = b"virtual 0000".ljust(18, b"\0").hex()


@pytest.fixture(autouse=True)
def _hurried(monkeypatch: pytest.MonkeyPatch) -> None:
    hurry(monkeypatch, BEST)


@contextlib.asynccontextmanager
async def collecting(one: Broker, database: dict[Any, Any]) -> AsyncIterator[Collector]:
    """A collector at a real broker, as long as that lives."""
    async with aiomqtt.Client("127.0.0.1", one.port) as client:
        said: asyncio.Queue[tuple[str, bytes]] = asyncio.Queue()
        collector = Collector(lambda topic, payload: said.put_nowait((topic, payload)))
        collector.database = database

        async def speak() -> None:
            while True:
                topic, payload = await said.get()
                await client.publish(topic, payload, qos=1)

        async def listen() -> None:
            async for message in client.messages:
                assert isinstance(message.payload, bytes)
                collector.take(message.topic.value, message.payload)

        await client.subscribe([("fleet/+/hello", 1), ("fleet/+/item", 1)])
        tasks = [asyncio.create_task(speak()), asyncio.create_task(listen())]
        try:
            yield collector
        finally:
            for task in tasks:
                task.cancel()
            for ended in await asyncio.gather(*tasks, return_exceptions=True):
                if isinstance(ended, AssertionError):
                    raise ended


async def until(what: Callable[[], bool], within_s: float = 90.0) -> None:
    async with asyncio.timeout(within_s):
        while not what():
            await asyncio.sleep(0.05)


def test_a_calibration_an_undo_and_an_arming_arrive_and_nothing_is_lost_with_the_broker(tmp_path: Path) -> None:
    async def main() -> None:
        database: dict[Any, Any] = {}
        async with broker(tmp_path) as one:
            more = f'{one.section()}[fleet]\nname = "Heron 7"\nlocation = "full"\n'
            rig = Rig(tmp_path, min_still_s=3.0, max_s=4.0, more=more)
            rig.offload = asyncio.to_thread
            async with rig.running():
                service = rig.service
                await until_connected(service)
                await rig.ready()

                async def ask(**request: Any) -> Any:
                    return [reply async for reply in service.faces.answer(request)][-1]

                async with collecting(one, database) as collector:
                    done = await ask(command="calibrate", wait=True)
                    assert done["record"]["state"] == "done"
                    await until(lambda: "calibration" in collector.kinds(UID))
                    (told,) = collector.of(UID)
                    assert told["body"] == json.loads(json.dumps(done["record"]))
                    assert told["body"]["imus"][0]["gyro_id"] == rig.autopilot.parameter("INS_GYR_ID")
                    await until(lambda: service.status()["fleet"]["waiting"] == 0)
                # Nobody collects any more, and the broker forgets everything.
                one.kill()
                assert (await ask(command="undo"))["state"] == "done"
                await until(lambda: service.status()["fleet"]["waiting"] == 1)
                await one.start()
                await until_connected(service)
                await asyncio.sleep(1.0)
                one.kill()
                rig.autopilot.armed = True
                await until(lambda: service.status()["fleet"]["waiting"] == 2)
                await one.start()
                async with collecting(one, database) as collector:
                    await until(lambda: collector.kinds(UID)[1:] == ["undo", "arming"])
                    await until(lambda: service.status()["fleet"]["waiting"] == 0)
                    assert collector.hellos[-1]["aircraft"] == UID

    asyncio.run(main())


def test_status_and_check_say_how_it_stands(tmp_path: Path) -> None:
    async def main() -> None:
        async with broker(tmp_path) as one:
            section = f"{one.section()}[fleet]\n"
            async with alone(tmp_path, section) as service:
                await until_connected(service)
                words = "no items waiting for the fleet, never confirmed so far"
                await until(lambda: service.status()["fleet"]["summary"] == words)
                config = service.config
            found = {finding.name: finding for finding in await run_check(config, 0.5)}
            assert found["fleet"].words.startswith("not looked at in a check")
            assert found["fleet"].verdict == "ok"

    asyncio.run(main())


def test_nothing_of_it_is_imported_kept_or_said_where_it_is_not_switched_on(tmp_path: Path) -> None:
    async def main() -> None:
        async with broker(tmp_path) as one, alone(tmp_path, one.section()) as service:
            await until_connected(service)
            assert service.status()["fleet"] is None
            await asyncio.sleep(1.0)
        assert not (tmp_path / "fleet.sqlite").exists()

    asyncio.run(main())

"""The link to a broker where no broker is needed."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any, Self

import pytest

from companion.config.sections import Mqtt
from companion.links.mqtt import client as mqtt
from companion.links.mqtt.client import MqttLink
from tests.support.virtual_time import run_virtual


async def at_once(function: Callable[..., Any], *arguments: Any) -> Any:
    return function(*arguments)


class Breaking(MqttLink):
    """A connection that is up at once and is lost when told so."""

    def __init__(self) -> None:
        super().__init__(Mqtt(host="broker"), client_id="me", offload=at_once)
        self.serving, self.loss = asyncio.Event(), asyncio.Event()

    def _client(self, address: str, password: str | None) -> Any:
        return None

    async def _subscribe(self, client: Any) -> None:
        pass

    async def _send(self, client: Any, broker: Any) -> None:
        await asyncio.get_running_loop().create_future()

    async def _receive(self, client: Any) -> None:
        self.serving.set()
        await self.loss.wait()
        raise OSError("thrown out")


class NoFilter:
    """Nobody is there, and nobody finds fault."""

    address, fault = "", None

    def __init__(self, *_: object) -> None:
        pass

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        pass


async def nothing(*_: object) -> None:
    pass


@pytest.fixture(autouse=True)
def _without_a_broker(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mqtt, "MqttFilter", NoFilter)
    monkeypatch.setattr(mqtt, "_enter", nothing)
    monkeypatch.setattr(mqtt, "_leave", nothing)


@pytest.mark.parametrize("turns", range(4))
def test_stopping_at_the_moment_of_a_loss_stops(turns: int) -> None:
    """Two clients of one name throw each other out again and again; whoever is stopped just then must end."""

    async def main() -> None:
        link = Breaking()
        task = asyncio.create_task(link.run())
        await link.serving.wait()
        link.loss.set()
        for _ in range(turns):
            await asyncio.sleep(0)
        task.cancel()
        done, _ = await asyncio.wait([task], timeout=60.0)
        assert done, "it goes on as if nobody had stopped it"
        assert task.cancelled()

    run_virtual(main())


def test_after_a_loss_it_connects_again() -> None:

    async def main() -> None:
        link = Breaking()
        task = asyncio.create_task(link.run())
        await link.serving.wait()
        for connections in (1, 2, 3):
            async with asyncio.timeout(60.0):
                await link.serving.wait()
            assert link.connections == connections
            link.serving.clear()
            link.loss.set()
            await asyncio.sleep(0.01)
            assert not link.connected
            assert "next attempt in" in str(link.status()["summary"])
            link.loss.clear()
        task.cancel()
        await asyncio.wait([task])

    run_virtual(main())

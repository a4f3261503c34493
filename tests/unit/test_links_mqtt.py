"""The link to a broker where no broker is needed."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any

import pytest

from companion.config.sections import Mqtt
from companion.links.mqtt import MqttLink
from tests.support.virtual_time import run_virtual


async def at_once(function: Callable[..., Any], *arguments: Any) -> Any:
    return function(*arguments)


@pytest.mark.parametrize("order", ["lost first", "stopped first"])
def test_stopping_at_the_moment_of_a_loss_stops(order: str) -> None:
    """Two clients of one name throw each other out again and again; whoever is stopped just then must end."""

    async def main() -> None:
        lost, serving = asyncio.Event(), asyncio.Event()

        class Breaking(MqttLink):
            async def _serve(self) -> None:
                async def receive() -> None:
                    serving.set()
                    await lost.wait()
                    raise OSError("thrown out")

                async with asyncio.TaskGroup() as group:
                    group.create_task(receive())

        link = Breaking(Mqtt(host="broker"), client_id="me", offload=at_once)
        task = asyncio.create_task(link.run())
        await serving.wait()
        lost.set()
        if order == "lost first":
            await asyncio.sleep(0)  # the receiver has raised, the group has not heard of it yet
        task.cancel()
        done, _ = await asyncio.wait([task], timeout=60.0)
        assert done, "it goes on as if nobody had stopped it"
        assert task.cancelled()

    run_virtual(main())

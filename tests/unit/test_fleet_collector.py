"""What waits in a collector is bounded in bytes, whatever comes from the broker."""

from __future__ import annotations

import asyncio

import pytest

from companion.fleet.collector import BATCH, BATCH_BYTES, WAITING, WAITING_BYTES, Inbox, Waiting
from companion.fleet.contract import MOST_BYTES
from companion.fleet.store import Message

LARGEST = Message("fleet/0/item", bytes(MOST_BYTES))


@pytest.mark.parametrize(
    ("queue", "most", "most_bytes"), [(Waiting, WAITING, WAITING_BYTES), (Inbox, BATCH, BATCH_BYTES)]
)
def test_what_waits_is_bounded_in_bytes_and_in_number(queue: type[Waiting], most: int, most_bytes: int) -> None:
    waiting = queue(most)
    while not waiting.full():
        waiting.put_nowait(LARGEST)
    with pytest.raises(asyncio.QueueFull):
        waiting.put_nowait(LARGEST)
    assert waiting.qsize() * MOST_BYTES == most_bytes
    waiting.get_nowait()
    waiting.put_nowait(LARGEST)
    while not waiting.empty():
        waiting.get_nowait()
    for _ in range(most):
        waiting.put_nowait(Message("fleet/0/hello", b"{}"))
    with pytest.raises(asyncio.QueueFull):
        waiting.put_nowait(Message("fleet/0/hello", b"{}"))


def test_who_brings_more_waits_for_room() -> None:
    async def main() -> None:
        inbox = Inbox(BATCH)
        while not inbox.full():
            inbox.put_nowait(LARGEST)
        bringing = asyncio.create_task(inbox.put(LARGEST))
        await asyncio.sleep(0)
        assert not bringing.done()
        inbox.get_nowait()
        async with asyncio.timeout(10.0):
            await bringing

    asyncio.run(main())

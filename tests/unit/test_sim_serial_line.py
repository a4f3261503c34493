"""The serial line of the bench: what goes in comes out, in order, and no faster than its baud rate."""

from __future__ import annotations

import asyncio
import os
from pathlib import Path

from sim.sitl.serial_line import serial_line

BAUD = 57600


def test_it_carries_all_and_no_faster_than_its_baud_rate(tmp_path: Path) -> None:
    async def main() -> None:
        loop = asyncio.get_running_loop()
        async with serial_line(BAUD, tmp_path) as (one, other):
            source, target = os.open(one, os.O_RDWR | os.O_NOCTTY), os.open(other, os.O_RDWR | os.O_NOCTTY)
            try:
                sent, heard, all_of_it = bytes(range(250)) * 4, bytearray(), asyncio.Event()

                def take() -> None:
                    heard.extend(os.read(target, 4096))
                    if len(heard) >= len(sent):
                        all_of_it.set()

                loop.add_reader(target, take)
                begun_s = loop.time()
                os.write(source, sent)
                await asyncio.wait_for(all_of_it.wait(), 20.0)
                assert bytes(heard) == sent
                assert loop.time() - begun_s > 0.9 * len(sent) * 10.0 / BAUD
                loop.remove_reader(target)
            finally:
                os.close(source)
                os.close(target)

    asyncio.run(main())

"""What reading VectorNav binary at 1 kHz costs, against a bare read loop of the same bytes on the same machine.

A writer in a process of its own sends the same 44-byte frame a thousand times a second through a pseudo-terminal. Each
reader, in a process of its own too, gives the processor time that it took from the first byte to the last:

- bare loop: poll and read, nothing else;
- bare asyncio: a reader of the event loop that reads, nothing else;
- ours: `ByteLink` and `VectorNavDecoder`, each sample handed on.

Rounds alternate between them. Part of `make bench`; by itself: python -m tests.bench_reading
"""

from __future__ import annotations

import asyncio
import multiprocessing
import os
import select
import statistics
import time
import tty
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Final

from companion.links.serial.bytestream import READ_BYTES, ByteLink, PortSettings
from companion.protocols.imus.vectornav import VectorNavDecoder
from companion.samples import Sample
from tests.support.frames import vectornav_imu

RATE_HZ: Final = 1000
FRAMES: Final = 3000
ROUNDS: Final = 5
WAIT_S: Final = 30.0
_FRAME: Final = vectornav_imu()
_TOTAL: Final = FRAMES * len(_FRAME)


def _write(master: int) -> None:
    """One frame a millisecond, each at its instant."""
    start_s = time.monotonic()
    for number in range(FRAMES):
        wait_s = start_s + number / RATE_HZ - time.monotonic()
        if wait_s > 0.0:
            time.sleep(wait_s)
        os.write(master, _FRAME)


def _bare_loop(path: str, ready: Callable[[], None]) -> float:
    port = os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    poll = select.poll()
    poll.register(port, select.POLLIN)
    ready()
    poll.poll()
    start_s, received = time.process_time(), 0
    while received < _TOTAL:
        poll.poll()
        received += len(os.read(port, READ_BYTES))
    return time.process_time() - start_s


def _bare_asyncio(path: str, ready: Callable[[], None]) -> float:
    async def main() -> float:
        loop = asyncio.get_running_loop()
        port = os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        done, started = loop.create_future(), 0.0
        received = 0

        def readable() -> None:
            nonlocal received, started
            if not received:
                started = time.process_time()
            received += len(os.read(port, READ_BYTES))
            if received == _TOTAL:
                done.set_result(None)

        loop.add_reader(port, readable)
        ready()
        await done
        return time.process_time() - started

    return asyncio.run(main())


def _ours(path: str, ready: Callable[[], None]) -> float:
    async def main() -> float:
        done: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        settings = PortSettings(path, 4_000_000)  # a pseudo-terminal has no speed, and may catch up
        decoder = VectorNavDecoder(settings.seconds_per_byte)
        started, last = 0.0, None
        count = 0

        def take(sample: Sample) -> None:
            nonlocal last, count
            last = sample
            count += 1
            if count == FRAMES:
                done.set_result(None)

        def on_bytes(data: bytes, t_s: float) -> None:
            nonlocal started
            if not started:
                started = time.process_time()
            for sample in decoder.feed(data, t_s):
                take(sample)

        def on_state(connected: bool, reason: str) -> None:
            del reason
            if connected:
                ready()

        link = ByteLink(settings, on_bytes, name="bench", on_state=on_state)
        running = asyncio.create_task(link.run())
        await done
        spent_s = time.process_time() - started
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)
        assert last is not None
        assert decoder.accepted == FRAMES, decoder.rejected
        return spent_s

    return asyncio.run(main())


READERS: Final[dict[str, Callable[[str, Callable[[], None]], float]]] = {
    "bare loop": _bare_loop,
    "bare asyncio": _bare_asyncio,
    "ours": _ours,
}


def _reader(name: str, path: str, pipe: Connection) -> None:
    pipe.send(READERS[name](path, lambda: pipe.send(None)))


def _received(pipe: Connection, name: str) -> float | None:
    if not pipe.poll(WAIT_S):
        raise TimeoutError(f"{name}: nothing came within {WAIT_S:g} s")
    answer: float | None = pipe.recv()
    return answer


def seconds_a_frame(name: str) -> float:
    """Processor time of one reader for one frame."""
    context = multiprocessing.get_context("spawn")
    master, slave = os.openpty()
    tty.setraw(slave)
    here, there = context.Pipe()
    reader = context.Process(target=_reader, args=(name, os.ttyname(slave), there), daemon=True)
    reader.start()
    try:
        _received(here, name)
        _write(master)
        spent_s = _received(here, name)
        assert spent_s is not None
        return spent_s / FRAMES
    finally:
        reader.join(1.0)
        reader.kill()
        os.close(master)
        os.close(slave)


def main() -> None:
    spent_s: dict[str, list[float]] = {name: [] for name in READERS}
    for _ in range(ROUNDS):
        for name, seconds in spent_s.items():
            seconds.append(seconds_a_frame(name))
    print(f"\nVectorNav binary at {RATE_HZ} Hz through a pseudo-terminal, processor time a frame, {ROUNDS} rounds:")
    bare = spent_s["bare loop"]
    for name, seconds in spent_s.items():
        median_us, least_us = 1e6 * statistics.median(seconds), 1e6 * min(seconds)
        ratio, least = statistics.median(seconds) / statistics.median(bare), min(seconds) / min(bare)
        print(
            f"  {name:14} median {median_us:6.1f} us, least {least_us:6.1f} us; x bare loop {ratio:5.2f} ({least:5.2f})"
        )


if __name__ == "__main__":
    main()

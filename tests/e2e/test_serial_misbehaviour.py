"""Faults of a serial line on real ports: named and counted while they last, data again within 3 s of their end.

The daemon's own sensor reads ptys and sockets in real time; sim/pty_device.py shows what a UART makes of another speed
or parity. Faults that bytes alone show: tests/unit/protocols/test_stream_health.py.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import threading
from pathlib import Path
from typing import Any

import pytest

from companion.links.system.connection import BURST_BYTES, BYTES_PER_S
from sim.pty_device import Setting
from tests.support.chatter import RECOVERY_S, Chatter, Listening, compass_frame, listening, tilt_frame

pytestmark = pytest.mark.real_clock


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "port"


def said(caplog: pytest.LogCaptureFixture, name: str, words: str) -> list[str]:
    """Warnings about a device that contain these words."""
    lines = [record.getMessage() for record in caplog.records if record.levelno >= logging.WARNING]
    return [line for line in lines if line.startswith(f"{name}: ") and words in line]


def good_again(caplog: pytest.LogCaptureFixture, name: str) -> int:
    return sum(record.getMessage().startswith(f"{name}: good again") for record in caplog.records)


async def lasts(one: Listening, caplog: pytest.LogCaptureFixture, key: str, words: str) -> None:
    """The trouble is in the words of the status, counted, and said once however long it lasts."""
    await one.until(lambda: words in one.words and one.counts.get(key) == 1, 8.0)
    name = one.sensor.name
    await one.until(lambda: said(caplog, name, words), 2.0)
    await asyncio.sleep(1.5)
    assert len(said(caplog, name, words)) == 1
    assert one.sensor.roles[0].status()["trouble"] == key


async def over(one: Listening, caplog: pytest.LogCaptureFixture) -> None:
    """The cause has just ended."""
    await one.data(RECOVERY_S)
    await one.until(lambda: good_again(caplog, one.sensor.name), 3.0)


@pytest.fixture(autouse=True)
def _log(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)


# The line -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("sends", "reads", "words"),
    [
        pytest.param(Setting(19200), Setting(9600), "wrong baud or parity?", id="twice as fast"),
        pytest.param(Setting(9600, "even"), Setting(9600), "", id="8E1 read as 8N1"),
        pytest.param(Setting(9600), Setting(9600, "even"), "wrong baud or parity?", id="8N1 read as 8E1"),
    ],
)
async def test_a_line_that_is_set_otherwise(
    path: Path, caplog: pytest.LogCaptureFixture, sends: Setting, reads: Setting, words: str
) -> None:
    async with (
        Chatter(path, tilt_frame, line=reads) as device,
        listening("gradienter", "inclinometer_xy", path, baud=reads.baud, parity=reads.parity) as one,
    ):
        await one.data()
        device.line = sends
        await lasts(one, caplog, "undecodable", f"{reads.baud} baud, parity {reads.parity}: bytes come")
        assert words in one.words
        device.line = reads
        await over(one, caplog)


async def test_a_second_reader_takes_some_of_the_bytes(path: Path, caplog: pytest.LogCaptureFixture) -> None:
    async with Chatter(path, compass_frame, rate_hz=60.0) as device:
        thief = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY)  # before anybody asks to be alone
        async with listening("compass", "hmr3300", path) as one:
            await one.data()

            async def steal() -> None:
                while True:
                    with contextlib.suppress(BlockingIOError):
                        os.read(thief, 7)
                    await asyncio.sleep(0.003)

            stealing = asyncio.create_task(steal())
            await one.until(lambda: "damaged" in one.words and "a second program on the port?" in one.words, 15.0)
            await one.until(lambda: one.counts.get("damaged"), 5.0)
            assert said(caplog, "compass", "a second program on the port?")
            stealing.cancel()
            await asyncio.gather(stealing, return_exceptions=True)
            os.close(thief)
            await one.data(RECOVERY_S)
        assert device.master >= 0


async def test_a_flood_holds_nobody_up(path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """A flood at the speed of the pty: the loop goes on, decoding is bounded, and the sensor recovers."""
    loop = asyncio.get_running_loop()
    async with Chatter(path, tilt_frame) as device, listening("gradienter", "inclinometer_xy", path) as one:
        await one.data()
        device.muted = True
        ended = threading.Event()

        def flood() -> None:
            junk = os.urandom(4096)
            while not ended.is_set():
                with contextlib.suppress(BlockingIOError):
                    os.write(device.master, junk)

        thread = threading.Thread(target=flood, daemon=True)
        decoded, received, since_s = 0, one.sensor.link.bytes_received, loop.time()
        feed = one.sensor.decoder.feed

        def counting(data: bytes, t_s: float) -> list[Any]:
            nonlocal decoded
            decoded += len(data)
            return feed(data, t_s)

        one.sensor.decoder.feed = counting  # type: ignore[method-assign]
        thread.start()
        turns = 0
        try:
            while loop.time() - since_s < 3.0 or ("sends more than" not in one.words and loop.time() - since_s < 60.0):
                await asyncio.sleep(0.001)
                turns += 1
            spent_s = loop.time() - since_s
            assert "sends more than" in one.words
            await one.until(lambda: one.counts.get("flood") == 1)
            assert len(said(caplog, "gradienter", "sends more than")) == 1
            assert turns > 20, f"the others had {turns} turns in {spent_s:.1f} s"
            assert decoded <= BYTES_PER_S * spent_s + BURST_BYTES + 4096 * spent_s / 0.05
            assert one.sensor.link.bytes_received - received > decoded, "all of it was decoded"
        finally:
            ended.set()
            await asyncio.to_thread(thread.join)
        device.muted = False
        await over(one, caplog)


# The device -----------------------------------------------------------------------------------------------------------

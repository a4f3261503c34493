"""What strangers on the link, at the page and at the control socket make the daemon keep levels off, and is little.

A process of its own, abused in rounds of so many messages each. What is bounded (tables of strangers, queues, caches)
is full at some time, which one depends on how fast the machine is; from then on a round adds nothing. A leak adds to
every one.
"""

from __future__ import annotations

import asyncio
import contextlib
import random
import socket
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Final

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests.bench_memory import daemon, last_reply, memory, status_when

MOST_ROUNDS: Final = 12
IN_A_ROW: Final = 3
GROWTH_MIB: Final = 2.0
"""Over so many rounds in a row: what a leak of 120 bytes a message would be."""
MOST_MIB: Final = 85.0
A_ROUND: Final = 6000
AT_ONCE: Final = 20
CONFIG: Final = """
[mavlink]
url = "udpin:127.0.0.1:{port}"
[[imu]]
name = "fc"
source = "autopilot"
[control]
socket = "{folder}/control.sock"
[storage]
directory = "{folder}/store"
recordings_mb = 16
[web]
bind = "127.0.0.1:0"
"""


class Crowd:
    """Many who send whatever MAVLink has, under all ids, well formed or not."""

    def __init__(self, port: int) -> None:
        self._to = ("127.0.0.1", port)
        self._chance = random.Random(1)
        self._sockets = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(AT_ONCE)]
        self._autopilot = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)

    def close(self) -> None:
        for each in self._sockets:
            each.close()

    def heartbeat(self) -> None:
        """Of the autopilot for which all others are strangers."""
        self._send(self._sockets[0], self._autopilot, mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3))

    def anything(self) -> None:
        """One datagram."""
        roll = self._chance.randrange
        words = bytes(roll(65, 91) for _ in range(16))
        kind = roll(9)
        chosen = self._sockets[roll(AT_ONCE)]
        if kind == 0:
            chosen.sendto(self._chance.randbytes(roll(1, 1400)), self._to)
            return
        if kind == 1:
            chosen.sendto(b"\xfd\xff\x00" + self._chance.randbytes(roll(60000)), self._to)
            return
        message: mavlink.MAVLink_message = (
            mavlink.MAVLink_attitude_message(roll(1 << 32), 0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
            mavlink.MAVLink_heartbeat_message(roll(40), roll(20), roll(256), 0, 4, 3),
            mavlink.MAVLink_param_value_message(words, 0.5, 9, 1000, roll(1000)),
            mavlink.MAVLink_statustext_message(3, words * 3, roll(65536), roll(256)),
            mavlink.MAVLink_command_long_message(1, 191, roll(31010, 31014), roll(256), *[0.0] * 7),
            mavlink.MAVLink_param_request_list_message(1, 191),
            mavlink.MAVLink_system_time_message(roll(1 << 64), roll(1 << 32)),
        )[kind - 2]
        codec = self._autopilot
        if roll(3):
            codec = mavlink.MAVLink(None, srcSystem=roll(256), srcComponent=roll(256))
        self._send(chosen, codec, message)

    def _send(self, by: socket.socket, codec: mavlink.MAVLink, message: mavlink.MAVLink_message) -> None:
        by.sendto(message.pack(codec), self._to)
        codec.seq = (codec.seq + 1) % 256


async def _knock(open_: Callable[[], object], words: bytes) -> None:
    """Say something to a socket, hear some of the answer, and go."""
    with contextlib.suppress(OSError, TimeoutError):
        reader, writer = await open_()  # type: ignore[misc]
        with contextlib.suppress(OSError, TimeoutError):
            async with asyncio.timeout(2.0):
                writer.write(words)
                await writer.drain()
                await reader.read(1000)
        writer.close()


async def _round(crowd: Crowd, control: Path, page: int) -> None:
    for number in range(A_ROUND):
        crowd.anything()
        if number % 10 == 9:
            await asyncio.sleep(0.005)
        if number % 200 == 199:
            crowd.heartbeat()
            for words in (b'{"command":"status"}\n', b'{"command":"monitor"}\n', b"[" * 50000 + b"\n", b"x" * 70000):
                await _knock(lambda: asyncio.open_unix_connection(str(control)), words)
            for words in (
                b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n",
                b"GET /events HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n",
                b"POST / HTTP/1.1\r\nContent-Length: 99999999\r\n\r\n" + b"x" * 60000,
            ):
                await _knock(lambda: asyncio.open_connection("127.0.0.1", page), words)


@contextlib.asynccontextmanager
async def _abused(folder: Path) -> AsyncIterator[tuple[Crowd, int, Path, int]]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = int(free.getsockname()[1])
    (folder / "companion.toml").write_text(CONFIG.format(port=port, folder=folder))
    crowd = Crowd(port)
    async with daemon(folder) as (process_id, control):
        status = await status_when(control, lambda now: bool(now["page"]["url"]))
        page = int(status["page"]["url"].rstrip("/").rpartition(":")[2])
        crowd.heartbeat()
        await status_when(control, lambda now: now["vehicle"]["armed"] != "unknown")
        try:
            yield crowd, process_id, control, page
        finally:
            crowd.close()


def _levels_off(resident: list[float]) -> bool:
    return len(resident) > IN_A_ROW and resident[-1] - resident[-1 - IN_A_ROW] < GROWTH_MIB


def test_what_strangers_make_the_daemon_keep_levels_off(tmp_path: Path) -> None:
    async def main() -> list[float]:
        resident: list[float] = []
        async with _abused(tmp_path) as (crowd, process_id, control, page):
            while not _levels_off(resident) and len(resident) < MOST_ROUNDS:
                await _round(crowd, control, page)
                # What has come is worked off when the daemon answers again.
                await last_reply(control, {"command": "status"})
                resident.append(memory(process_id).resident)
        return resident

    resident = asyncio.run(main())
    assert _levels_off(resident), resident
    assert resident[-1] < MOST_MIB, resident

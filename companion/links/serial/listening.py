"""Detection of a port's device: listen at one line setting after another until a decoder accepts it; send nothing.

Opening a port raises DTR, which restarts boards like the Arduino. So listen on request only, never on a port in use.
"""

from __future__ import annotations

import asyncio
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from companion.errors import LinkError
from companion.links.serial.port import DRIVER_REFUSES, SerialOpener, close_serial
from companion.links.serial.ports import ROOT, SerialPort, find_holders, how_to_free, in_use
from companion.links.system.events import comes
from companion.messages import message
from companion.protocols.guess import (
    ENOUGH_BYTES,
    Candidate,
    Heartbeat,
    Line,
    heartbeats,
    is_mavlink,
    likeliest,
    lines_to_try,
    plain_share,
    strangers,
)

SILENT_S: Final = 3.0
"""Wait at the first line setting before a port counts as silent: a sending device shows bytes at any setting."""
LINE_S: Final = 1.0
LINE_MOST_S: Final = 2.5
FEW_BYTES: Final = 100
PARITY_BAUDS: Final = 4
_MOST_BYTES: Final = 131072
_LOOK_S: Final = 0.1


@dataclass(frozen=True, slots=True)
class Heard:
    """Result of listening to a port: a sensor's protocol, an autopilot, another device, or nothing recognised."""

    line: Line | None
    candidate: Candidate | None
    stranger: str | None
    bytes_heard: int
    heartbeat: Heartbeat | None = None


def ports_to_try(found: Sequence[SerialPort]) -> list[str]:
    """Return the best name of each port, without system consoles, which carry a login and no sensor."""
    return [port.stable_name or port.device for port in found if not port.is_console]


async def listen_to_all(
    names: Sequence[str],
    first: Callable[[str], Sequence[Line]] = lambda _: (),
    tell: Callable[[str, Heard | str], None] | None = None,
) -> dict[str, Heard | str]:
    async def one(port: str) -> Heard | str:
        found: Heard | str
        try:
            found = await listen(port, first(port))
        except LinkError as error:
            found = str(error)
        if tell is not None:
            tell(port, found)
        return found

    return dict(zip(names, await asyncio.gather(*map(one, names)), strict=True))


def refuse_if_held(path: str, root: Path = ROOT) -> None:
    """Raise a LinkError that names the other program which uses a port, and how to end it, if there is one."""
    if holders := [holder for holder in find_holders(path, root) if holder.pid != os.getpid()]:
        raise LinkError(f"{in_use(path, holders)}: {how_to_free(holders[0])}")


async def listen(path: str, first: Sequence[Line] = (), root: Path = ROOT) -> Heard:
    """Try line settings, likely ones first, for half a minute at most; raise LinkError if the port cannot be opened."""
    refuse_if_held(path, root)
    heard, plain = 0, dict[int, float]()
    bauds: list[int] = []
    for number, line in enumerate(lines_to_try(first)):
        if line.parity != "none" and line not in first and plain:
            bauds = bauds or sorted(plain, key=lambda baud: plain[baud], reverse=True)[:PARITY_BAUDS]
            if line.baud not in bauds:
                continue
        try:
            data = await _bytes_at(path, line, most_s=LINE_MOST_S if number else SILENT_S)
        except LinkError as error:
            if DRIVER_REFUSES in str(error):
                continue  # the driver does not support this speed
            raise
        heard += len(data)
        if senders := heartbeats(data):
            speaker = senders[0]
            autopilot = speaker if speaker.is_autopilot else None
            return Heard(line, None, message("mavlink_on_the_port", speaker=speaker), heard, autopilot)
        if (found := likeliest(data)) is not None:
            return Heard(line, found, None, heard)
        if (stranger := strangers(data)) is not None:
            return Heard(line, None, stranger, heard)
        if not heard:
            break
        if line.parity == "none":
            plain[line.baud] = plain_share(data)
    return Heard(None, None, None, heard)


async def _bytes_at(path: str, line: Line, most_s: float) -> bytes:
    loop = asyncio.get_running_loop()
    descriptor = await SerialOpener(path, line.baud, line.parity).open()
    data = bytearray()
    ended = asyncio.Event()
    loop.add_reader(descriptor, _reader(descriptor, data, ended))
    try:
        since_s = loop.time()
        looked, mavlink = 0, False
        while not ended.is_set():
            await comes(ended, _LOOK_S)
            past_s = loop.time() - since_s
            if len(data) > looked:
                looked = len(data)
                heard = bytes(data)
                mavlink = mavlink or is_mavlink(heard)
                if any(one.is_autopilot for one in heartbeats(heard)):
                    break
                found = None if mavlink else likeliest(heard)
                if not mavlink and (found.sure if found is not None else looked >= ENOUGH_BYTES):
                    break
            # An autopilot sends its heartbeat only once a second, whatever else it sends.
            if past_s >= most_s or (past_s >= LINE_S and len(data) >= FEW_BYTES and not mavlink):
                break
    finally:
        loop.remove_reader(descriptor)
        close_serial(descriptor)
    return bytes(data)


def _reader(descriptor: int, data: bytearray, ended: asyncio.Event) -> Callable[[], None]:
    def read() -> None:
        try:
            chunk = os.read(descriptor, 4096)
        except (BlockingIOError, InterruptedError):
            return
        except OSError:
            chunk = b""
        if not chunk:
            ended.set()
            asyncio.get_running_loop().remove_reader(descriptor)
        elif len(data) < _MOST_BYTES:
            data.extend(chunk)

    return read

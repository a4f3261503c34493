"""`companion ports --listen` without names: which ports are opened, and which are not."""

from __future__ import annotations

import asyncio
import dataclasses
from collections.abc import Sequence

import pytest

from companion.cli import local
from companion.links.serial import listening
from companion.links.serial.ports import SerialPort
from companion.protocols.guess import Candidate, Line

pytestmark = pytest.mark.real_clock

PORT = SerialPort(
    device="/dev/ttyUSB0",
    stable_name="/dev/serial/by-id/usb-A",
    by_id=("/dev/serial/by-id/usb-A",),
    by_path=(),
    aliases=(),
    description="bridge",
    driver="ftdi_sio",
    vendor_id=1,
    product_id=2,
    serial_number="A",
    latency_timer_ms=None,
    holders=(),
    is_console=False,
)


def test_consoles_are_left_alone_and_ports_go_by_their_lasting_names(monkeypatch: pytest.MonkeyPatch) -> None:
    heard = listening.Heard(Line(9600, "none"), Candidate("x", ("compass",), 4, 0), None, 99)
    opened: list[str] = []

    async def listen(port: str, first: Sequence[Line] = ()) -> listening.Heard:
        opened.append(port)
        return heard

    monkeypatch.setattr(listening, "listen", listen)
    console = dataclasses.replace(PORT, device="/dev/ttyS0", stable_name="/dev/ttyS0", is_console=True)
    nameless = dataclasses.replace(PORT, device="/dev/ttyUSB1", stable_name=None)
    found = asyncio.run(local._listen([], [PORT, console, nameless]))
    assert opened == ["/dev/serial/by-id/usb-A", "/dev/ttyUSB1"]
    assert found == dict.fromkeys(opened, heard)
    asyncio.run(local._listen(["/dev/ttyS0"], [PORT, console]))
    assert opened[-1] == "/dev/ttyS0", "asked for by name"

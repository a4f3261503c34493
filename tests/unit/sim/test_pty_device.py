"""Devices on pseudo-terminals, in real time and briefly."""

from __future__ import annotations

import asyncio
import contextlib
import fcntl
import os
import termios
from pathlib import Path

import pytest

from sim.aircraft import Pose, VirtualAircraft
from sim.devices import HMR3300, Gradienter
from sim.pty_device import PtyDevice

pytestmark = pytest.mark.real_clock


class Port:
    """A reader that does as a serial program does."""

    def __init__(self, path: Path) -> None:
        self.descriptor = os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        self.data = b""

    def read(self) -> bytes:
        try:
            self.data += os.read(self.descriptor, 65536)
        except BlockingIOError:
            pass
        return self.data

    async def wait_for(self, size: int) -> bytes:
        async with asyncio.timeout(30.0):
            while len(self.read()) < size:
                await asyncio.sleep(0.005)
        return self.data

    def close(self) -> None:
        os.close(self.descriptor)


def hung_up(descriptor: int) -> bool:
    """Return True where a port is dead: an error, or an empty read, after the rest of its data."""
    try:
        while os.read(descriptor, 65536):
            pass
    except BlockingIOError:
        return False
    except OSError:
        return True
    return True


TIOCGEXCL = 0x80045440
"""<asm-generic/ioctls.h>; the termios module has only the two that set and clear it."""


async def test_a_reader_that_was_killed_leaves_no_lock(tmp_path: Path) -> None:
    """The kernel keeps it, and root alone may open what is locked."""
    async with PtyDevice(HMR3300(VirtualAircraft(Pose())), path := tmp_path / "compass"):
        killed = Port(path)
        fcntl.ioctl(killed.descriptor, termios.TIOCEXCL)
        await killed.wait_for(1)
        killed.close()
        async with asyncio.timeout(30.0):
            while True:
                with contextlib.suppress(OSError):
                    port = Port(path)
                    if not any(fcntl.ioctl(port.descriptor, TIOCGEXCL, bytes(4))):
                        break
                    port.close()
                await asyncio.sleep(0.01)
        await port.wait_for(1)
        port.close()


async def test_the_path_is_raw_and_says_its_banner_to_the_first_reader(tmp_path: Path) -> None:
    async with PtyDevice(HMR3300(VirtualAircraft(Pose(0.0, 0.0, 123.4)), heading_noise_deg=0.0), tmp_path / "c") as pty:
        opened = [pty.opened]
        port = Port(tmp_path / "c")
        opened.append(pty.opened)
        local = termios.tcgetattr(port.descriptor)[3]
        assert not local & (termios.ICANON | termios.ECHO)
        data = await port.wait_for(30)
        port.close()
    assert opened == [False, True]
    assert data.split(b"\r\n")[0].startswith(b"HMR3300")
    assert data.split(b"\r\n")[1] == b"123.4, 0.0, 0.0"
    assert not (tmp_path / "c").is_symlink()


async def test_unplugging_hangs_up_and_replugging_brings_the_path_back(tmp_path: Path) -> None:
    path = tmp_path / "gradienter"
    async with PtyDevice(Gradienter(VirtualAircraft(), noise_deg=0.0), path) as pty:
        port = Port(path)
        await port.wait_for(44)
        pty.unplug()
        assert not path.exists()
        assert hung_up(port.descriptor)
        port.close()
        await asyncio.sleep(0.05)
        pty.replug()
        port = Port(path)
        assert (await port.wait_for(22))[:22] == b"X=+00.000\r\nY=+00.000\r\n"
        port.close()


async def test_commands_reach_the_device_and_a_muted_one_is_silent(tmp_path: Path) -> None:
    async with PtyDevice(Gradienter(VirtualAircraft(), noise_deg=0.0), tmp_path / "g") as pty:
        port = Port(tmp_path / "g")
        await port.wait_for(22)
        os.write(port.descriptor, b"sV")
        async with asyncio.timeout(30.0):
            while b"DPL2" not in port.read():
                await asyncio.sleep(0.01)
        os.write(port.descriptor, b"S")
        await port.wait_for(len(port.data) + 22)
        pty.muted = True
        await asyncio.sleep(0.05)
        before = len(port.read())
        await asyncio.sleep(0.25)
        assert len(port.read()) == before
        port.close()

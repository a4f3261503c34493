"""`companion check` and `companion ports --listen` on lines that behave like UARTs: what is wrong, and what to type."""

from __future__ import annotations

import contextlib
import os
from collections.abc import AsyncIterator
from pathlib import Path

import pytest

from companion.config import parse
from companion.daemon.process.check import CheckLine, run_check
from sim.pty_device import Setting
from tests.e2e.test_commands import companion
from tests.support.chatter import Chatter, compass_frame, tilt_frame

pytestmark = pytest.mark.real_clock

CONFIG = """
[mavlink]
url = "udpout:127.0.0.1:9"
[[imu]]
name = "fc"
source = "autopilot"
[gradienter]
port = "{folder}/gradienter"
protocol = "inclinometer_xy"
law = "slope"
{gradienter}
[compass]
port = "{folder}/compass"
protocol = "hmr3300"
{compass}
[control]
socket = "{folder}/control.sock"
[storage]
directory = "{folder}/state"
recordings_mb = 0
"""


def text(folder: Path, gradienter: str = "", compass: str = "") -> str:
    return CONFIG.format(folder=folder, gradienter=gradienter, compass=compass)


@contextlib.asynccontextmanager
async def bench(
    folder: Path, gradienter: Setting, compass: Setting, *, swapped: bool = False
) -> AsyncIterator[tuple[Chatter, Chatter]]:
    names = ("compass", "gradienter") if swapped else ("gradienter", "compass")
    async with (
        Chatter(folder / names[0], tilt_frame, line=gradienter) as one,
        Chatter(folder / names[1], compass_frame, line=compass) as other,
    ):
        yield one, other


async def found(config: str, seconds: float = 3.0) -> list[CheckLine]:
    return await run_check(parse(config, "test.toml"), seconds)


def of(findings: list[CheckLine], *names: str) -> list[CheckLine]:
    return [finding for finding in findings if finding.name in names and finding.remedy]


async def test_a_bench_in_order_has_nothing_to_say(tmp_path: Path) -> None:
    async with bench(tmp_path, Setting(9600), Setting(19200)):
        findings = await found(text(tmp_path))
        assert of(findings, "gradienter", "compass", "ports") == []
        assert [one.good for one in findings if one.name in ("gradienter", "compass")] == [True, True]


async def test_another_speed_and_parity(tmp_path: Path) -> None:
    async with bench(tmp_path, Setting(9600, "even"), Setting(19200)):
        (finding,) = of(await found(text(tmp_path, "baud = 115200")), "gradienter", "ports")
        assert not finding.good
        assert finding.remedy == 'set baud = 9600 and parity = "even" in [gradienter]'
        assert finding.words.startswith("this is inclinometer_xy at 9600 8E1, not at ")


async def test_two_devices_swapped_each_at_its_own_speed(tmp_path: Path) -> None:
    async with bench(tmp_path, Setting(9600), Setting(19200), swapped=True):
        told = {each.name: each.words for each in of(await found(text(tmp_path)), "gradienter", "compass")}
        assert told["gradienter"].startswith(
            "this is hmr3300, a device for compass, not for gradienter: give [gradienter] the port of the gradienter"
        )
        assert told["compass"].startswith(
            "this is inclinometer_xy, a device for gradienter, not for compass: give [compass] the port of the compass"
        )


def sent_to(device: Chatter) -> bytes:
    """What a device was told, whether or not somebody still has its port open."""
    with contextlib.suppress(OSError):
        return os.read(device.master, 100)
    return b""


# companion ports ------------------------------------------------------------------------------------------------------


async def test_ports_listen_says_who_speaks_and_at_which_speed(tmp_path: Path) -> None:
    async with bench(tmp_path, Setting(9600, "even"), Setting(19200)) as (one, other):
        said = await companion("ports", "--listen", str(tmp_path / "gradienter"), str(tmp_path / "compass"))
        assert said.code == 0
        for name, device in (
            ("gradienter", "inclinometer_xy, a device for gradienter (9600 8E1)"),
            ("compass", "hmr3300, a device for compass (19200 8N1)"),
        ):
            assert f"{tmp_path / name}: {device}\n" in said.out
        assert "companion setup takes them" in said.err
        assert [sent_to(one), sent_to(other)] == [b"", b""]

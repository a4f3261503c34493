"""`companion check` and `companion ports --listen` on lines that behave like UARTs: what is wrong, and what to type."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import sys
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest

from companion.config import parse
from companion.daemon.process.check import Finding, run_check
from sim.uart import Setting
from tests.e2e.test_commands import companion
from tests.support.chatter import Chatter, compass_frame, tilt_frame

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


async def found(config: str, seconds: float = 3.0) -> list[Finding]:
    return await run_check(parse(config, "test.toml"), seconds)


def of(findings: list[Finding], *names: str) -> list[Finding]:
    return [finding for finding in findings if finding.name in names and finding.remedy]


def test_a_bench_in_order_has_nothing_to_say(tmp_path: Path) -> None:
    async def main() -> None:
        async with bench(tmp_path, Setting(9600), Setting(19200)):
            findings = await found(text(tmp_path))
            assert of(findings, "gradienter", "compass", "ports") == []
            assert [one.good for one in findings if one.name in ("gradienter", "compass")] == [True, True]

    asyncio.run(main())


@pytest.mark.parametrize(
    ("sends", "keys", "remedy"),
    [
        pytest.param(Setting(9600, "even"), "", 'set parity = "even" in [gradienter]', id="BEI INC"),
        pytest.param(
            Setting(9600, "even"),
            "baud = 115200",
            'set baud = 9600 and parity = "even" in [gradienter]',
            id="both",
        ),
    ],
)
def test_another_speed_or_parity(tmp_path: Path, sends: Setting, keys: str, remedy: str) -> None:
    async def main() -> None:
        async with bench(tmp_path, sends, Setting(19200)):
            (finding,) = of(await found(text(tmp_path, keys)), "gradienter", "ports")
            assert not finding.good
            assert finding.remedy == remedy
            assert finding.words.startswith(f"it sends at {sends.baud} 8{sends.parity[0].upper()}1, not ")

    asyncio.run(main())


def test_two_devices_swapped_each_at_its_own_speed(tmp_path: Path) -> None:
    async def main() -> None:
        async with bench(tmp_path, Setting(9600), Setting(19200), swapped=True):
            told = {each.name: each.words for each in of(await found(text(tmp_path)), "gradienter", "compass")}
            assert told["gradienter"].startswith(
                "this is hmr3300, a device for compass: give [gradienter] the port of the gradienter"
            )
            assert told["compass"].startswith(
                "this is inclinometer_xy, a device for gradienter: give [compass] the port of the compass"
            )

    asyncio.run(main())


def test_silence_is_said_once_and_nothing_is_tried(tmp_path: Path) -> None:
    async def main() -> None:
        async with bench(tmp_path, Setting(9600), Setting(19200)) as (gradienter, _):
            gradienter.muted = True
            findings = [one for one in await found(text(tmp_path), 1.0) if one.name == "gradienter"]
            (finding,) = findings
            assert "silent" in finding.words
            assert not finding.good

    asyncio.run(main())


def test_with_a_daemon_running_it_is_asked_and_its_ports_are_left_alone(tmp_path: Path) -> None:
    path = tmp_path / "test.toml"
    path.write_text(text(tmp_path, "baud = 115200"))

    async def main() -> None:
        async with bench(tmp_path, Setting(9600), Setting(115200)) as (gradienter, compass):
            process = await asyncio.create_subprocess_exec(
                *(sys.executable, "-m", "companion", "-c", str(path), "run"), stderr=asyncio.subprocess.DEVNULL
            )
            try:
                # Its compass at 19200 hears a compass at 115200; its gradienter at 115200 one at 9600.
                async with asyncio.timeout(150.0):
                    while True:
                        said = await companion("-c", str(path), "status", "--json")
                        if said.code == 0 and all(
                            device["trouble"] == "undecodable" for device in said.json["devices"][1:]
                        ):
                            break
                check = await companion("-c", str(path), "check", "--json")
                assert check.code == 1
                findings = {one["name"]: one for one in check.json["findings"] if one["remedy"]}
                assert "sudo systemctl stop companion" in findings["gradienter"]["remedy"]
                assert set(check.json["findings"][0]) == {"name", "good", "words", "remedy", "port"}
                # The same device at the speed that the daemon reads: it says itself who that is.
                compass.line = Setting(19200)
                compass.frame = tilt_frame
                async with asyncio.timeout(150.0):
                    while True:
                        check = await companion("-c", str(path), "check", "--json")
                        said_of = [one["words"] for one in check.json["findings"] if one["name"] == "compass"]
                        if any("this is inclinometer_xy, a device for gradienter" in words for words in said_of):
                            break
            finally:
                process.terminate()
                await process.wait()
            assert gradienter.master >= 0

    asyncio.run(main())


def sent_to(device: Chatter) -> bytes:
    """What a device was told, whether or not somebody still has its port open."""
    with contextlib.suppress(OSError):
        return os.read(device.master, 100)
    return b""


# companion ports ------------------------------------------------------------------------------------------------------


def test_ports_listen_says_who_speaks_and_at_which_speed(tmp_path: Path) -> None:
    async def main() -> None:
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

    asyncio.run(main())


def test_ports_listen_leaves_alone_what_somebody_holds_and_does_not_list_by_opening(tmp_path: Path) -> None:

    async def main() -> None:
        async with Chatter(tmp_path / "a", tilt_frame) as device:
            held = os.open(device.path, os.O_RDONLY | os.O_NOCTTY | os.O_NONBLOCK)
            said = await companion("ports", "--listen", str(device.path), "--json")
            os.close(held)
            heard: dict[str, Any] = said.json["heard"][str(device.path)]
            assert not heard["good"]
            assert f"process {os.getpid()}" in heard["reason"]
            listed = await companion("ports", "--json")
            assert "heard" not in json.loads(listed.out)

    asyncio.run(main())

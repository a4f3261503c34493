"""The service under a real systemd, with all its restrictions: installed, used, broken, mended, removed.

One test, in the order of a service's life: booting takes longer than all that is asked of it.
"""

from __future__ import annotations

import asyncio
import contextlib
import grp
import json
import os
import re
import tomllib
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path

import pytest

from companion.installation import install as installing
from tests.support.booted_systemd import Machine, booted, why_not
from tests.support.first_run import take_all
from tests.support.live_aircraft import QUICK, live_aircraft

COMPANION = "/opt/companion/bin/companion"
CONFIGURATION = "/etc/companion/companion.toml"
SOCKET = "/run/companion/control.sock"
INSTALL = (COMPANION, "service", "install", "--executable", COMPANION)
NOBODY = 65534
WATCHDOG_S = 3

WHY_NOT = why_not()
pytestmark = [pytest.mark.skipif(WHY_NOT is not None, reason=str(WHY_NOT)), pytest.mark.real_clock]


@contextlib.asynccontextmanager
async def aircraft(folder: Path) -> AsyncIterator[str]:
    """One whose ports a service may open; gives the configuration."""
    async with live_aircraft(folder, ""):
        yield opened(folder) + QUICK


def opened(folder: Path) -> str:
    """The configuration for a service, whose group may open the ports."""
    lines = (folder / "companion.toml").read_text().splitlines()
    text = "\n".join(line for line in lines if not line.startswith(("socket = ", "directory = ")))
    for name in ("imu", "gradienter", "compass"):
        port = os.path.realpath(folder / name)
        os.chmod(port, 0o660)
        os.chown(port, -1, grp.getgrnam("dialout").gr_gid)
        text = text.replace(f'"{folder / name}"', f'"{port}"')
    return text


async def until(condition: Callable[[], Awaitable[bool]], within_s: float = 90.0) -> None:
    """Wait for something that systemd does in its own time."""
    async with asyncio.timeout(within_s):
        while not await condition():
            await asyncio.sleep(0.1)


async def ask(machine: Machine, *words: str) -> dict[str, object]:
    _, out, _ = await machine.run(COMPANION, *words, "--json")
    answer: dict[str, object] = json.loads(out)
    return answer


async def main_process(machine: Machine) -> str:
    return (await machine.show("companion", "MainPID"))["MainPID"]


async def test_the_life_of_the_service(tmp_path: Path) -> None:
    async with booted(tmp_path) as machine, aircraft(tmp_path) as configuration:
        await set_up(machine, configuration)
        await installed(machine, configuration)
        await restricted(machine)
        await serial_ports_alone(machine)
        await spoken_to_by_the_group_alone(machine)
        await calibrated(machine)
        await killed(machine)
        await hung(machine)
        await removed(machine)


async def set_up(machine: Machine, configuration: str) -> None:
    # Without a configuration the page asks for one; here it listens to the simulated ports only.
    wanted = tomllib.loads(configuration)
    ports = [wanted[name]["port"] for name in ("gradienter", "compass")]
    words = [COMPANION, "setup", *ports, "--mavlink", wanted["mavlink"]["url"], "--law", "slope", "--no-check"]
    words += ["--page", "0.0.0.0:0"]
    drop_in = f"[Service]\nExecStart=\nExecStart={' '.join(words)}\n"
    await machine.write("/etc/systemd/system/companion-setup.service.d/ports.conf", drop_in)
    _, out, _ = await machine.run(*INSTALL)
    assert f"absent     {CONFIGURATION}: sudo companion setup makes it" in out
    shown = await machine.show("companion", "ActiveState", "UnitFileState")
    assert shown == {"ActiveState": "inactive", "UnitFileState": "enabled"}
    said = ""

    async def is_asked() -> bool:
        nonlocal said
        _, said, _ = await machine.run("journalctl", "--identifier=companion", "--output=cat", "--no-pager")
        return "on a deck" in said

    await until(is_asked)
    ((port, token),) = re.findall(r"open once on the phone: http://\S+:(\d+)/#token=(\S+)", said)
    # Platform, two mountings, part, to write it, to start it, to end.
    assert await take_all(int(port), token) == 7
    shown = await machine.show("companion", "ActiveState", "UnitFileState")
    assert shown == {"ActiveState": "active", "UnitFileState": "enabled"}
    _, out, _ = await machine.run("cat", CONFIGURATION, "/var/lib/private/companion/web-token")
    assert tomllib.loads(out.removesuffix(f"{token}\n"))["gradienter"]["port"] == ports[0]
    assert out.endswith(f"{token}\n"), "the page of the daemon takes the same token"

    async def has_ended() -> bool:
        return (await machine.show("companion-setup", "ActiveState"))["ActiveState"] == "inactive"

    await until(has_ended)
    code, out, _ = await machine.run(COMPANION, "setup", *ports, "--yes", "--no-service", check=False)
    assert code == 0
    assert "says all this already" in out
    assert "Not checked: a companion runs" in out


async def installed(machine: Machine, configuration: str) -> None:
    await machine.write(CONFIGURATION, configuration)
    _, out, _ = await machine.run(*INSTALL)
    assert f"kept       {CONFIGURATION}" in out
    assert "done       systemctl restart companion.service" in out
    # `restart` came back, so it has said that it is ready.
    shown = await machine.show("companion", "ActiveState", "UnitFileState", "Type", "WatchdogUSec")
    assert shown == {"ActiveState": "active", "UnitFileState": "enabled", "Type": "notify", "WatchdogUSec": "10s"}

    await until(lambda: good(machine))


async def good(machine: Machine) -> bool:
    status = (await machine.show("companion", "StatusText"))["StatusText"]
    return "ArduPilot" in status and "fc, own, gradienter, compass good" in status


async def restricted(machine: Machine) -> None:
    process = await main_process(machine)
    _, out, _ = await machine.run("cat", f"/proc/{process}/status")
    fields = {key: value.strip() for key, _, value in (line.partition(":") for line in out.splitlines())}
    assert fields["Uid"].split()[0] not in ("0", str(NOBODY))
    assert (fields["NoNewPrivs"], fields["Seccomp"]) == ("1", "2")
    assert {fields[name].strip("0") for name in ("CapPrm", "CapEff", "CapBnd", "CapAmb")} == {""}
    _, out, _ = await machine.run("ps", "-o", "ni=", "-p", process)
    assert out.strip() == "-10"


async def serial_ports_alone(machine: Machine) -> None:
    """Under the unit's device rules even root opens serial ports, pseudo-terminals and nothing else."""
    lines = [
        line
        for line in installing.content(installing.SERVICE).decode().splitlines()
        if line.startswith(("DevicePolicy", "DeviceAllow"))
    ]
    code = (
        "import os\n"
        "for name in ('ttyS0', 'ptmx', 'kmsg', 'loop0'):\n"
        "    try: os.close(os.open('/dev/' + name, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)); found = 'open'\n"
        "    except OSError as error: found = error.strerror\n"
        "    print(name, found)\n"
    )
    await machine.write("/opt/companion/open.py", code)
    unit = ["[Service]", "Type=oneshot", "StandardOutput=file:/run/opened", *lines]
    unit.append("ExecStart=/opt/companion/python/bin/python3 /opt/companion/open.py")
    await machine.write("/etc/systemd/system/opening.service", "\n".join(unit) + "\n")
    await machine.run("systemctl", "daemon-reload")
    await machine.run("systemctl", "start", "opening.service")
    _, out, _ = await machine.run("cat", "/run/opened")
    opened = dict(line.split(" ", 1) for line in out.splitlines())
    refused = "Operation not permitted"
    assert opened["ptmx"] == "open"
    assert opened["ttyS0"] != refused  # without hardware behind it, an input/output error
    assert (opened["kmsg"], opened["loop0"]) == (refused, refused)


async def spoken_to_by_the_group_alone(machine: Machine) -> None:
    _, out, _ = await machine.run("stat", "-c", "%a %G", SOCKET)
    assert out.strip() == "660 dialout"
    as_nobody = ("setpriv", f"--reuid={NOBODY}", f"--regid={NOBODY}")
    code, out, _ = await machine.run(*as_nobody, "--groups=dialout", COMPANION, "status", "--json")
    assert code == 0
    assert json.loads(out)["vehicle"]["armed"] == "disarmed"
    code, _, error = await machine.run(*as_nobody, "--clear-groups", COMPANION, "status", check=False)
    assert code == 3
    assert "only group dialout and root may" in error
    code, _, error = await machine.run(*as_nobody, "--clear-groups", COMPANION, "check", check=False)
    assert (code, error.count("\n")) == (3, 2)
    assert "only group dialout and root may" in error


async def calibrated(machine: Machine) -> None:
    record = await ask(machine, "calibrate", "--accelerometers", "--timeout", "60")
    assert record["state"] == "done", record
    _, out, _ = await machine.run("stat", "-c", "%U", "/var/lib/private/companion")
    assert out.strip() not in ("root", "")
    await machine.run("systemctl", "restart", "companion")
    await until(lambda: good(machine))
    history = await ask(machine, "history")
    # With the configuration of setup it may have calibrated by itself before.
    kept = {one["started_at"]: one["state"] for one in history["records"]}  # type: ignore[attr-defined]
    assert kept[record["started_at"]] == "done"


async def killed(machine: Machine) -> None:
    before = await main_process(machine)
    await machine.run("kill", "-KILL", before)

    async def back() -> bool:
        shown = await machine.show("companion", "ActiveState", "MainPID", "NRestarts")
        return shown["ActiveState"] == "active" and shown["MainPID"] != before and shown["NRestarts"] == "1"

    await until(back)


async def hung(machine: Machine) -> None:
    """A process that stands still is ended and begun anew."""
    drop_in = f"[Service]\nWatchdogSec={WATCHDOG_S}\nTimeoutAbortSec=1\n"
    await machine.write("/etc/systemd/system/companion.service.d/quick.conf", drop_in)
    await machine.run("systemctl", "daemon-reload")
    await machine.run("systemctl", "restart", "companion")
    before = await main_process(machine)
    await asyncio.sleep(2 * WATCHDOG_S)
    assert await main_process(machine) == before  # it is fed
    await machine.run("kill", "-STOP", before)

    async def back() -> bool:
        shown = await machine.show("companion", "ActiveState", "MainPID")
        return shown["ActiveState"] == "active" and shown["MainPID"] not in (before, "0")

    await until(back)
    _, out, _ = await machine.run("journalctl", "--no-pager", "--output=cat", "--unit=companion")
    assert "Watchdog timeout" in out


async def removed(machine: Machine) -> None:
    _, out, _ = await machine.run(COMPANION, "service", "remove")
    assert f"kept       {CONFIGURATION}: yours" in out
    assert "kept       /var/lib/private/companion" in out
    shown = await machine.show("companion", "ActiveState", "LoadState")
    assert shown["ActiveState"] == "inactive"
    code, _, _ = await machine.run("test", "-e", SOCKET, check=False)
    assert code != 0

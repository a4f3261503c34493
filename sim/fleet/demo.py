"""`python -m sim fleet`: thirty simulated aircraft, Mosquitto and `companion fleet run`, on this computer alone."""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import datetime
import random
import shutil
import socket
import sys
import tempfile
from collections.abc import AsyncIterator, Sequence
from pathlib import Path
from typing import Final

from companion.fleet.collector import stop
from companion.fleet.store import Store
from companion.physics.units import DEG_H
from sim.fleet.aircraft import Aircraft

AIRCRAFT: Final = 30
FLIGHTS: Final = 24
FAULT_DEG_H: Final = 80.0
"""Bias step of one gyro, in two of the aircraft."""
SEED: Final = 19
PAUSE_S: Final = 4.0
"""Time between two flights of the fleet."""
PAGE: Final = "127.0.0.1:8291"
_PATH: Final = "/usr/sbin:/usr/local/sbin:/usr/bin:/usr/local/bin:/opt/homebrew/sbin"
_ENDS_WITH_US: Final = 'exec 3<&0; (read -r _ <&3; kill $$) & exec "$@" 3<&-'
"""Shell script that runs a command and ends it when its standard input is closed, even if our process is killed."""


def main(argv: Sequence[str]) -> int:
    parser = argparse.ArgumentParser(prog="python -m sim fleet", description=__doc__)
    parser.add_argument("--page", default=PAGE, metavar="HOST:PORT", help=f"address of the page (default {PAGE})")
    options = parser.parse_args(argv)
    mosquitto = shutil.which("mosquitto") or shutil.which("mosquitto", path=_PATH)
    if mosquitto is None:
        print("fleet: Mosquitto is not installed: sudo apt install mosquitto", file=sys.stderr)
        return 1
    with tempfile.TemporaryDirectory(prefix="companion-fleet-") as folder:
        print(f"{AIRCRAFT} simulated aircraft, Mosquitto, and an SQLite file in {folder}, until Ctrl-C", flush=True)
        print(f"look at http://{options.page}/", flush=True)
        try:
            asyncio.run(_play(Path(folder), mosquitto, options.page))
        except KeyboardInterrupt:
            return 0
        except RuntimeError as error:
            print(f"fleet: {error}", file=sys.stderr)
    return 1


def fleet_of(number: int, now: datetime.datetime) -> list[Aircraft]:
    """Make aircraft with a history: some silent, some never calibrated, some with a step or a quarantine of a bias."""
    found = [Aircraft(k, SEED) for k in range(number)]
    for k, each in enumerate(found):
        last = now - datetime.timedelta(days=40 * (k % 15 == 11))
        if k % 15 == 7:
            each.calibrate(now - datetime.timedelta(days=2), "not still: gyro x 0.31 deg/s")
            each.arm(now - datetime.timedelta(days=2, minutes=-5))
            continue
        if k % 15 == 5:
            each.live(now - datetime.timedelta(days=40), FLIGHTS, 50.0)
            each.moved_rad_s = FAULT_DEG_H * DEG_H
            each.live(now, FLIGHTS // 2, 38.0)
        else:
            each.live(last, FLIGHTS)
        for days_ago in (8, 3, 1):
            each.fly(last - datetime.timedelta(days=days_ago))
        each.learn(last)
        if k % 15 == 3:
            each.calibrate(now - datetime.timedelta(hours=3), held_back=True)
    return found


async def _play(folder: Path, mosquitto: str, page: str) -> None:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        port = one.getsockname()[1]
    broker, collector = folder / "mosquitto.conf", folder / "collector.toml"
    broker.write_text(f"listener {port} 127.0.0.1\nallow_anonymous true\n")
    collector.write_text(f'[mqtt]\nhost = "127.0.0.1"\nport = {port}\n')
    database = str(folder / "fleet.sqlite")
    collect = [sys.executable, "-m", "companion", "fleet", "run", "-c", str(collector), "--database", database]
    await asyncio.to_thread(Store(database).prepare)  # the page shows an empty fleet from the first moment on
    fleet = fleet_of(AIRCRAFT, datetime.datetime.now(tz=datetime.UTC))
    async with (
        _child(folder / "mosquitto.log", mosquitto, "-c", str(broker)) as first,
        _child(folder / "collector.log", *collect, "--page", page) as second,
    ):
        runs = [_fly(fleet), *(each.run("127.0.0.1", port) for each in fleet)]
        runs += [_watch(first, folder / "mosquitto.log"), _watch(second, folder / "collector.log")]
        tasks = [asyncio.ensure_future(run) for run in runs]
        try:
            await asyncio.gather(*tasks)
        finally:
            await stop(tasks)


async def _fly(fleet: list[Aircraft]) -> None:
    dice = random.Random(SEED)
    while True:
        await asyncio.sleep(PAUSE_S)
        now = datetime.datetime.now(tz=datetime.UTC)
        one = dice.choice(fleet[:10])
        one.calibrate(now)
        one.arm(now + datetime.timedelta(minutes=1))


@contextlib.asynccontextmanager
async def _child(log: Path, *command: str) -> AsyncIterator[asyncio.subprocess.Process]:
    """Run a command until this block ends, or until this process is killed."""
    with log.open("wb") as output:
        process = await asyncio.create_subprocess_exec(
            *("sh", "-c", _ENDS_WITH_US, "sh", *command),
            stdin=asyncio.subprocess.PIPE,
            stdout=output,
            stderr=output,
            start_new_session=True,  # Ctrl-C is for us alone
        )
    try:
        yield process
    finally:
        if process.stdin is not None:
            process.stdin.close()
        await process.wait()


async def _watch(process: asyncio.subprocess.Process, log: Path) -> None:
    """Raise an error when a child process has ended."""
    await process.wait()
    said = await asyncio.to_thread(log.read_text, errors="replace")
    raise RuntimeError(f"{log.stem} has ended: {said[-500:].strip()}")

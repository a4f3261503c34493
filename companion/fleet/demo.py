"""`companion fleet demo`: thirty simulated aircraft, a broker, a collector and the page, on this computer alone."""

from __future__ import annotations

import asyncio
import contextlib
import datetime
import random
import shutil
import socket
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any, Final

from companion.config.sections import Mqtt
from companion.errors import LinkError
from companion.fleet.collector import Collector, stop
from companion.fleet.simulated import Aircraft
from companion.fleet.store import Store
from companion.physics.units import DEG_H

AIRCRAFT: Final = 30
FLIGHTS: Final = 24
FAULT_DEG_H: Final = 80.0
"""By how much one gyro has moved in two of them."""
SEED: Final = 19
PAUSE_S: Final = 4.0
"""Between two flights of the fleet."""
_MOSQUITTO_PATH: Final = "/usr/sbin:/usr/local/sbin:/usr/bin:/usr/local/bin:/opt/homebrew/sbin"


def fleet_of(number: int, now: datetime.datetime) -> list[Aircraft]:
    """Aircraft with a history: a few have not flown for long, one has never been calibrated, one's last was refused."""
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


async def play(database: Path, mosquitto: str | None) -> None:
    """Until cancelled; `mosquitto` is its program, None: a broker inside of this process, which speaks MQTT 3.1.1 only.

    Raises:
        LinkError: no broker could be started.
    """
    fleet = fleet_of(AIRCRAFT, datetime.datetime.now(tz=datetime.UTC))
    async with _mosquitto(mosquitto, database.parent) if mosquitto else _amqtt() as port:
        collector = Collector(Mqtt(host="127.0.0.1", port=port), Store(str(database)), mqtt_5=mosquitto is not None)
        runs = [collector.run(), _fly(fleet), *(each.run("127.0.0.1", port) for each in fleet)]
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


def find_mosquitto() -> str | None:
    """Its program, where it is installed."""
    return shutil.which("mosquitto") or shutil.which("mosquitto", path=_MOSQUITTO_PATH)


def _free_port() -> int:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return int(one.getsockname()[1])


@contextlib.asynccontextmanager
async def _mosquitto(program: str, folder: Path) -> AsyncIterator[int]:
    port, config = _free_port(), folder / "mosquitto.conf"
    await asyncio.to_thread(config.write_text, f"listener {port} 127.0.0.1\nallow_anonymous true\n")
    # Whatever ends us closes its input, and that ends it.
    process = await asyncio.create_subprocess_exec(
        "sh",
        "-c",
        'exec 3<&0; (read -r _ <&3; kill $$) & exec "$0" -c "$1" >/dev/null 2>&1 3<&-',
        program,
        str(config),
        stdin=asyncio.subprocess.PIPE,
    )
    try:
        await _until_open(port, process)
        yield port
    finally:
        if process.stdin is not None:
            process.stdin.close()
        await process.wait()


async def _until_open(port: int, process: asyncio.subprocess.Process) -> None:
    while process.returncode is None:
        try:
            _, writer = await asyncio.open_connection("127.0.0.1", port)
        except OSError:
            await asyncio.sleep(0.05)
        else:
            writer.close()
            return
    raise LinkError("the demonstration's Mosquitto has ended at once")


@contextlib.asynccontextmanager
async def _amqtt() -> AsyncIterator[int]:
    from amqtt.broker import Broker

    port = _free_port()
    plugins = {"amqtt.plugins.authentication.AnonymousAuthPlugin": {"allow_anonymous": True}}
    config: dict[str, Any] = {
        "listeners": {"default": {"type": "tcp", "bind": f"127.0.0.1:{port}"}},
        "plugins": plugins,
    }
    broker = Broker(config)
    await broker.start()
    try:
        yield port
    finally:
        await broker.shutdown()

"""The daemon's parts beside a real broker and without an autopilot, and what to wait for there."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable
from pathlib import Path

import pytest

from companion.config import parse
from companion.daemon.process.service import Service
from tests.support.broker import BEST, Heard
from tests.support.children import in_process

ALONE = """
[mavlink]
url = "udpout:127.0.0.1:9"
[[imu]]
name = "fc"
source = "autopilot"
[vehicle]
system_id = 7
[storage]
directory = "{folder}"
[control]
socket = "{folder}/control.sock"
{more}
"""
BASE = "companion/7"

mosquitto_only = pytest.mark.skipif(
    BEST != "mosquitto", reason="needs mosquitto: amqtt speaks MQTT 3.1.1 only, and lets two clients of one name be"
)


@contextlib.asynccontextmanager
async def alone(folder: Path, section: str) -> AsyncIterator[Service]:
    """The daemon's parts without an autopilot; it is stopped in order at the end."""
    config = parse(ALONE.format(folder=folder, more=section), "test.toml")
    service = Service(config, child=in_process(lambda: service))
    task = asyncio.create_task(service.serve(mavlink=False, ports=False))
    try:
        yield service
        assert not task.done()
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task


async def until_connected(service: Service, *, connected: bool = True, within_s: float = 90.0) -> None:
    async with asyncio.timeout(within_s):
        while service.status()["mqtt"]["connected"] != connected:
            await asyncio.sleep(0.02)


async def until_problem(service: Service, words: str, within_s: float = 90.0) -> str:
    async with asyncio.timeout(within_s):
        while words not in (service.status()["mqtt"].get("last_error") or ""):
            await asyncio.sleep(0.02)
    return str(service.status()["mqtt"]["summary"])


def is_(payload: bytes) -> Callable[[Heard], bool]:
    return lambda heard: heard.payload == payload


def says(state: str) -> Callable[[Heard], bool]:
    return lambda heard: heard.json["state"] == state


async def until_bad(service: Service, words: str) -> None:
    async with asyncio.timeout(90.0):
        while words not in service.status()["mqtt"]["summary"]:
            await asyncio.sleep(0.05)
    assert service.status()["mqtt"]["connected"]
    assert not service.status()["mqtt"]["good"]

"""Collectors as processes, to be killed; what came into the database, to be compared with what was told."""

from __future__ import annotations

import asyncio
import base64
import contextlib
import datetime
import signal
import subprocess
import sys
from collections.abc import AsyncIterator, Sequence
from pathlib import Path
from typing import Any

import sqlalchemy as sa

from companion.fleet import schema
from companion.fleet.collector import stop
from companion.fleet.schema import engine_of
from companion.fleet.server import Server
from companion.fleet.store import Store
from companion.mqtt.client import Incoming
from sim.fleet.aircraft import Aircraft
from tests.support.broker import Broker, free_port

NOW = datetime.datetime(2026, 11, 20, 12, tzinfo=datetime.UTC)


class CollectorProcess:
    def __init__(
        self, folder: Path, name: str, one: Broker, database: str, *more: str, username: str | None = None
    ) -> None:
        self.log = folder / f"{name}.log"
        config = folder / f"{name}.toml"
        config.write_text(one.section(keepalive_s=5, **({} if username is None else {"username": username})))
        command = [sys.executable, "-m", "companion", "-c", str(config), "fleet", "run", "--database", database, *more]
        with self.log.open("ab") as log:
            self._process = subprocess.Popen(command, stdout=log, stderr=log)

    async def at_work(self) -> None:
        """Wait until it hears the aircraft."""
        async with asyncio.timeout(60.0):
            while " into " not in self.log.read_text():
                assert self._process.poll() is None, self.log.read_text()
                await asyncio.sleep(0.05)

    @property
    def process_id(self) -> int:
        return self._process.pid

    def kill(self) -> None:
        self._process.kill()
        self._process.wait()

    def stop(self) -> int:
        self._process.send_signal(signal.SIGTERM)
        return self._process.wait(60.0)


@contextlib.asynccontextmanager
async def telling(fleet: Sequence[Aircraft], one: Broker) -> AsyncIterator[None]:
    tasks = [asyncio.create_task(each.run("127.0.0.1", one.port)) for each in fleet]
    try:
        yield
    finally:
        await stop(tasks)


async def until_confirmed(fleet: Sequence[Aircraft], within_s: float = 120.0) -> None:
    try:
        async with asyncio.timeout(within_s):
            while any(len(each.confirmed) < len(each.told) for each in fleet):
                await asyncio.sleep(0.05)
    except TimeoutError:
        raise AssertionError([(len(each.confirmed), len(each.told)) for each in fleet]) from None


def items_in(database: str) -> list[tuple[str, str, int, str]]:
    """Aircraft, epoch, sequence and payload of every item, in order."""
    items = schema.items.c
    query = sa.select(items.aircraft, items.epoch, items.sequence, items.payload)
    return sorted((row[0], row[1], row[2], row[3]) for row in rows_of(database, query))


def rows_of(database: str, query: sa.Executable) -> Sequence[Any]:
    engine = engine_of(database, reads_only=True)
    try:
        with engine.begin() as connection:
            return connection.execute(query).all()
    finally:
        engine.dispose()


def told_by(fleet: Sequence[Aircraft]) -> list[tuple[str, str, int, str]]:
    """Items told by the aircraft, in the form of the stored ones."""
    return sorted(
        (each.id, each.epoch, sequence, payload.decode()) for each in fleet for sequence, payload in each.told.items()
    )


def quick(fleet: Sequence[Aircraft], again_s: float = 0.4) -> None:
    """They tell again so soon that much comes twice."""
    for each in fleet:
        each.again_s = again_s


async def get(port: int, path: str = "/", *headers: str, method: str = "GET") -> tuple[int, str]:
    """The status, and all of the answer with its head."""
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    try:
        lines = [f"{method} {path} HTTP/1.1", *(headers or ("Host: 127.0.0.1",)), "", ""]
        writer.write("\r\n".join(lines).encode())
        answer = (await reader.read()).decode()
    finally:
        writer.close()
    return int(answer.split(" ")[1]), answer


def basic(password: str) -> str:
    """The header of somebody with that password."""
    return "Authorization: Basic " + base64.b64encode(f"anybody:{password}".encode()).decode()


@contextlib.asynccontextmanager
async def served(folder: Path, *fleet: Aircraft, password: str | None = None) -> AsyncIterator[int]:
    """The port of the pages of a database with what these have told."""
    database, port = str(folder / "fleet.sqlite"), free_port()
    store = Store(database)
    store.prepare()
    for one in fleet:
        store.take([Incoming(f"fleet/{one.id}/item", payload) for payload in one.told.values()])
        store.take([Incoming(f"fleet/{one.id}/hello", one.hello)])
    store.close()
    serving = asyncio.create_task(Server(f"127.0.0.1:{port}", database, password).run())
    try:
        async with asyncio.timeout(30.0):
            while True:
                with contextlib.suppress(OSError):
                    _, writer = await asyncio.open_connection("127.0.0.1", port)
                    writer.close()
                    break
                await asyncio.sleep(0.02)
        yield port
    finally:
        serving.cancel()
        await asyncio.gather(serving, return_exceptions=True)

"""A real PostgreSQL on a free loopback port, in a folder of its own."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import psycopg

from tests.support.broker import free_port

_HOMES = sorted(Path("/usr/lib/postgresql").glob("*/bin"), reverse=True)
INITDB = shutil.which("initdb", path=os.pathsep.join([*map(str, _HOMES), os.environ.get("PATH", "")]))
_ROOT = os.geteuid() == 0
_USER = "postgres" if _ROOT else None
"""User of the server: root is refused."""


class Postgres:
    """A server; stop it as a crash does, and start it again on its port. A folder that has one's data keeps them."""

    def __init__(self, folder: Path, **settings: str) -> None:
        assert INITDB is not None
        self._bin = Path(INITDB).resolve().parent
        self._data = folder / "data"
        self.port = free_port()
        if _ROOT:
            shutil.chown(folder, "postgres", "postgres")
        self._folder = folder
        self._settings = {"fsync": "off", "shared_buffers": "8MB", **settings}
        self._process: subprocess.Popen[bytes] | None = None
        if self._data.exists():
            return
        command = [
            f"{self._bin}/initdb",
            "-D",
            f"{self._data}",
            "--no-sync",
            "-A",
            "trust",
            "-U",
            "fleet",
            "-E",
            "UTF8",
        ]
        subprocess.run(command, check=True, capture_output=True, user=_USER, cwd=folder)

    def start(self) -> None:
        settings = {"port": f"{self.port}", "listen_addresses": "127.0.0.1", "unix_socket_directories": ""}
        settings |= self._settings
        options = [part for key, value in settings.items() for part in ("-c", f"{key}={value}")]
        command = [f"{self._bin}/postgres", "-D", f"{self._data}", *options]
        with (self._folder / "log").open("ab") as log:
            self._process = subprocess.Popen(command, stdout=log, stderr=log, user=_USER, cwd=self._folder)
        deadline_s = time.monotonic() + 60.0
        while True:
            with contextlib.suppress(psycopg.OperationalError), psycopg.connect(self.url("postgres")):
                return
            assert time.monotonic() < deadline_s
            assert self._process.poll() is None, (self._folder / "log").read_text()
            time.sleep(0.05)

    @property
    def process_id(self) -> int:
        assert self._process is not None
        return self._process.pid

    def kill(self) -> None:
        """Without an end to what it was at: the next start recovers."""
        if self._process is not None:
            self._process.send_signal(signal.SIGQUIT)
            self._process.wait(30.0)
            self._process = None

    def url(self, name: str) -> str:
        return f"postgresql://fleet@127.0.0.1:{self.port}/{name}"

    def create(self, name: str) -> str:
        with psycopg.connect(self.url("postgres"), autocommit=True) as connection:
            connection.execute(f'CREATE DATABASE "{name}"'.encode())
        return self.url(name)

    @contextlib.contextmanager
    def created_in(self, folder: Path) -> Iterator[str]:
        """The address of a new database whose tables are in a folder of their own; it is gone at the end."""
        if _ROOT:
            shutil.chown(folder, "postgres", "postgres")
        name = folder.name
        with psycopg.connect(self.url("postgres"), autocommit=True) as connection:
            connection.execute(f"CREATE TABLESPACE \"{name}\" LOCATION '{folder}'".encode())
            connection.execute(f'CREATE DATABASE "{name}" TABLESPACE "{name}"'.encode())
            try:
                yield self.url(name)
            finally:
                connection.execute(f'DROP DATABASE "{name}" WITH (FORCE)'.encode())
                connection.execute(f'DROP TABLESPACE "{name}"'.encode())


@contextlib.contextmanager
def postgres() -> Iterator[Postgres]:
    with tempfile.TemporaryDirectory(prefix="companion-pg-") as folder:
        one = Postgres(Path(folder))
        try:
            one.start()
            yield one
        finally:
            one.kill()

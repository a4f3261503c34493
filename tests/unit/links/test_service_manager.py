"""sd_notify: what is sent, and that a manager who is not there, or does not read, disturbs nothing."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from companion.links.system.process import ServiceManager


@pytest.fixture(params=["path", "abstract"])
def listener(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[tuple[str, socket.socket]]:
    name = str(tmp_path / "notify") if request.param == "path" else f"@companion-test-{os.getpid()}"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listening:
        listening.bind(name if request.param == "path" else "\0" + name[1:])
        listening.settimeout(5.0)
        yield name, listening


def test_what_is_sent(listener: tuple[str, socket.socket]) -> None:
    address, listening = listener
    manager = ServiceManager.from_environment({"NOTIFY_SOCKET": address})
    assert manager.notify("READY=1")
    assert manager.status("two\nlines")
    assert manager.status("two lines")  # the same: not sent again
    assert manager.notify("WATCHDOG=1")
    assert manager.notify("STOPPING=1")
    manager.close()
    came = [listening.recv(4096).decode() for _ in range(4)]
    assert came == ["READY=1", "STATUS=two lines", "WATCHDOG=1", "STOPPING=1"]
    assert not manager.notify("WATCHDOG=1")


def test_without_a_manager_nothing_happens() -> None:
    manager = ServiceManager.from_environment({"WATCHDOG_USEC": "1000000"})
    assert not manager.listens
    assert manager.watchdog_s is None
    assert not manager.notify("READY=1")


def test_a_manager_that_is_gone_is_said_once(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    manager = ServiceManager(str(tmp_path / "nobody"))
    assert not manager.notify("READY=1")
    assert not manager.notify("WATCHDOG=1")
    (said,) = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
    assert "systemd is not notified" in said
    manager.close()


def test_a_manager_that_does_not_read_stops_nobody(listener: tuple[str, socket.socket]) -> None:
    manager = ServiceManager(listener[0])
    sent = [manager.status(f"{number} " + "x" * 1000) for number in range(3000)]
    assert not sent[-1]  # its buffer is full, and we are still here
    for _ in range(sum(sent)):
        listener[1].recv(4096)
    assert manager.status(f"2999 {'x' * 1000}")  # what was not delivered is tried again
    assert listener[1].recv(4096).startswith(b"STATUS=2999 ")
    manager.close()


@pytest.mark.parametrize(
    ("environment", "watchdog_s"),
    [
        ({"WATCHDOG_USEC": "10000000"}, 10.0),
        ({"WATCHDOG_USEC": "10000000", "WATCHDOG_PID": "77"}, 10.0),
        ({"WATCHDOG_USEC": "10000000", "WATCHDOG_PID": "78"}, None),  # somebody else is watched
        ({"WATCHDOG_USEC": "ten"}, None),
        ({"WATCHDOG_USEC": "0"}, None),
        ({}, None),
    ],
)
def test_whom_the_watchdog_watches(environment: dict[str, str], watchdog_s: float | None) -> None:
    manager = ServiceManager.from_environment({"NOTIFY_SOCKET": "/run/x", **environment}, process_id=77)
    assert manager.watchdog_s == watchdog_s
    manager.close()


def test_an_address_of_another_kind_is_refused_in_one_line(caplog: pytest.LogCaptureFixture) -> None:
    assert not ServiceManager.from_environment({"NOTIFY_SOCKET": "vsock:2:1234"}).listens
    assert "found 'vsock:2:1234'; allowed: a path or @NAME" in caplog.text

"""A broker that comes, goes, refuses or says nothing: the daemon says why, comes back, and loses nothing else."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import sys
from pathlib import Path

import pytest

from companion.config import parse
from companion.config.sections import Mqtt
from companion.daemon.process.service import Service
from companion.mqtt import client as link
from companion.mqtt import process
from tests.support.broker import BEST, KINDS, Broker, Kind, broker, hurry, peer
from tests.support.children import in_process
from tests.support.mqtt_daemon import (
    ALONE,
    BASE,
    alone,
    is_,
    mosquitto_only,
    until_bad,
    until_connected,
    until_problem,
)

pytestmark = pytest.mark.real_clock


@pytest.fixture(autouse=True)
def _hurried(monkeypatch: pytest.MonkeyPatch) -> None:
    hurry(monkeypatch, BEST)


async def test_the_last_will_after_the_daemon_was_killed(tmp_path: Path) -> None:
    async with broker(tmp_path) as one, peer(one) as watcher:
        config = tmp_path / "companion.toml"
        config.write_text(ALONE.format(folder=tmp_path, more=one.section()))
        daemon = await asyncio.create_subprocess_exec(
            sys.executable, "-m", "companion", "-c", str(config), "run", stderr=asyncio.subprocess.PIPE
        )
        try:
            await watcher.until(f"{BASE}/status", is_(b"online"), 20.0)
            os.kill(daemon.pid, signal.SIGKILL)
            await watcher.until(f"{BASE}/status", is_(b"offline"))
        finally:
            with contextlib.suppress(ProcessLookupError):
                daemon.kill()
            await daemon.communicate()


@pytest.mark.parametrize("kind", KINDS)
async def test_a_broker_that_is_killed_and_comes_back_gets_everything_anew(
    tmp_path: Path, kind: Kind, monkeypatch: pytest.MonkeyPatch
) -> None:
    hurry(monkeypatch, kind)
    async with broker(tmp_path, kind) as one, alone(tmp_path, one.section()) as service:
        await until_connected(service)
        async with peer(one) as watcher:
            await watcher.until(f"{BASE}/state")
        one.kill()
        await until_connected(service, connected=False)
        summary = service.status()["mqtt"]["summary"]
        assert "next attempt in" in summary
        await one.start()
        await until_connected(service)
        async with peer(one) as watcher:  # its broker has forgotten everything: it was killed
            await watcher.until(f"{BASE}/status", is_(b"online"))
            state = (await watcher.until(f"{BASE}/state")).json
            assert state["vehicle"]["armed"] == "unknown"
            await watcher.publish(f"{BASE}/request/calibrate", {"transaction": "after"})
            refused = await watcher.response(BASE, "calibrate", "after")
            assert (refused["state"], refused["refusal"]) == ("refused", "unknown")
            assert "no autopilot found yet" in refused["reason"]


async def test_a_vehicle_that_is_heard_late_moves_to_its_own_topics(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(process, "FOUND_WITHIN_S", 0.1)
    async with broker(tmp_path) as one, peer(one) as watcher:
        text = ALONE.replace("[vehicle]\nsystem_id = 7\n", "").format(folder=tmp_path, more=one.section())
        service = Service(parse(text, "test.toml"), child=in_process(lambda: service))
        task = asyncio.create_task(service.serve(mavlink=False, ports=False))
        await watcher.until("companion/1/status", is_(b"online"))
        await watcher.until("companion/1/state")
        service.core.vehicle.system_id = 9
        await watcher.until("companion/9/status", is_(b"online"))
        for topic in ("status", "state"):
            await watcher.until(f"companion/1/{topic}", is_(b""))
        assert service.status()["mqtt"]["base_topic"] == "companion/9"
        task.cancel()
        await asyncio.wait([task])


@pytest.mark.parametrize("kind", KINDS)
async def test_a_wrong_password_is_said_and_mended_without_a_restart(tmp_path: Path, kind: Kind) -> None:
    async with broker(tmp_path, kind, users=True) as one:
        section = one.section()
        password = one.folder / "password"
        right = password.read_text()
        password.write_text("wrong\n")
        async with alone(tmp_path, section) as service:
            summary = await until_problem(service, "refuses user 'heron'")
            assert "password" in summary
            password.write_text(right)
            await until_connected(service)


@pytest.mark.filterwarnings(
    "ignore::pytest.PytestUnraisableExceptionWarning"
)  # paho leaves a failed handshake's socket
@pytest.mark.parametrize("kind", KINDS)
async def test_tls_by_an_authority_of_ones_own(tmp_path: Path, kind: Kind) -> None:
    async with broker(tmp_path, kind, tls=True, users=True) as one:
        async with alone(tmp_path, one.section()) as service, peer(one) as watcher:
            await until_connected(service)
            await watcher.until(f"{BASE}/status", is_(b"online"))
        (elsewhere := tmp_path / "elsewhere").mkdir()
        other = Broker(elsewhere, kind, tls=True)  # the authority of somebody else
        async with alone(tmp_path, one.section(ca_file=str(other.ca_file))) as service:
            assert "certificate is not trusted" in await until_problem(service, "certificate")
        async with alone(tmp_path, one.section(tls=False).replace("ca_file", "#")) as service:
            await until_problem(service, "does it want tls = true?")


@mosquitto_only
@pytest.mark.parametrize("access", ["topic read #", "topic write #"])
async def test_an_access_list_that_keeps_us_from_speaking_or_hearing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, access: str
) -> None:
    monkeypatch.setattr(link, "ANSWER_DEADLINE_S", 0.5)
    path = tmp_path / "access"
    path.write_text(access + "\n")
    path.chmod(0o644)
    async with broker(tmp_path, more=f"acl_file {path}") as one, alone(tmp_path, one.section()) as service:
        await until_bad(service, "our own messages: none comes back")


@mosquitto_only
async def test_a_message_too_long_for_the_broker_holds_up_no_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(link, "FIRST_WAIT_S", 0.05)
    async with broker(tmp_path, more="max_packet_size 20000") as one, peer(one) as watcher:
        ours = link.MqttLink(Mqtt(host="127.0.0.1", port=one.port), client_id="ours")
        ours.outbox.keep(f"{BASE}/calibration/state", b"x" * 30_000)
        ours.outbox.keep(f"{BASE}/state", b"short")
        task = asyncio.create_task(ours.run())
        await watcher.until(f"{BASE}/state", is_(b"short"))
        assert caplog.text.count("message dropped: 30000 bytes") == 1
        assert ours.connections == link.MOST_TRIES + 1
        task.cancel()
        await asyncio.wait([task])

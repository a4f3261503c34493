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
from companion.daemon.process.service import Service
from companion.mqtt import client as link
from companion.mqtt import process
from tests.support.broker import BEST, KINDS, Broker, Kind, broker, hurry, peer
from tests.support.children import in_process, mqtt_of
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


@pytest.fixture(autouse=True)
def _hurried(monkeypatch: pytest.MonkeyPatch) -> None:
    hurry(monkeypatch, BEST)


# --- it comes and goes


def test_the_last_will_after_the_daemon_was_killed(tmp_path: Path) -> None:
    async def main() -> None:
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

    asyncio.run(main())


def test_a_daemon_that_is_stopped_says_goodbye_and_ends_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(process, "FLUSH_S", 30.0)

    async def main() -> None:
        async with broker(tmp_path) as one, peer(one) as watcher:
            async with alone(tmp_path, one.section()) as service:
                await until_connected(service)
                await watcher.until(f"{BASE}/status", is_(b"online"))
                began_s = asyncio.get_running_loop().time()
            assert asyncio.get_running_loop().time() - began_s < 30.0
            await watcher.until(f"{BASE}/status", is_(b"offline"))

    asyncio.run(main())


@pytest.mark.parametrize("kind", KINDS)
def test_a_broker_that_is_killed_and_comes_back_gets_everything_anew(
    tmp_path: Path, kind: Kind, monkeypatch: pytest.MonkeyPatch
) -> None:
    hurry(monkeypatch, kind)

    async def main() -> None:
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
                assert "no autopilot heard yet" in refused["reason"]

    asyncio.run(main())


def test_something_that_listens_and_says_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(link, "GREETING_DEADLINE_S", 0.3)

    async def main() -> None:
        loop = asyncio.get_running_loop()
        connected: list[asyncio.StreamWriter] = []
        server = await asyncio.start_server(lambda _, writer: connected.append(writer), "127.0.0.1", 0)
        port = server.sockets[0].getsockname()[1]
        async with alone(tmp_path, f'[mqtt]\nhost = "127.0.0.1"\nport = {port}\n') as service:
            assert "does it want tls = true?" in await until_problem(service, "says nothing")
            monkeypatch.setattr(link, "GREETING_DEADLINE_S", 60.0)
            seen = len(connected)
            async with asyncio.timeout(40.0):
                while len(connected) == seen:
                    await asyncio.sleep(0.02)
            began_s = loop.time()
        assert loop.time() - began_s < 30.0  # stopped in the middle of an attempt
        for writer in connected:
            writer.close()
        server.close()

    asyncio.run(main())


def test_a_vehicle_that_is_heard_late_moves_to_its_own_topics(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(process, "FOUND_WITHIN_S", 0.1)

    async def main() -> None:
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

    asyncio.run(main())


def test_a_last_will_that_comes_late_is_put_right(tmp_path: Path) -> None:
    async def main() -> None:
        async with broker(tmp_path) as one, peer(one) as watcher, alone(tmp_path, one.section()) as service:
            await until_connected(service)
            await watcher.until(f"{BASE}/status", is_(b"online"))
            watcher.forget()
            await watcher.publish(f"{BASE}/status", b"offline", retain=True)
            await watcher.until(f"{BASE}/status", is_(b"online"))

    asyncio.run(main())


@mosquitto_only
def test_two_companions_of_one_name_are_told_apart_in_words(tmp_path: Path) -> None:
    async def main() -> None:
        async with broker(tmp_path) as one:
            (tmp_path / "a").mkdir()
            (tmp_path / "b").mkdir()
            async with alone(tmp_path / "a", one.section()) as first:
                await until_connected(first)
                async with alone(tmp_path / "b", one.section()):
                    assert "'companion-7'" in await until_problem(first, "another client called")

    asyncio.run(main())


# --- who may speak


@pytest.mark.parametrize("kind", KINDS)
def test_a_wrong_password_is_said_and_mended_without_a_restart(tmp_path: Path, kind: Kind) -> None:
    async def main() -> None:
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

    asyncio.run(main())


@pytest.mark.filterwarnings(
    "ignore::pytest.PytestUnraisableExceptionWarning"
)  # paho leaves a failed handshake's socket
@pytest.mark.parametrize("kind", KINDS)
def test_tls_by_an_authority_of_ones_own(tmp_path: Path, kind: Kind) -> None:
    async def main() -> None:
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

    asyncio.run(main())


@mosquitto_only
def test_a_broker_that_asks_for_certificates(tmp_path: Path) -> None:
    async def main() -> None:
        one = Broker(tmp_path, tls=True)
        one.more = f"cafile {one.ca_file}\nrequire_certificate true"
        mine = {"cert_file": str(one.folder / "client.pem"), "key_file": str(one.folder / "client-key.pem")}
        try:
            await one.start()
            async with alone(tmp_path, one.section(**mine)) as service:
                await until_connected(service)
            async with alone(tmp_path, one.section()) as service:
                assert "certificate" in await until_problem(service, "certificate")
        finally:
            one.kill()

    asyncio.run(main())


@mosquitto_only
@pytest.mark.parametrize("access", ["topic read #", "topic write #"])
def test_an_access_list_that_keeps_us_from_speaking_or_hearing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, access: str
) -> None:
    monkeypatch.setattr(link, "ANSWER_DEADLINE_S", 0.5)
    path = tmp_path / "access"
    path.write_text(access + "\n")
    path.chmod(0o644)

    async def main() -> None:
        async with broker(tmp_path, more=f"acl_file {path}") as one, alone(tmp_path, one.section()) as service:
            await until_bad(service, "our own messages do not come back")

    asyncio.run(main())


def test_an_access_list_that_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    hurry(monkeypatch, "amqtt")

    async def main() -> None:
        one = Broker(tmp_path, "amqtt")
        one.plugins["amqtt.plugins.topic_checking.TopicAccessControlListPlugin"] = {
            "acl": {"anonymous": [f"{BASE}/status"]}
        }
        try:
            await one.start()
            async with alone(tmp_path, one.section()) as service:
                await until_bad(service, f"does not let us hear {BASE}/request/+")
        finally:
            one.kill()

    asyncio.run(main())


# --- it does not take everything


@mosquitto_only
@pytest.mark.parametrize("limit", ["max_packet_size 9000", "message_size_limit 8800"])
def test_a_message_that_is_too_long_for_the_broker_is_left_out_and_the_others_go_on(tmp_path: Path, limit: str) -> None:
    async def main() -> None:
        async with broker(tmp_path, more=limit) as one, alone(tmp_path, one.section()) as service:
            await until_connected(service)
            link = mqtt_of(service).link
            assert link is not None
            outbox = link.outbox
            async with peer(one) as watcher:
                outbox.answer("fleet/of/long", b"x" * 9000, droppable=True)
                outbox.answer("fleet/of/short", b"behind it", droppable=True)
                await watcher.until("fleet/of/short", is_(b"behind it"))
                await until_bad(service, "messages of 9.0 kB or more end the connection (the broker's size limit?)")
                connections = link.connections
                for k in range(5):
                    outbox.answer("fleet/of/long", b"x" * 9000, droppable=True)
                    outbox.answer("fleet/of/almost", b"%d" % k + b"x" * 8500, droppable=True)
                    await watcher.until("fleet/of/almost", is_(b"%d" % k + b"x" * 8500))
                assert link.connections == connections
                assert not [heard for heard in watcher.heard if heard.topic == "fleet/of/long"]

    asyncio.run(main())

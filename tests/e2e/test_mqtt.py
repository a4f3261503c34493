"""MQTT against a real broker: who asks is answered, who listens later knows, and a lost broker costs nothing else."""

from __future__ import annotations

import asyncio
import contextlib
import importlib.util
import json
import logging
import os
import signal
import sys
from collections.abc import AsyncIterator, Callable
from pathlib import Path

import pytest

from companion.calibration.machine import State
from companion.config import parse
from companion.daemon.mqtt import face
from companion.daemon.service import Service
from companion.links import mqtt as link
from tests.support.broker import BEST, KINDS, Broker, Heard, Kind, broker, hurry, peer
from tests.support.rig import Rig

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


@pytest.fixture(autouse=True)
def _hurried(monkeypatch: pytest.MonkeyPatch) -> None:
    hurry(monkeypatch, BEST)


@contextlib.asynccontextmanager
async def alone(folder: Path, section: str) -> AsyncIterator[Service]:
    """The daemon's parts without an autopilot; it is stopped in order at the end."""
    service = Service(parse(ALONE.format(folder=folder, more=section), "test.toml"))
    task = asyncio.create_task(service.serve(mavlink=False, ports=False))
    try:
        yield service
        assert not task.done()
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task


async def until_connected(service: Service, *, connected: bool = True, within_s: float = 10.0) -> None:
    assert service.mqtt is not None
    async with asyncio.timeout(within_s):
        while service.status()["mqtt"]["connected"] != connected:
            await asyncio.sleep(0.02)


async def until_problem(service: Service, words: str, within_s: float = 10.0) -> str:
    async with asyncio.timeout(within_s):
        while words not in (service.status()["mqtt"].get("last_error") or ""):
            await asyncio.sleep(0.02)
    return str(service.status()["mqtt"]["summary"])


def is_(payload: bytes) -> Callable[[Heard], bool]:
    return lambda heard: heard.payload == payload


def says(state: str) -> Callable[[Heard], bool]:
    return lambda heard: heard.json["state"] == state


# --- a calibration, with a whole aircraft


def test_a_calibration_is_asked_for_watched_and_answered(tmp_path: Path) -> None:
    async def main() -> None:
        async with broker(tmp_path) as one, peer(one) as watcher:
            rig = Rig(tmp_path, min_still_s=3.0, max_s=4.0, more=one.section())
            rig.offload = asyncio.to_thread
            async with rig.running():
                await until_connected(rig.service)
                await watcher.until("companion/1/status", is_(b"online"))
                await rig.ready()
                await watcher.publish("companion/1/request/calibrate", {"transaction": "t 1", "what": "both"})
                accepted = await watcher.response("companion/1", "calibrate", "t 1")
                assert accepted["state"] == "accepted"
                progress = await watcher.until("companion/1/calibration/progress", says("collecting"), 20.0)
                assert progress.json["requester"] == "mqtt calibrate"
                assert 0 <= progress.json["percent"] < 100
                await watcher.publish("companion/1/request/calibrate", {"transaction": "t 2"})
                busy = await watcher.response("companion/1", "calibrate", "t 2")
                assert (busy["state"], busy["refusal"]) == ("refused", "busy")
                # Delivered again, as QoS 1 may: no second calibration, the same answer.
                watcher.forget()
                await watcher.publish("companion/1/request/calibrate", {"transaction": "t 1", "what": "both"})
                again = await watcher.response("companion/1", "calibrate", "t 1", "accepted")
                assert again["repeated"] is True
                done = await watcher.response("companion/1", "calibrate", "t 1", "done", within_s=60.0)
                assert done["record"]["imus"][0]["written"]["INS_GYROFFS_X"]["outcome"] == "verified"
                kept = await watcher.until("companion/1/calibration/state", lambda heard: heard.json["state"] == "done")
                assert kept.json == done["record"]
                last = await watcher.until("companion/1/calibration/progress", says("done"))
                assert last.json["percent"] == 100
                await _the_pose(rig, watcher.heard)
                assert len(rig.service.store.history()) == 1

                watcher.forget()
                await watcher.publish("companion/1/request/undo", {"transaction": 3})
                undone = await watcher.response("companion/1", "undo", 3, within_s=20.0)
                assert undone["state"] == "done"
                await watcher.until("companion/1/calibration/state", lambda heard: heard.json["undone_at"] is not None)
            await watcher.until("companion/1/status", is_(b"offline"))

    asyncio.run(main())


async def _the_pose(rig: Rig, heard: list[Heard]) -> None:
    """The attitude is the aircraft's, and comes no more than five times a second."""
    poses = [one.json for one in heard if one.topic == "companion/1/attitude"]
    truth = rig.aircraft.pose_at(rig.aircraft.time_at(rig.now_s))
    assert poses[-1]["pitch_deg"] == pytest.approx(truth.pitch_deg, abs=0.1)
    assert poses[-1]["roll_deg"] == pytest.approx(truth.roll_deg, abs=0.1)
    assert poses[-1]["heading_deg"] == pytest.approx(truth.heading_deg, abs=3.0)
    assert poses[-1]["north"] == "true"


def test_a_cancel_from_another_face_is_seen_here(tmp_path: Path) -> None:
    async def main() -> None:
        async with broker(tmp_path) as one, peer(one) as watcher:
            rig = Rig(tmp_path, min_still_s=60.0, max_s=60.0, more=one.section(base_topic="field/heron"))
            rig.offload = asyncio.to_thread
            async with rig.running():
                await until_connected(rig.service)
                await rig.ready()
                await watcher.publish("field/heron/request/calibrate", {"transaction": "x"})
                await watcher.response("field/heron", "calibrate", "x", "accepted")
                replies = [reply async for reply in rig.service.answers.answer({"command": "cancel"})]
                assert replies[-1]["state"] == "cancelled"
                ended = await watcher.response("field/heron", "calibrate", "x", "cancelled")
                assert ended["reason"] == "cancelled by companion cancel"
                kept = await watcher.until("field/heron/calibration/state")
                assert kept.json["state"] == "cancelled"

                watcher.forget()
                await watcher.publish("field/heron/request/calibrate", {"transaction": "y"})
                await watcher.response("field/heron", "calibrate", "y", "accepted")
                await watcher.publish("field/heron/request/cancel")
                await watcher.response("field/heron", "calibrate", "y", "cancelled")
                said = await watcher.response("field/heron", "cancel", None)
                assert said["reason"] == "cancelled by mqtt cancel"

    asyncio.run(main())


# --- the broker comes and goes


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


def test_a_daemon_that_is_stopped_says_goodbye_and_ends_at_once(tmp_path: Path) -> None:
    async def main() -> None:
        async with broker(tmp_path) as one, peer(one) as watcher:
            async with alone(tmp_path, one.section()) as service:
                await until_connected(service)
                await watcher.until(f"{BASE}/status", is_(b"online"))
                began_s = asyncio.get_running_loop().time()
            assert asyncio.get_running_loop().time() - began_s < 0.8
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


def test_a_broker_that_is_absent_at_start(tmp_path: Path) -> None:
    async def main() -> None:
        one = Broker(tmp_path)
        try:
            async with alone(tmp_path, one.section()) as service:
                summary = await until_problem(service, "nobody listens there")
                assert f"127.0.0.1:{one.port}" in summary
                await one.start()
                await until_connected(service)
        finally:
            one.kill()

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
            async with asyncio.timeout(10.0):
                while len(connected) == seen:
                    await asyncio.sleep(0.02)
            began_s = loop.time()
        assert loop.time() - began_s < 0.8  # stopped in the middle of an attempt
        for writer in connected:
            writer.close()
        server.close()

    asyncio.run(main())


def test_what_ended_while_the_broker_was_away_is_not_lost(tmp_path: Path) -> None:
    async def main() -> None:
        async with broker(tmp_path) as one:
            rig = Rig(tmp_path, min_still_s=60.0, max_s=60.0, more=one.section())
            rig.offload = asyncio.to_thread
            async with rig.running():
                await until_connected(rig.service)
                await rig.ready()
                async with peer(one) as watcher:
                    await watcher.publish("companion/1/request/calibrate", {"transaction": "lost"})
                    await watcher.response("companion/1", "calibrate", "lost", "accepted")
                one.kill()
                await until_connected(rig.service, connected=False)
                assert rig.service.conductor.cancel("somebody")
                await rig.until(lambda: rig.service.conductor.state is State.CANCELLED, 10.0)
                await one.start()
                async with peer(one) as watcher:
                    record = (await watcher.until("companion/1/calibration/state")).json
                    assert record["reason"] == "cancelled by somebody"
                    await watcher.response("companion/1", "calibrate", "lost", "cancelled")

    asyncio.run(main())


def test_a_vehicle_that_is_heard_late_moves_to_its_own_topics(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(face, "FOUND_WITHIN_S", 0.1)

    async def main() -> None:
        async with broker(tmp_path) as one, peer(one) as watcher:
            text = ALONE.replace("[vehicle]\nsystem_id = 7\n", "").format(folder=tmp_path, more=one.section())
            service = Service(parse(text, "test.toml"))
            task = asyncio.create_task(service.serve(mavlink=False, ports=False))
            await watcher.until("companion/1/status", is_(b"online"))
            await watcher.until("companion/1/state")
            service.vehicle.system_id = 9
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
                    assert "'companion-7'" in await until_problem(first, "is another client called")

    asyncio.run(main())


# --- who may speak


@pytest.mark.parametrize("kind", KINDS)
def test_a_wrong_password_is_said_and_mended_without_a_restart(
    tmp_path: Path, kind: Kind, monkeypatch: pytest.MonkeyPatch
) -> None:
    hurry(monkeypatch, kind)

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


def test_a_password_file_that_is_missing_is_one_line(tmp_path: Path) -> None:
    async def main() -> None:
        async with broker(tmp_path, users=True) as one:
            section = one.section()
            (one.folder / "password").unlink()
            async with alone(tmp_path, section) as service:
                assert f"{one.folder}/password: no such file" in await until_problem(service, "password file")

    asyncio.run(main())


# paho leaves the socket of a failed handshake to the garbage collector.
@pytest.mark.filterwarnings("ignore:unclosed <ssl.SSLSocket:ResourceWarning")
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize("kind", KINDS)
def test_tls_by_an_authority_of_ones_own(tmp_path: Path, kind: Kind, monkeypatch: pytest.MonkeyPatch) -> None:
    hurry(monkeypatch, kind)

    async def main() -> None:
        async with broker(tmp_path, kind, tls=True, users=True) as one:
            async with alone(tmp_path, one.section()) as service, peer(one) as watcher:
                await until_connected(service)
                await watcher.until(f"{BASE}/status", is_(b"online"))
            other = Broker(tmp_path / "..", kind, tls=True)  # the authority of somebody else
            async with alone(tmp_path, one.section(ca_file=str(other.ca_file))) as service:
                assert "certificate is not trusted" in await until_problem(service, "certificate")
            async with alone(tmp_path, one.section(tls=False).replace("ca_file", "#")) as service:
                await until_problem(service, "does it want tls = true?")

    asyncio.run(main())


@mosquitto_only
@pytest.mark.filterwarnings("ignore:unclosed <ssl.SSLSocket:ResourceWarning")
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
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


async def until_bad(service: Service, words: str) -> None:
    async with asyncio.timeout(10.0):
        while words not in service.status()["mqtt"]["summary"]:
            await asyncio.sleep(0.05)
    assert service.status()["mqtt"]["connected"]
    assert not service.status()["mqtt"]["good"]


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


# --- requests that nobody wants


def test_a_retained_request_is_never_obeyed(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)

    async def main() -> None:
        async with broker(tmp_path) as one, peer(one) as watcher:
            await watcher.publish(f"{BASE}/request/calibrate", {"transaction": "old"}, retain=True)
            async with alone(tmp_path, one.section()) as service:
                await until_connected(service)
                refused = await watcher.response(BASE, "calibrate", "old")
                assert (refused["state"], refused["refusal"]) == ("refused", "request")
                assert "retained request is never obeyed" in refused["reason"]
                one.kill()
                await until_connected(service, connected=False)
                await one.start()
                await until_connected(service)
            assert sum("retained request" in record.message for record in caplog.records) == 1

    asyncio.run(main())


@mosquitto_only
def test_a_request_published_to_be_retained_is_not_obeyed_either(tmp_path: Path) -> None:
    async def main() -> None:
        async with broker(tmp_path) as one, peer(one) as watcher, alone(tmp_path, one.section()) as service:
            await until_connected(service)
            await watcher.publish(f"{BASE}/request/calibrate", {"transaction": "kept"}, retain=True)
            refused = await watcher.response(BASE, "calibrate", "kept")
            assert "retained" in refused["reason"]
            watcher.forget()
            await watcher.publish(f"{BASE}/request/calibrate", b"", retain=True)  # deletes it
            await watcher.publish(f"{BASE}/request/cancel", {"transaction": "end"})
            await watcher.response(BASE, "cancel", "end")
            assert watcher.responses(BASE, "calibrate") == []

    asyncio.run(main())


def test_a_flood_of_requests_is_answered_and_disturbs_nothing(tmp_path: Path) -> None:
    async def main() -> None:
        async with broker(tmp_path) as one:
            rig = Rig(tmp_path, min_still_s=60.0, max_s=60.0, more=one.section())
            rig.offload = asyncio.to_thread
            async with rig.running(), peer(one) as watcher:
                await until_connected(rig.service)
                await rig.ready()
                heartbeats = rig.service.vehicle.heartbeat_age_s
                assert heartbeats is not None
                for number in range(500):
                    await watcher.publish("companion/1/request/calibrate", {"transaction": number}, qos=0)
                await watcher.publish("companion/1/request/calibrate", {"transaction": "last"})
                await watcher.response("companion/1", "calibrate", "last", within_s=30.0)
                answers = watcher.responses("companion/1", "calibrate")
                assert [one["state"] for one in answers].count("accepted") == 1
                assert {one["refusal"] for one in answers if one["state"] == "refused"} == {"busy"}
                assert rig.service.conductor.cancel("test")
                await rig.until(lambda: rig.service.conductor.state is State.CANCELLED, 10.0)
                assert len(rig.service.store.history()) == 1
                mqtt = rig.service.mqtt
                assert mqtt is not None
                assert mqtt.link is not None
                assert len(mqtt.link.outbox) < 100

    asyncio.run(main())


# --- without the library, and at the check


def test_without_aiomqtt_the_daemon_goes_on_and_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "aiomqtt" else find(name))

    async def main() -> None:
        async with alone(tmp_path, '[mqtt]\nhost = "127.0.0.1"\n') as service:
            summary = await until_problem(service, "aiomqtt")
            assert "pip install 'aiomqtt>=2.5,<3'" in summary
            assert service.status()["state"] == "idle"
        assert sum("aiomqtt" in record.message for record in caplog.records) == 1

    asyncio.run(main())


def test_the_check_and_the_status_tell_how_the_broker_is_reached(tmp_path: Path) -> None:
    async def companion(*words: str) -> tuple[int, str]:
        process = await asyncio.create_subprocess_exec(
            sys.executable, "-m", "companion", "-c", str(tmp_path / "c.toml"), *words, stdout=asyncio.subprocess.PIPE
        )
        out, _ = await process.communicate()
        assert process.returncode is not None
        return process.returncode, out.decode()

    async def main() -> None:
        async with broker(tmp_path) as one, peer(one) as watcher:
            (tmp_path / "c.toml").write_text(ALONE.format(folder=tmp_path, more=one.section()))
            _, out = await companion("check", "--json", "--seconds", "2" if BEST == "mosquitto" else "8")
            findings = {finding["name"]: finding for finding in json.loads(out)["findings"]}
            assert findings["mqtt"]["good"], findings["mqtt"]
            assert f"connected to 127.0.0.1:{one.port}" in findings["mqtt"]["words"]
            assert watcher.heard == []  # a check changes nothing
            one.kill()
            code, out = await companion("check", "--seconds", "1")
            assert code == 1
            assert "nobody listens there" in out
            async with alone(tmp_path, one.section()) as service:
                await until_problem(service, "nobody")
                from companion.cli.show import status_lines

                (line,) = [line for line in status_lines(service.status()) if line.startswith("mqtt:")]
                assert "next attempt in" in line

    asyncio.run(main())


def test_discovery_for_home_assistant(tmp_path: Path) -> None:
    async def main() -> None:
        async with broker(tmp_path) as one, peer(one) as watcher:
            section = one.section(discovery="homeassistant")
            async with alone(tmp_path, section) as service:
                await until_connected(service)
                found = (await watcher.until("homeassistant/device/companion_7/config")).json
        assert found["availability_topic"] == f"{BASE}/status"
        assert found["origin"]["name"]
        for component in found["components"].values():
            assert component["platform"] in ("sensor", "binary_sensor", "button")
            assert component["unique_id"].startswith("companion_7_")
            assert component.get("command_topic", f"{BASE}/request/").startswith(f"{BASE}/request/")

    asyncio.run(main())

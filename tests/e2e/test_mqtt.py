"""MQTT against a real broker: who asks is answered, who listens later knows, and nobody calibrates twice."""

from __future__ import annotations

import asyncio
import json
import logging
import sys
from pathlib import Path

import msgspec
import pytest

from tests.support.broker import BEST, Heard, broker, hurry, peer
from tests.support.mqtt_daemon import (
    ALONE,
    BASE,
    alone,
    is_,
    mosquitto_only,
    says,
    until_connected,
    until_problem,
)
from tests.support.rig import Rig


@pytest.fixture(autouse=True)
def _hurried(monkeypatch: pytest.MonkeyPatch) -> None:
    hurry(monkeypatch, BEST)


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
                assert len(rig.service.calibrating.store.history()) == 1

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
                replies = [reply async for reply in rig.service.faces.answer({"command": "cancel"})]
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


def test_the_record_of_a_calibration_that_the_stop_cancels_is_published(tmp_path: Path) -> None:
    async def main() -> None:
        async with broker(tmp_path) as one, peer(one) as watcher:
            rig = Rig(tmp_path, min_still_s=3.0, max_s=60.0, more=one.section())
            rig.offload = asyncio.to_thread
            rig.config = msgspec.structs.replace(
                rig.config, calibration=msgspec.structs.replace(rig.config.calibration, target_gyro_sigma_deg_h=0.01)
            )
            async with rig.running():
                await until_connected(rig.service)
                await rig.ready()
                await watcher.publish("companion/1/request/calibrate", {"transaction": "x"})
                await watcher.until("companion/1/calibration/progress", says("collecting"), 60.0)
            kept = await watcher.until("companion/1/calibration/state")
            assert kept.json["state"] == "cancelled"
            await watcher.until("companion/1/status", is_(b"offline"))

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


# --- without the library, and at the check


def test_without_aiomqtt_the_daemon_goes_on_and_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setitem(sys.modules, "aiomqtt", None)

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

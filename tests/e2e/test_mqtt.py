"""MQTT against a real broker: who asks is answered, who listens later knows, and nobody calibrates twice."""

from __future__ import annotations

import asyncio
import logging
from pathlib import Path

import pytest

from tests.support.broker import BEST, Heard, broker, hurry, peer
from tests.support.mqtt_daemon import (
    BASE,
    alone,
    is_,
    says,
    until_connected,
)
from tests.support.rig import Rig

pytestmark = pytest.mark.real_clock


@pytest.fixture(autouse=True)
def _hurried(monkeypatch: pytest.MonkeyPatch) -> None:
    hurry(monkeypatch, BEST)


# --- a calibration, with a whole aircraft


async def test_a_calibration_is_asked_for_watched_and_answered(tmp_path: Path) -> None:
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


async def _the_pose(rig: Rig, heard: list[Heard]) -> None:
    """The attitude is the aircraft's, and comes no more than five times a second."""
    poses = [one.json for one in heard if one.topic == "companion/1/attitude"]
    truth = rig.aircraft.pose_at(rig.aircraft.time_at(rig.now_s))
    assert poses[-1]["pitch_deg"] == pytest.approx(truth.pitch_deg, abs=0.1)
    assert poses[-1]["roll_deg"] == pytest.approx(truth.roll_deg, abs=0.1)
    assert poses[-1]["heading_deg"] == pytest.approx(truth.heading_deg, abs=3.0)
    assert poses[-1]["north"] == "true"


async def test_a_cancel_from_another_face_is_seen_here(tmp_path: Path) -> None:
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
            assert ended["reason"] == "cancelled by companion cancel; nothing written"
            kept = await watcher.until("field/heron/calibration/state")
            assert kept.json["state"] == "cancelled"

            watcher.forget()
            await watcher.publish("field/heron/request/calibrate", {"transaction": "y"})
            await watcher.response("field/heron", "calibrate", "y", "accepted")
            await watcher.publish("field/heron/request/cancel")
            await watcher.response("field/heron", "calibrate", "y", "cancelled")
            said = await watcher.response("field/heron", "cancel", None)
            assert said["reason"] == "cancelled by mqtt; nothing written"


# --- requests that nobody wants


async def test_a_retained_request_is_never_obeyed(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    async with broker(tmp_path) as one, peer(one) as watcher:
        await watcher.publish(f"{BASE}/request/calibrate", {"transaction": "old"}, retain=True)
        async with alone(tmp_path, one.section()) as service:
            await until_connected(service)
            refused = await watcher.response(BASE, "calibrate", "old")
            assert (refused["state"], refused["refusal"]) == ("refused", "request")
            assert "the retained request at" in refused["reason"]
            one.kill()
            await until_connected(service, connected=False)
            await one.start()
            await until_connected(service)
        assert sum("retained request" in record.message for record in caplog.records) == 1

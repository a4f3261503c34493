"""Recording a calibration and replaying it: the same biases, up to any cut, whatever goes wrong with the disk."""

from __future__ import annotations

import asyncio
import json
import random
import shutil
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

from companion.autopilot.vehicle.vehicle import ArmState
from companion.cli import main as companion
from companion.config.sections import AllanModel, Config, NoiseProfile
from companion.errors import StorageError
from companion.estimation.records.record import Record, to_json
from companion.formats import Object
from companion.lab.recording import MAGIC
from companion.lab.replay import TOLERANCE_SIGMAS, Replay, replay
from companion.recording import messages
from tests.e2e.test_calibration import calibrated
from tests.e2e.test_script_floats import px4, three_imus
from tests.support.rig import Rig
from tests.support.virtual_time import run_virtual


def ring(folder: Path) -> list[Path]:
    return sorted((folder / "recordings").glob("0*.mcap"))


def record(folder: Path, during: Callable[[Rig], Any] | None = None, **options: Any) -> tuple[list[Path], list[Record]]:
    """A calibration from power-on: the ring's files, and the records that the daemon itself kept, oldest first."""

    async def main() -> list[Record]:
        rig = Rig(folder, recordings_mb=64, **options)
        (fc, *others) = rig.config.imu
        # Where the replay runs nobody has this profile: a flicker of 2 mrad/s is far above every other's.
        learned = NoiseProfile("mine", AllanModel(3.5e-5, 2e-3, 1e-6), AllanModel(5e-4, 0.05, 1e-5))
        if options.get("seed") == 3:
            rig.config = msgspec.structs.replace(
                rig.config, imu=[msgspec.structs.replace(fc, profile=learned), *others]
            )
        async with rig.running():
            await rig.ready()
            if during is not None:
                await during(rig)
            else:
                result, _ = await calibrated(rig)
                assert result.outcome == "done", result
            await asyncio.sleep(2.5)
        return rig.service.calibrating.store.history()[::-1]

    records = run_virtual(main())
    return ring(folder), records


@pytest.fixture(scope="module")
def usual(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Record]:
    """One calibration of two IMUs, as most tests here need it."""
    paths, records = record(tmp_path_factory.mktemp("usual"), own_imu=True, min_still_s=5.0, max_s=6.0)
    assert len(records) == 1
    return paths[0], records[0]


def same(result: Replay, records: list[Record]) -> None:
    """Every calibration was recomputed and agrees within the tolerance, biases and sigmas."""
    assert [each.not_recomputed for each in result.calibrations] == [None] * len(records)
    assert [difference for each in result.calibrations for difference in each.differences] == []
    for each, kept in zip(result.calibrations, records, strict=True):
        assert each.worst_sigmas is not None
        assert each.worst_sigmas <= TOLERANCE_SIGMAS
        assert each.record.started_at == kept.started_at
        for imu, before in zip(each.record.imus, kept.imus, strict=True):
            for name in ("gyro_bias_rad_s", "accel_bias_m_s2"):
                sigma = getattr(before, name.replace("bias", "sigma_use"))
                if getattr(before, name) is None:
                    assert getattr(imu, name) is None
                    continue
                off = np.subtract(getattr(imu, name), getattr(before, name)) / sigma
                assert np.abs(off).max() <= TOLERANCE_SIGMAS
                assert getattr(imu, name.replace("bias", "sigma_use")) == pytest.approx(sigma, rel=0.01)


# --- the round trip


@pytest.mark.parametrize(
    "options",
    [
        {"firmware": "ardupilot", "own_imu": True},
        {"firmware": "px4", "seed": 3},
        {"loss": 0.05, "duplicate": 0.05, "own_imu": True, "seed": 4, "feed_s": 0.07},
        {"law": "euler", "vehicle": "plane", "seed": 5, "device_rate_hz": 0.8},
    ],
    ids=["ardupilot", "px4, a saved profile", "a bad link", "plane, slow sensors"],
)
def test_a_replay_gives_the_recorded_biases(tmp_path: Path, options: dict[str, Any]) -> None:
    paths, records = record(tmp_path, min_still_s=5.0, max_s=8.0, **options)
    result = replay(paths)
    same(result, records)
    assert result.cut_short is None
    assert result.notes == []
    assert result.seconds > 12.0
    if options.get("seed") == 3:
        assert min(result.calibrations[0].record.imus[0].gyro_sigma_use_rad_s or (0.0,)) > 2e-3


def test_floats_of_px4_are_replayed_with_the_bias_that_its_console_told(tmp_path: Path) -> None:
    async def during(rig: Rig) -> None:
        imu = rig.service.devices.imus["fc"]
        await rig.until(lambda: imu.stream.kind is not None and imu.stream.kind.name.startswith("HIGHRES"), 60.0)
        result, _ = await calibrated(rig)
        assert result.outcome == "done", result

    paths, records = record(tmp_path, during, firmware="px4", min_still_s=5.0, max_s=8.0)
    same(replay(paths), records)


def test_moved_armed_unplugged_restarted_and_over_several_files(tmp_path: Path) -> None:
    """The causes of new stretches are not recorded; the windows begin as recorded all the same."""

    async def during(rig: Rig) -> None:
        await asyncio.sleep(4.0)
        rig.double.arm()
        await rig.until(lambda: rig.service.core.vehicle.arm_state is ArmState.ARMED, 5.0)
        await asyncio.sleep(2.0)
        rig.double.disarm()
        rig.unplugged.add("own")
        await asyncio.sleep(4.0)
        rig.unplugged.clear()
        for _ in range(2):
            await rig.until(lambda: rig.service.core.vehicle.arm_state is ArmState.DISARMED, 5.0)
            rig.devices["own"].power_on(rig.aircraft.time_at(rig.now_s))
            await asyncio.sleep(4.3)
            assert rig.service.recorder._ring is not None
            rig.service.recorder._ring.close()
            result, _ = await calibrated(rig)
            assert result.outcome == "done", result
        assert rig.service.devices.sensors[0].decoder.times.clock.breaks == 2

    paths, records = record(tmp_path, during, own_imu=True, min_still_s=5.0, max_s=8.0)
    assert len(records) == 2
    assert len(paths) == 3
    same(replay(paths), records)
    # By itself a file has only what was measured since it began.
    (alone,) = replay(paths[1:2]).calibrations
    assert alone.not_recomputed == "it was measured before the recording began"
    others, _ = record(tmp_path / "other", own_imu=True)
    with pytest.raises(StorageError, match="not of the same run of the daemon as the file before"):
        replay([paths[0], *others])


@pytest.mark.parametrize("firmware", ["ardupilot", "px4"])
@pytest.mark.parametrize("floats", [False, True])
async def test_integers_and_the_floats_in_their_place_are_replayed_as_such(
    tmp_path: Path, firmware: str, floats: bool
) -> None:
    if firmware == "ardupilot":
        rig = three_imus(tmp_path, script=floats, max_s=20.0)
    else:
        rig = px4(tmp_path, console=floats, max_s=20.0)
    storage = msgspec.structs.replace(rig.config.storage, recordings_mb=64)
    rig.config = msgspec.structs.replace(rig.config, storage=storage)
    async with rig.running():
        imus = rig.service.devices.imus.values()
        await rig.until(lambda: all(imu.calibration is not None for imu in imus), 15.0)
        result, record = await calibrated(rig)
        assert result.outcome == "done", result
        assert (record.imus[1].gyro_bias_rad_s is not None) == floats
        await asyncio.sleep(1.5)
    (kept,) = rig.service.calibrating.store.history()
    same(replay(ring(tmp_path)), [kept])


def rewritten(path: Path, to: Path, change: Callable[[str, bytes], bytes | None], **options: Any) -> Path:
    """A copy made by the independent library, with some messages changed or left out."""
    with path.open("rb") as source, to.open("wb") as file:
        reader = make_reader(source)
        writer: Any = Writer(file, **options)
        writer.start()
        for metadata in reader.iter_metadata():
            writer.add_metadata(metadata.name, metadata.metadata)
        for attachment in reader.iter_attachments():
            writer.add_attachment(0, 0, attachment.name, attachment.media_type, attachment.data)
        channels: dict[str, int] = {}
        # In the order of writing, which is what a replay goes by.
        for _, channel, message in reader.iter_messages(log_time_order=False):
            data = change(channel.topic, message.data)
            if data is None:
                continue
            if channel.topic not in channels:
                channels[channel.topic] = writer.register_channel(channel.topic, channel.message_encoding, 0)
            writer.add_message(channels[channel.topic], message.log_time, data, message.publish_time)
        writer.finish()
    return to


# --- cut and damaged


def test_cut_at_any_byte_it_replays_up_to_the_cut(
    usual: tuple[Path, Record], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, kept = usual
    data, rng = path.read_bytes(), random.Random(12)
    with path.open("rb") as file:
        times = [m.log_time for _, channel, m in make_reader(file).iter_messages() if channel.topic == messages.RECORD]
        file.seek(0)
        summary = make_reader(file).get_summary()
    assert summary is not None
    first, *_ = summary.chunk_indexes
    holds = next(c for c in summary.chunk_indexes if c.message_start_time <= times[0] <= c.message_end_time)
    after, begun = holds.chunk_start_offset + holds.chunk_length, first.chunk_start_offset + first.chunk_length
    cut_path = tmp_path / "cut.mcap"
    for cut in [1, len(MAGIC), 60, *(rng.randrange(begun, after) for _ in range(8)), after, len(data) - 5]:
        cut_path.write_bytes(data[:cut])
        if cut < 100:
            assert companion(["log", "replay", str(cut_path)]) == 1
            said = capsys.readouterr().err
            assert "before anything was recorded" in said
            assert said.count("\n") == 1
            continue
        result = replay([cut_path])
        if cut >= after:
            same(result, [kept])
        else:
            assert result.calibrations == []
            assert result.cut_short is not None


def test_the_independent_reader_finds_the_bytes_the_configuration_and_the_record(usual: tuple[Path, Record]) -> None:
    path, kept = usual
    count: dict[str, int] = {}
    with path.open("rb") as file:
        for _, channel, message in make_reader(file, validate_crcs=True).iter_messages():
            count[channel.topic] = count.get(channel.topic, 0) + len(message.data)
            assert message.log_time > 1.6e18, "UTC"
            if channel.topic == messages.RECORD:
                assert msgspec.json.decode(message.data, type=Record) == kept
        file.seek(0)
        (metadata,) = make_reader(file).iter_metadata()
        file.seek(0)
        (attachment,) = make_reader(file).iter_attachments()
    assert metadata.name == "companion"
    assert {"companion", "format", "offset_ns"} == set(metadata.metadata)
    assert [imu.name for imu in msgspec.json.decode(attachment.data, type=Config).imu] == ["fc", "own"]
    assert set(count) == {
        *("/serial/own", "/serial/gradienter", "/serial/compass", "/mavlink/in", "/autopilot/imu/fc"),
        *("/companion/start", "/companion/tick", "/companion/place"),
        *("/companion/measured", "/companion/solved", "/companion/record"),
    }
    assert count["/serial/own"] > 200 * 40 * 10


# --- on request


async def asked(rig: Rig, **request: Any) -> list[Object]:
    return [reply async for reply in rig.service.faces.answer({"command": "record", **request})]


async def test_recording_on_request(tmp_path: Path) -> None:
    path, absent = tmp_path / "mine.mcap", tmp_path / "nowhere" / "at" / "all.mcap"
    async with Rig(tmp_path, own_imu=True).running() as rig:
        await rig.ready()
        await asyncio.sleep(3.3)
        replies = await asked(rig, file=str(path), seconds=14.0)
        ended = replies[-1]
        assert ended["state"] == "done"
        assert ended["file"] == str(path)
        assert 14.0 <= ended["seconds"] < 16.0
        assert ended["bytes"] > 100_000
        assert ended["lost"] == 0
        assert len(replies) > 20
        assert rig.service.status()["recording"]["file"] is None
        # Until somebody stops it, and one at a time.
        running = asyncio.create_task(asked(rig))
        await asyncio.sleep(2.2)
        status = rig.service.status()["recording"]["file"]
        assert status["seconds"] == pytest.approx(2.2, abs=0.1)
        with pytest.raises(StorageError, match=r"already recording to .*kept-001\.mcap; end it with"):
            await asked(rig, file=str(tmp_path / "other.mcap"))
        (stopped,) = await asked(rig, stop=True)
        assert (await running)[-1]["file"] == stopped["file"] == str(tmp_path / "recordings" / "kept-001.mcap")
        with pytest.raises(StorageError, match="nothing is being recorded"):
            await asked(rig, stop=True)
        # With a length, so that one that is not refused ends.
        for refused, words in (
            ({"file": str(path), "seconds": 5.0}, "exists already"),
            (
                {"file": str(absent), "seconds": 5.0},
                f"{absent}: recording cannot be created: there is no folder {absent.parent}",
            ),
        ):
            with pytest.raises(StorageError, match=words):
                await asked(rig, **refused)
        assert not (tmp_path / "nowhere").exists()
    result = replay([path])
    assert result.calibrations == []
    assert result.seconds == pytest.approx(14.5, abs=1.0)


@pytest.mark.parametrize(("seconds", "state"), [(None, "done"), (60.0, "failed")])
async def test_a_recording_leaves_a_tenth_of_the_disk_free(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, seconds: float | None, state: str
) -> None:
    free = 11 << 30
    monkeypatch.setattr(shutil, "disk_usage", lambda path: SimpleNamespace(total=100 << 30, free=free))
    async with asyncio.timeout(300.0), Rig(tmp_path).running() as rig:
        running = asyncio.create_task(asked(rig, file=str(tmp_path / "mine.mcap"), seconds=seconds))
        await asyncio.sleep(5.0)
        assert not running.done()
        free = 9 << 30
        ended = (await running)[-1]
        with pytest.raises(StorageError, match=r"other\.mcap: recording cannot be created: less than 10 % of the disk"):
            await asked(rig, file=str(tmp_path / "other.mcap"), seconds=5.0)
    assert not (tmp_path / "other.mcap").exists()
    reason = "less than 10 % of the disk free (9.7 of 107.4 GB)"
    assert (ended["state"], ended["reason"]) == (state, reason)
    assert replay([tmp_path / "mine.mcap"]).cut_short is None


# --- the command line


def test_a_recording_of_an_older_version_names_the_version_that_reads_it(
    usual: tuple[Path, Record], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for other in (b"3", b"5"):
        path = tmp_path / "other.mcap"
        path.write_bytes(usual[0].read_bytes().replace(b"format\x01\x00\x00\x004", b"format\x01\x00\x00\x00" + other))
        for command in ("replay", "profile"):
            assert companion(["log", command, str(path)]) == 1
            said = capsys.readouterr().err
            assert f"found recording format {other.decode()}; allowed: 4; companion 0." in said
            assert said.count("\n") == 1


def test_the_command_ends_with_0_when_biases_agree_and_with_1_when_they_do_not(
    usual: tuple[Path, Record], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, kept = usual
    assert companion(["log", "replay", str(path), "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["state"] == "done"
    (one,) = answer["calibrations"]
    assert one["record"]["imus"][1]["gyro_bias_rad_s"] == pytest.approx(kept.imus[1].gyro_bias_rad_s, rel=1e-6)
    assert companion(["log", "replay", str(path)]) == 0
    assert "1 of 1 calibrations recomputed; biases within 0.01 sigma (at most " in capsys.readouterr().out
    other = to_json(msgspec.structs.replace(kept, imus=(kept.imus[1],)))
    other = other.replace(b'"gyro_bias_rad_s":[', b'"gyro_bias_rad_s":[1')
    nudged = rewritten(path, tmp_path / "o.mcap", lambda topic, data: other if topic == messages.RECORD else data)
    assert companion(["log", "replay", str(nudged)]) == 1
    assert "DIFFERENT imus[own].gyro_bias_rad_s[0]: recorded" in capsys.readouterr().out

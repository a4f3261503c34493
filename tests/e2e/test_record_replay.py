"""Recording a whole calibration and replaying it: the same record to the last bit, from any cut, read by others too."""

from __future__ import annotations

import asyncio
import json
import logging
import random
import re
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import IO, Any

import jsonschema
import msgspec
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from companion.autopilot.vehicle.vehicle import ArmState
from companion.calibration.records.record import Record
from companion.calibration.request import What
from companion.cli import main as companion
from companion.config.sections import Config, Noise
from companion.daemon.recorder import recorder as recorder_module
from companion.errors import StorageError
from companion.formats import Object
from companion.recording import topics
from companion.recording.files import Ring, versions
from companion.recording.walk import MAGIC, Message, Recording
from companion.replay import engine
from companion.replay.engine import Replay, Result
from sim.imu_model import DEG_H
from tests.e2e.test_calibration import calibrated
from tests.e2e.test_dither import CASE_A, UNDITHERED, second_imu_only
from tests.support.rig import Rig
from tests.support.virtual_time import run_virtual

LAYOUT = Path(__file__).parents[2] / "docs/recording/foxglove_layout.json"


def ring(folder: Path) -> list[Path]:
    return sorted((folder / "recordings").glob("0*.mcap"))


def replayed(path: Path) -> Result:
    return Replay(Recording(path)).run()


def record(folder: Path, during: Callable[[Rig], Any] | None = None, **options: Any) -> tuple[list[Path], list[Record]]:
    """A calibration from power-on: the ring's files, and the records that the daemon itself kept, oldest first."""

    async def main() -> list[Record]:
        async with Rig(folder, recordings_mb=64, **options).running() as rig:
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


def same(result: Result, records: list[Record]) -> None:
    assert [str(difference) for each in result.calibrations for difference in each.differences] == []
    assert len(result.calibrations) == len(records)
    equal = [each.record == record for each, record in zip(result.calibrations, records, strict=True)]
    assert all(equal)  # pytest would take minutes to show how two records differ
    assert [each.not_recomputed for each in result.calibrations] == [None] * len(records)


# --- the round trip


def test_a_saved_profile_goes_along_with_the_recording(tmp_path: Path) -> None:
    """Where the replay runs nobody has that profile; its sigmas are of its figures, not of the cautious ones."""

    async def main() -> list[Record]:
        made = Rig(tmp_path, recordings_mb=64, min_still_s=5.0, max_s=6.0)
        learned = Noise(name="mine", gyro=(3.5e-5, 2e-3, 1e-6), accel=(5e-4, 0.05, 1e-5))
        (fc, *others) = made.config.imu
        made.config = msgspec.structs.replace(made.config, imu=[msgspec.structs.replace(fc, profile=learned), *others])
        async with made.running() as rig:
            await rig.ready()
            result, _ = await calibrated(rig)
            assert result.outcome == "done", result
            await asyncio.sleep(2.5)
        return rig.service.calibrating.store.history()[::-1]

    records = run_virtual(main())
    # A flicker of 2 mrad/s is far above every other profile's.
    assert min(records[0].imus[0].gyro_sigma_use_rad_s or (0.0,)) > 2e-3
    same(replayed(ring(tmp_path)[0]), records)


def test_a_replay_gives_the_record_to_the_last_bit(usual: tuple[Path, Record]) -> None:
    path, kept = usual
    result = replayed(path)
    same(result, [kept])
    assert {imu.name for imu in result.calibrations[0].record.imus} == {"fc", "own"}
    assert result.cut_short is None
    assert result.notes == []
    assert result.seconds > 15.0


def one_compass_for_both(rig: Rig) -> None:
    """The compass' own tilt in the gradienter's place: one device, one port, two sections."""
    assert rig.config.gradienter is not None
    assert rig.config.compass is not None
    tilt = msgspec.structs.replace(
        rig.config.gradienter, port=rig.config.compass.port, protocol="hmr3300", law="euler", sigma_deg=None
    )
    rig.config = msgspec.structs.replace(rig.config, gradienter=tilt)
    rig.devices["gradienter"] = rig.devices.pop("compass")


def test_a_replay_knows_who_shares_a_port(tmp_path: Path) -> None:
    async def main() -> list[Record]:
        rig = Rig(tmp_path, recordings_mb=64, own_imu=True, min_still_s=5.0, max_s=6.0)
        one_compass_for_both(rig)
        async with rig.running():
            await rig.ready()
            result, _ = await calibrated(rig)
            assert result.outcome == "done", result
            await asyncio.sleep(2.5)
        assert [sensor.name for sensor in rig.service.devices.sensors] == ["own", "gradienter"]
        return rig.service.calibrating.store.history()

    records = run_virtual(main())
    path = ring(tmp_path)[0]  # behind the record the next one begins
    result = replayed(path)
    same(result, records)
    assert result.notes == []
    pose = records[0].pose
    assert pose is not None
    assert None not in (pose.theta_deg, pose.psi_deg)
    # 0.64 deg of tilt are 11 mg, and its own noise is more than that of a gradienter.
    assert any("accel fc is known to 12 mg only" in words for imu in records[0].imus for words in imu.warnings)
    with path.open("rb") as file:
        topics_seen = {channel.topic for channel in make_reader(file).get_summary().channels.values()}  # type: ignore[union-attr]
    assert "/serial/gradienter" in topics_seen
    assert "/serial/compass" not in topics_seen


def test_a_device_that_restarts_in_the_middle_is_replayed_alike_from_any_part(tmp_path: Path) -> None:
    """Its clock begins anew; the second file of the ring begins with the clock's mapping as it was."""

    async def during(rig: Rig) -> None:
        for _ in range(2):
            result, _ = await calibrated(rig)
            assert result.outcome == "done", result
            rig.devices["own"].power_on(rig.aircraft.time_at(rig.now_s))
            await asyncio.sleep(1.0)
            clock = rig.service.devices.sensors[0].decoder.times.clock
        assert clock.restarts == 2
        result, _ = await calibrated(rig)
        assert result.outcome == "done", result

    # Reads that lie across the ends of seconds: to which one a sample belongs is the clock's word.
    paths, records = record(tmp_path, during, own_imu=True, min_still_s=5.0, max_s=6.0, feed_s=0.07)
    assert len(records) == 3
    assert len(paths) >= 3
    for path, kept in zip(paths, records, strict=False):
        same(replayed(path), [kept])


def test_any_bit_of_the_record_that_is_not_recomputed_alike_is_named(
    usual: tuple[Path, Record], tmp_path: Path
) -> None:
    path, kept = usual
    bias = kept.imus[0].gyro_bias_rad_s
    assert bias is not None
    nudged = (bias[0], float(np.nextafter(bias[1], 1.0)), bias[2])
    other = msgspec.structs.replace(
        kept, imus=(msgspec.structs.replace(kept.imus[0], gyro_bias_rad_s=nudged), *kept.imus[1:])
    )

    def change(topic: str, data: bytes) -> bytes:
        return topics.record_json(other, 1000.0) if topic == topics.RECORD else data

    result = replayed(rewritten(path, tmp_path / "nudged.mcap", change))
    (found,) = result.calibrations[0].differences
    assert found.field == "imus[fc].gyro_bias_rad_s[1]"
    assert (found.recorded, found.replayed) == (nudged[1], bias[1])
    assert found.sigmas is not None
    assert 0.0 < found.sigmas < 1e-9


@pytest.mark.parametrize("topic", ["/serial/own", "/serial/gradienter", "/serial/compass", "/mavlink/in"])
def test_every_port_s_bytes_are_what_the_replay_computes_from(
    usual: tuple[Path, Record], tmp_path: Path, topic: str
) -> None:
    """A replay that took samples instead of bytes would not notice that the bytes have gone."""
    path, _ = usual
    count = 0

    def change(where: str, data: bytes) -> bytes | None:
        nonlocal count
        count += where == topic
        return None if where == topic and count % 3 == 0 else data

    result = replayed(rewritten(path, tmp_path / "holes.mcap", change))
    assert result.calibrations[0].differences or result.notes


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
                channels[channel.topic] = writer.register_channel(channel.topic, "json", 0)
            writer.add_message(channels[channel.topic], message.log_time, data, message.publish_time)
        writer.finish()
    return to


@pytest.mark.parametrize(
    "options",
    [
        {"firmware": "px4", "seed": 3},
        {"loss": 0.05, "duplicate": 0.05, "own_imu": True, "seed": 4},
        {"law": "euler", "vehicle": "plane", "seed": 5},
    ],
    ids=["px4", "a bad link", "plane"],
)
def test_it_is_the_same_whatever_the_vehicle_and_the_link(tmp_path: Path, options: dict[str, Any]) -> None:
    paths, records = record(tmp_path, min_still_s=5.0, max_s=8.0, **options)
    same(replayed(paths[0]), records)


def test_a_recording_may_begin_in_the_middle_of_a_calibration(tmp_path: Path) -> None:
    async def during(rig: Rig) -> None:
        job = rig.service.calibrating.conductor.start_calibration(What.BOTH, "test")
        assert not hasattr(job, "code"), job
        for _ in range(4):
            await asyncio.sleep(5.37)
            rig.service.recorder._part_ends = True
        await rig.until(lambda: not rig.service.calibrating.conductor.state.busy, 60.0)

    paths, records = record(tmp_path, during, own_imu=True, seed=7)
    assert len(paths) > 4
    results = [replayed(path) for path in paths]
    ended = [result for result in results if result.calibrations]
    assert len(ended) == 1
    same(ended[0], records)


def test_a_recording_holds_what_a_calibration_after_a_long_stand_needs(tmp_path: Path) -> None:
    """The daemon has been running for longer than the 75 seconds that a recording begins with."""

    async def during(rig: Rig) -> None:
        for _ in range(2):
            await asyncio.sleep(100.0)
            rig.service.recorder._part_ends = True
            await asyncio.sleep(1.7)
            result, _ = await calibrated(rig)
            assert result.outcome == "done", result

    paths, records = record(tmp_path, during, own_imu=True, seed=8, min_still_s=5.0, max_s=10.0, feed_s=0.07)
    results = [replayed(path) for path in paths]
    again = [each for result in results for each in result.calibrations]
    assert [str(difference) for each in again for difference in each.differences] == []
    assert [each.record for each in again] == records
    assert [result.notes for result in results] == [[]] * len(results)
    assert max(result.seconds for result in results) < 140.0


def test_moved_armed_and_twice(tmp_path: Path) -> None:
    """What resets the collector in between is replayed in its place."""

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
            result, _ = await calibrated(rig)
            assert result.outcome == "done", result

    paths, records = record(tmp_path, during, own_imu=True, min_still_s=5.0, max_s=8.0)
    assert len(records) == 2
    found = [replayed(path) for path in paths]
    assert [each.record for result in found for each in result.calibrations] == records
    assert not [difference for result in found for each in result.calibrations for difference in each.differences]


def test_a_calibration_that_fails_before_anything_is_known_replays_as_it_was(tmp_path: Path) -> None:
    async def during(rig: Rig) -> None:
        rig.unplugged.add("gradienter")
        result, _ = await calibrated(rig, timeout_s=8.0)
        assert result.outcome == "failed"

    paths, records = record(tmp_path, during)
    (again,) = replayed(paths[0]).calibrations
    assert again.record == records[0]
    assert again.not_recomputed == "it ended before anything was worked out"


def test_means_found_by_a_dither_are_taken_over(tmp_path: Path) -> None:
    async def main() -> None:
        rig = second_imu_only(tmp_path, UNDITHERED, dither=True, max_s=10.0)
        rig.config = msgspec.structs.replace(
            rig.config, storage=msgspec.structs.replace(rig.config.storage, recordings_mb=64)
        )
        async with rig.running():
            await rig.until(lambda: rig.service.devices.imus["second"].calibration is not None, 15.0)
            result, kept = await calibrated(rig)
            assert result.outcome == "done", result
            assert any("dithered" in warning for warning in kept.imus[0].warnings)
            off = np.subtract(kept.imus[0].gyro_bias_rad_s or (), np.array(CASE_A[0]) * DEG_H)
            assert np.abs(off).max() < 40.0 * DEG_H
            await asyncio.sleep(1.5)

    run_virtual(main())
    found = [each for path in ring(tmp_path) for each in replayed(path).calibrations]
    assert [each.differences for each in found] == [[]]
    assert [each.not_recomputed for each in found] == [None]


def test_without_a_calibration_in_it_a_recording_gives_the_estimate_of_its_end(tmp_path: Path) -> None:
    async def during(rig: Rig) -> None:
        await asyncio.sleep(25.0)

    paths, _ = record(tmp_path, during, own_imu=True)
    result = replayed(paths[0])
    assert result.calibrations == []
    assert result.estimate is not None
    assert result.estimate.state == "done"
    assert result.estimate.site is not None
    assert result.estimate.site.latitude_deg == pytest.approx(40.0, abs=1e-3)
    fc = result.estimate.imus[0]
    assert fc.gyro_bias_rad_s is not None
    assert fc.gyro_sigma_use_rad_s is not None
    off = np.abs(np.subtract(fc.gyro_bias_rad_s, np.array([162.234, 169.563, -98.289]) * DEG_H))
    assert (off / fc.gyro_sigma_use_rad_s).max() < 4.0


# --- cut anywhere


def test_a_power_cut_costs_a_second(usual: tuple[Path, Record]) -> None:
    with usual[0].open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    spans = [(chunk.message_end_time - chunk.message_start_time) / 1e9 for chunk in summary.chunk_indexes]
    assert len(spans) > 15
    assert max(spans) < 1.2


def test_cut_at_any_byte_it_is_read_up_to_the_cut(usual: tuple[Path, Record], tmp_path: Path) -> None:
    data = usual[0].read_bytes()
    whole = [(item.topic, item.data) for item in Recording(usual[0]) if isinstance(item, Message)]
    with usual[0].open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    ends = [(chunk.chunk_start_offset + chunk.chunk_length) for chunk in summary.chunk_indexes]
    rng = random.Random(11)
    cuts = [*range(1, 40), *(rng.randrange(len(data)) for _ in range(40)), *ends[:3], len(data) - 1]
    path = tmp_path / "cut.mcap"
    before = 0
    for cut in sorted(cuts):
        path.write_bytes(data[:cut])
        recording = Recording(path)
        found = [(item.topic, item.data) for item in recording if isinstance(item, Message)]
        assert (found == whole[: len(found)]) is True
        assert len(found) >= before
        before = len(found)
        if cut <= ends[-1]:
            assert recording.cut_short, cut
        assert bool(found) == (cut >= ends[0]), "every whole chunk is read"
    assert before == len(whole)
    # A power cut may also leave zeros where data should be, or garbage.
    path.write_bytes(data[: ends[5]] + bytes(5000))
    zeros = Recording(path)
    assert [item for item in zeros if isinstance(item, Message)]
    assert zeros.cut_short == f"nothing but zeros from byte {ends[5] + 9} on"
    path.write_bytes(data[: ends[5]] + data[ends[5] : ends[6]][:-50] + rng.randbytes(50) + data[ends[6] :])
    garbled = Recording(path)
    assert len([item for item in garbled if isinstance(item, Message)]) < len(whole)


def test_cut_at_any_byte_it_replays_up_to_the_cut(usual: tuple[Path, Record], tmp_path: Path) -> None:
    path, kept = usual
    data, rng = path.read_bytes(), random.Random(12)
    with path.open("rb") as file:
        recorded = next(
            message.log_time
            for _, channel, message in make_reader(file).iter_messages()
            if channel.topic == topics.RECORD
        )
        file.seek(0)
        summary = make_reader(file).get_summary()
    assert summary is not None
    holds = next(c for c in summary.chunk_indexes if c.message_start_time <= recorded <= c.message_end_time)
    after = holds.chunk_start_offset + holds.chunk_length
    begun = summary.chunk_indexes[0].chunk_start_offset + summary.chunk_indexes[0].chunk_length  # START is in it
    cut_path = tmp_path / "cut.mcap"
    for cut in [
        1,
        len(MAGIC),
        60,
        *(rng.randrange(begun, after) for _ in range(8)),
        *(rng.randrange(after, len(data)) for _ in range(3)),
    ]:
        cut_path.write_bytes(data[:cut])
        if cut < 100:
            with pytest.raises(StorageError, match=r"cut .*, before anything was recorded; nothing to replay"):
                replayed(cut_path)
            continue
        result = replayed(cut_path)
        if cut >= after:
            same(result, [kept])
        else:
            assert result.calibrations == []
            assert result.estimate is not None
            assert result.cut_short is not None


def test_a_damaged_recording_is_one_line_or_a_replay_and_never_anything_else(
    usual: tuple[Path, Record], tmp_path: Path
) -> None:
    """Without checksums, so that the damage gets as far as it can."""
    plain = rewritten(
        usual[0],
        tmp_path / "plain.mcap",
        lambda topic, data: data,
        compression=CompressionType.NONE,
        enable_crcs=False,
        chunk_size=20_000,
    )
    whole, rng = plain.read_bytes(), random.Random(13)
    state = whole.index(b'"event":"imu"')
    journal = whole.index(b'"event":"tick"')
    path = tmp_path / "damaged.mcap"
    refused: list[str] = []
    for attempt in range(30):
        data = bytearray(whole[:500_000])
        # What is in force and the journal are a small part of a file, and the part that is read by hand.
        begin, end = ((state, state + 5000), (journal - 2000, journal + 2000), (0, len(data)))[attempt % 3]
        for _ in range(1 + attempt // 4):
            data[rng.randrange(begin, end)] = rng.randrange(256)
        path.write_bytes(data)
        try:
            replayed(path)
        except StorageError as error:
            refused.append(str(error))
    assert 3 < len(refused) < 30
    assert not any("\n" in words for words in refused)


# --- what others read


def test_the_independent_reader_finds_every_message_as_its_schema_says(usual: tuple[Path, Record]) -> None:
    path, kept = usual
    validators: dict[str, Any] = {}
    count: dict[str, int] = {}
    latest: dict[str, Any] = {}
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file, validate_crcs=True).iter_messages():
            assert schema is not None
            assert (schema.encoding, channel.message_encoding) == ("jsonschema", "json")
            if schema.name not in validators:
                text = json.loads(schema.data)
                jsonschema.Draft202012Validator.check_schema(text)
                foxglove_takes(text)
                validators[schema.name] = jsonschema.Draft202012Validator(text)
            value = json.loads(message.data)
            validators[schema.name].validate(value)
            count[channel.topic] = count.get(channel.topic, 0) + 1
            latest[channel.topic] = value
            assert message.log_time > 1.6e18, "UTC"
            if channel.topic == topics.RECORD:
                assert msgspec.json.decode(value["record"], type=Record) == kept
        file.seek(0)
        (metadata,) = make_reader(file).iter_metadata()
        file.seek(0)
        (attachment,) = make_reader(file).iter_attachments()
    assert metadata.name == "companion"
    assert {"companion", "numpy", "python", "machine", "format"} <= set(metadata.metadata)
    config = msgspec.json.decode(attachment.data, type=Config)
    assert [imu.name for imu in config.imu] == ["fc", "own"]
    assert set(count) == {
        *("/serial/own", "/serial/gradienter", "/serial/compass", "/mavlink/in", "/mavlink/out"),
        *("/imu/fc", "/imu/own", "/gradienter", "/compass"),
        *("/companion/start", "/companion/journal", "/companion/record"),
    }
    for topic, name, index in layout_paths():
        assert topic in latest, "the layout for Foxglove shows what is there"
        found: Any = latest[topic].get(name) if name else 0.0
        is_unknown = found is None and name == "temperature_degc"  # not every sensor tells it
        assert is_unknown or isinstance(found if index is None else found[index], float | int), (topic, name, index)
    assert count["/imu/own"] > 200 * 10
    assert count["/imu/fc"] > 100 * 5


def layout_paths() -> list[tuple[str, str, int | None]]:
    """What the panels of our layout for Foxglove show: topic, field (mostly), index (sometimes).

    Read by the rules of its message paths (packages/message-path/src/grammar.ne in Lichtblick, its open source form).
    """
    panels = json.loads(LAYOUT.read_text())["configById"].values()
    paths = [
        path for panel in panels for path in (panel.get("topicPath"), *(one["value"] for one in panel.get("paths", ())))
    ]
    found = [PATH.fullmatch(path) for path in paths if path]
    assert found
    assert None not in found
    return [(one[1], one[2] or "", int(one[3]) if one[3] else None) for one in found if one is not None]


PATH = re.compile(r"((?:/[\w-]*)+)(?:\.([\w-]+)(?:\[(\d+)\])?)?", re.ASCII)
TITLES = {"foxglovePanelTitle", "lichtblickPanelTitle"}
PANELS = {
    # PlotConfig and PlotPath of packages/suite-base/src/panels/Plot/utils/config.ts: what they must have.
    "Plot": {
        *("paths", "showLegend", "legendDisplay", "showPlotValuesInLegend", "showXAxisLabels", "showYAxisLabels"),
        *("isSynced", "xAxisVal", "sidebarDimension"),
    },
    # RawMessagesPanelConfig of panels/RawMessages/types.ts.
    "RawMessages": {"diffEnabled", "diffMethod", "diffTopicPath", "showFullMessageForDiff", "topicPath"},
}


def test_the_layout_for_foxglove_has_its_form() -> None:
    """As far as its open source form says: no Foxglove is here to open it."""
    layout = json.loads(LAYOUT.read_text())
    # LayoutData of context/CurrentLayoutContext/actions.ts; a node is a panel's id, or two nodes (react-mosaic).
    assert set(layout) == {"configById", "globalVariables", "userNodes", "playbackConfig", "layout"}

    def panels(node: Any) -> list[str]:
        if isinstance(node, str):
            return [node]
        assert set(node) == {"direction", "first", "second", "splitPercentage"}
        assert node["direction"] in ("row", "column")
        return [*panels(node["first"]), *panels(node["second"])]

    assert sorted(panels(layout["layout"])) == sorted(layout["configById"]), "every panel once"
    for name, panel in layout["configById"].items():
        wanted = PANELS[name.partition("!")[0]]
        assert panel.keys() - TITLES == wanted
        for path in panel.get("paths", ()):
            assert path.keys() - {"label"} == {"value", "enabled", "timestampMethod"}
            assert (path["timestampMethod"], panel["xAxisVal"], panel["legendDisplay"]) == (
                "receiveTime", "timestamp", "floating",
            )  # fmt: skip


def foxglove_takes(schema: dict[str, Any]) -> None:
    """Its viewers' rule: one plain type a field, no array in an array, objects with their properties."""
    assert schema["type"] == "object"
    for field in schema["properties"].values():
        inner = field["items"] if field["type"] == "array" else field
        assert inner["type"] in ("boolean", "string", "number", "integer", "object")
        assert inner.get("contentEncoding") in (None, "base64")
        if inner["type"] == "object":
            foxglove_takes(inner)


# --- on request


async def asked(rig: Rig, **request: Any) -> list[Object]:
    return [reply async for reply in rig.service.faces.answer({"command": "record", **request})]


def test_recording_on_request(tmp_path: Path) -> None:
    path, absent = tmp_path / "mine.mcap", tmp_path / "nowhere" / "at" / "all.mcap"

    async def main() -> None:
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
                ({"file": str(absent), "seconds": 5.0}, f"{absent}: there is no folder {absent.parent}; make it"),
                ({"seconds": "x"}, "not understood"),
            ):
                with pytest.raises(StorageError, match=words):
                    await asked(rig, **refused)
            assert not (tmp_path / "nowhere").exists()

    run_virtual(main())
    result = replayed(path)
    assert result.estimate is not None
    assert result.estimate.state == "done"
    assert result.seconds == pytest.approx(14.5, abs=1.0)


def test_recording_on_request_ends_with_the_daemon_in_order(tmp_path: Path) -> None:
    path = tmp_path / "mine.mcap"

    async def main() -> list[Object]:
        async with Rig(tmp_path).running() as rig:
            running = asyncio.create_task(asked(rig, file=str(path)))
            await asyncio.sleep(4.7)
        return await running

    assert run_virtual(main())[-1]["reason"] == "the daemon stopped"
    assert replayed(path).cut_short is None


def test_a_recording_without_a_length_ends_at_its_size_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recorder_module, "MOST_OPEN_END_BYTES", 1 << 17)

    async def main() -> list[Object]:
        async with asyncio.timeout(300.0), Rig(tmp_path, own_imu=True).running() as rig:
            return await asked(rig, file=str(tmp_path / "mine.mcap"))

    began, *_, ended = run_virtual(main())
    assert began["text"].endswith("; ends at 0 GB")
    assert (ended["state"], ended["reason"]) == ("done", "ended at 0 GB, its size limit")
    assert 1 << 17 <= ended["bytes"] < 1 << 18
    assert ended["most_bytes"] == 1 << 17
    assert replayed(tmp_path / "mine.mcap").cut_short is None


@pytest.mark.parametrize(("seconds", "state"), [(None, "done"), (60.0, "failed")])
def test_a_recording_leaves_a_tenth_of_the_disk_free(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, seconds: float | None, state: str
) -> None:
    free = 11 << 30
    monkeypatch.setattr(shutil, "disk_usage", lambda path: SimpleNamespace(total=100 << 30, free=free))

    async def main() -> Object:
        nonlocal free
        async with asyncio.timeout(300.0), Rig(tmp_path).running() as rig:
            running = asyncio.create_task(asked(rig, file=str(tmp_path / "mine.mcap"), seconds=seconds))
            await asyncio.sleep(5.0)
            assert not running.done()
            free = 9 << 30
            ended = (await running)[-1]
            with pytest.raises(StorageError, match=r"other\.mcap: not recorded, with less than 10 % of the disk free"):
                await asked(rig, file=str(tmp_path / "other.mcap"), seconds=5.0)
        assert not (tmp_path / "other.mcap").exists()
        return ended

    ended = run_virtual(main())
    reason = "ended with less than 10 % of the disk free (9.7 of 107.4 GB)"
    assert (ended["state"], ended["reason"]) == (state, reason)
    assert replayed(tmp_path / "mine.mcap").cut_short is None


# --- what goes wrong


def full(path: Path) -> IO[bytes]:
    return Path("/dev/full").open("wb")


def test_a_full_disk_disturbs_nothing_is_said_once_and_ends_by_itself(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recorder_module, "RETRY_S", 10.0)

    async def main() -> None:
        async with Rig(tmp_path, recordings_mb=16).running() as rig:
            recorder = rig.service.recorder
            recorder._ring = Ring(tmp_path / "recordings", 16 << 20, full)
            await rig.ready()
            result, _ = await calibrated(rig)
            assert result.outcome == "done"
            await asyncio.sleep(4 * recorder_module.RETRY_S)
            fault = rig.service.status()["recording"]["fault"]
            assert "No space left on device" in fault
            assert len(rig.service.core.collector.journal.items) < 1000
            recorder._ring = Ring(tmp_path / "recordings", 16 << 20)
            await asyncio.sleep(1.2 * recorder_module.RETRY_S)
            assert rig.service.status()["recording"]["fault"] is None

    with caplog.at_level(logging.INFO):
        run_virtual(main())
    said = [entry for entry in caplog.records if "recordings:" in entry.message and entry.levelno >= logging.WARNING]
    assert len(said) == 1
    assert "No space left on device" in said[0].message
    assert any("written again" in entry.message for entry in caplog.records)
    assert replayed(ring(tmp_path)[-1]).estimate is not None


def test_a_disk_that_hangs_holds_nothing_up_and_the_hole_is_in_the_file(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    hangs_s = 0.0

    async def offload(function: Callable[..., Any], *arguments: Any) -> Any:
        if function.__qualname__ == "Ring.write":
            await asyncio.sleep(hangs_s)
        return function(*arguments)

    async def main() -> list[Record]:
        nonlocal hangs_s
        rig = Rig(tmp_path, recordings_mb=16, own_imu=True, min_still_s=5.0, max_s=6.0)
        rig.offload = offload
        async with rig.running():
            await rig.ready()
            hangs_s, most = 40.0, 0
            try:
                result, during = await calibrated(rig)
                for _ in range(30):
                    await asyncio.sleep(1.0)
                    most = max(most, len(rig.service.core.collector.journal.items))
            finally:
                hangs_s = 0.0  # the daemon's end waits for the disk
            assert result.outcome == "done"
            assert during.duration_s < 30.0  # some 25, and not 40 more
            assert most <= 12_000
            await asyncio.sleep(50.0)
            lost = rig.service.status()["recording"]["lost"]
            assert lost > 12_000
            result, after = await calibrated(rig)
            assert result.outcome == "done"
            await asyncio.sleep(2.0)
        return [during, after]

    _, after = run_virtual(main())
    assert len([entry for entry in caplog.records if "the disk is too slow" in entry.message]) == 1
    results = [replayed(path) for path in ring(tmp_path)]
    assert any("messages were lost" in note for result in results for note in result.notes)
    same(next(result for result in results if result.calibrations and result.calibrations[-1].record == after), [after])


@pytest.mark.parametrize(("megabytes", "said"), [(None, 0), (0, 0), (64, 1)])
def test_without_the_means_the_daemon_runs_and_says_so_only_where_recordings_were_asked_for(
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
    megabytes: int | None,
    said: int,
) -> None:
    monkeypatch.setattr(recorder_module, "is_available", lambda: False)

    async def main() -> None:
        rig = Rig(tmp_path)
        storage = msgspec.structs.replace(rig.config.storage, recordings_mb=megabytes)
        rig.config = msgspec.structs.replace(rig.config, storage=storage)
        async with rig.running():
            await rig.ready()
            with pytest.raises(StorageError, match=r"pip install '\.\[recording\]'"):
                await asked(rig)

    run_virtual(main())
    assert len([entry for entry in caplog.records if "'.[recording]'" in entry.message]) == said
    assert not (tmp_path / "recordings").exists()


def test_the_ring_is_on_unless_switched_off(tmp_path: Path) -> None:
    async def main() -> None:
        rig = Rig(tmp_path)
        storage = msgspec.structs.replace(rig.config.storage, recordings_mb=None)
        rig.config = msgspec.structs.replace(rig.config, storage=storage)
        async with rig.running():
            await asyncio.sleep(3.0)
            assert rig.service.status()["recording"]["ring"]["most_bytes"] == 64 << 20

    run_virtual(main())
    assert len(ring(tmp_path)) == 1


def test_a_fault_of_the_recorder_s_own_does_not_take_the_daemon_along(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def main() -> None:
        async with Rig(tmp_path, recordings_mb=16).running() as rig:
            running = asyncio.create_task(asked(rig, file=str(tmp_path / "mine.mcap")))
            await asyncio.sleep(2.0)
            monkeypatch.setattr(rig.service.recorder._around, "update", lambda journal: 1 / 0)
            await rig.ready()
            result, _ = await calibrated(rig)
            assert result.outcome == "done"
            assert (await running)[-1]["state"] == "failed"
            assert "internal error" in rig.service.status()["recording"]["fault"]

    run_virtual(main())
    assert len([entry for entry in caplog.records if entry.levelno == logging.ERROR]) == 1


def test_another_version_is_named_and_another_format_refused(
    usual: tuple[Path, Record], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ours = versions()
    monkeypatch.setattr(engine, "versions", lambda: {**ours, "numpy": "99.0", "machine": "pdp11"})
    (note,) = replayed(usual[0]).notes
    assert f"numpy {ours['numpy']}, here 99.0" in note
    assert "pdp11: the last digits may differ" in note
    for other in (b"2", b"4"):
        path = tmp_path / "other.mcap"
        path.write_bytes(usual[0].read_bytes().replace(b"format\x01\x00\x00\x003", b"format\x01\x00\x00\x00" + other))
        with pytest.raises(StorageError, match=f"found format {other.decode()}; allowed: 3 .recorded by companion"):
            replayed(path)


# --- the command line


def test_without_the_means_a_replay_says_what_to_install(
    usual: tuple[Path, Record], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "zstandard", None)
    assert companion(["replay", str(usual[0])]) == 1
    assert "pip install '.[recording]'" in capsys.readouterr().err


def test_the_command_says_the_same_and_ends_with_0(
    usual: tuple[Path, Record], capsys: pytest.CaptureFixture[str]
) -> None:
    assert companion(["replay", str(usual[0]), "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["state"] == "done"
    assert answer["calibrations"][0]["record"] == msgspec.to_builtins(usual[1], str_keys=True) | {
        "warnings": list(usual[1].warnings),
        "armings": [],
        "imus": json.loads(msgspec.json.encode(usual[1].imus)),
        "cross_covariance": json.loads(msgspec.json.encode(usual[1].cross_covariance)),
    }
    assert companion(["replay", str(usual[0])]) == 0
    assert "1 of 1 calibrations recomputed, the same to the last bit" in capsys.readouterr().out


def test_a_difference_ends_the_command_with_1(
    usual: tuple[Path, Record], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = msgspec.structs.replace(usual[1], imus=usual[1].imus[:1])

    def change(topic: str, data: bytes) -> bytes:
        return topics.record_json(other, 1000.0) if topic == topics.RECORD else data

    path = rewritten(usual[0], tmp_path / "o.mcap", change)
    assert companion(["replay", str(path)]) == 1
    assert "DIFFERENT imus: recorded" in capsys.readouterr().out


@pytest.mark.parametrize(("content", "code"), [(b"", 1), (MAGIC[:3], 1), (MAGIC, 1), (b"\x7fELF\0\0\0\0", 1)])
def test_nothing_to_replay_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], content: bytes, code: int
) -> None:
    path = tmp_path / "x.mcap"
    path.write_bytes(content)
    assert companion(["replay", str(path)]) == code
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.startswith("companion: ")
    assert said.err.count("\n") == 1
    assert companion(["replay", str(tmp_path / "absent")]) == 2


def test_another_program_s_mcap_file_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "x.mcap"
    with path.open("wb") as file:
        writer: Any = Writer(file)
        writer.start()
        writer.add_message(writer.register_channel("/companion/state", "json", 0), 0, b"{}", 0)
        writer.finish()
    assert companion(["replay", str(path)]) == 1
    assert "an MCAP file, but not a recording of companion; nothing to replay" in capsys.readouterr().err

"""Faults of the companion computer: its disk, clock and power; its files and people."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import json
import shutil
from pathlib import Path
from typing import Any, Literal

from tests.campaign.disk import Refusal
from tests.campaign.fault import Act, Fault, Scene
from tests.campaign.faults_devices import STILLNESS
from tests.campaign.faults_mavlink import LOST
from tests.campaign.witness import vectors

disk_fault = functools.partial(Fault, room="disk")
clock_fault = functools.partial(Fault, room="clock")
process_fault = functools.partial(Fault, room="process")
file_fault = functools.partial(Fault, room="files")
face_fault = functools.partial(Fault, room="faces")

DISK = r"cannot be (written|removed)|not kept|No space|read-only|Read-only|Input/output"

# --- the disk


def refuses(what: Refusal) -> tuple[Act, Act]:
    async def strike(scene: Scene) -> None:
        scene.stage.disk.refuses = what

    async def lift(scene: Scene) -> None:
        scene.stage.disk.refuses = None

    return strike, lift


async def slow(scene: Scene) -> None:
    scene.stage.slow_disk_s = 6.0


async def quick(scene: Scene) -> None:
    scene.stage.slow_disk_s = 0.0


async def remove_folder(scene: Scene) -> None:
    scene.notes["records gone"] = True
    stage = scene.stage
    scene.spoilt.update(str(path.relative_to(stage.store)) for path in stage.store.rglob("*") if path.is_file())
    shutil.rmtree(stage.store, ignore_errors=True)


# --- the clock


def sets_clock(by_s: float | None = None, to_s: float = 0.0) -> Act:
    async def strike(scene: Scene) -> None:
        if by_s is None:
            scene.stage.wall.set_to(to_s)
        else:
            scene.stage.wall.shift_s += by_s

    return strike


async def step_clock(scene: Scene) -> None:
    await sets_clock(by_s=scene.chance.choice((3600.0, -3600.0)))(scene)


async def right_clock(scene: Scene) -> None:
    scene.stage.wall.shift_s = 0.0


# --- the process


async def kill(scene: Scene) -> None:
    await scene.stage.kill()
    await asyncio.sleep(scene.chance.uniform(0.1, 3.0))
    await begin_again(scene)


async def begin_again(scene: Scene) -> None:
    scene.stage.start()
    await asyncio.sleep(0.05)


async def kill_again_and_again(scene: Scene) -> None:
    await kill(scene)
    for _ in range(3):
        await asyncio.sleep(scene.chance.uniform(0.0, 3.0))
        await kill(scene)


async def end_in_order(scene: Scene) -> None:
    await scene.stage.stop()
    scene.stage.wire.unplug()
    await asyncio.sleep(1.0)
    await begin_again(scene)


def power_cut(*, autopilot: bool) -> Act:
    """At a random byte of one of the next writes to the disk; where there is none soon, at that instant."""

    async def strike(scene: Scene) -> None:
        stage = scene.stage
        disk, cut = stage.disk, asyncio.Event()

        def on_cut() -> None:
            stage.die()
            cut.set()

        disk.on_cut = on_cut
        disk.cut_at = disk.operations + scene.chance.randint(1, 5)
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(6.0):
                await cut.wait()
        disk.cut_at = None
        if autopilot:
            stage.autopilot.reboot(down_s=2.0)
        await stage.kill()
        await stage.bury()
        await asyncio.sleep(scene.chance.uniform(0.1, 3.0))
        await begin_again(scene)

    return strike


# --- its files

Harm = Literal["bits", "cut", "zeros", "empty", "newer"]


def harm(path: Path, how: Harm, scene: Scene) -> None:
    data = bytearray(path.read_bytes() if path.exists() else b'{"format_version": 1, "state": "done"}')
    if how == "bits":
        for _ in range(1 + len(data) // 200):
            data[scene.chance.randrange(len(data))] ^= 1 << scene.chance.randrange(8)
    elif how == "cut":
        del data[scene.chance.randrange(len(data)) :]
    elif how == "zeros":
        data = bytearray(len(data))
    elif how == "empty":
        data = bytearray()
    else:
        data = bytearray(json.dumps({"format_version": 99, "format": 99, "what": "nobody knows"}).encode())
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)
    scene.spoilt.add(str(path.relative_to(scene.stage.store)))


def spoils(name: str, how: Harm) -> Act:
    """The daemon dies, the newest file of that name is damaged, the daemon comes back."""

    async def strike(scene: Scene) -> None:
        stage = scene.stage
        await stage.kill()
        stage.store.mkdir(exist_ok=True)
        found = sorted(stage.store.glob(name))
        plain = stage.store / name.replace("??????", "000001").replace("*", "1")
        harm(found[-1] if found else plain, how, scene)
        await begin_again(scene)

    return strike


async def spoil_record(scene: Scene) -> None:
    await spoils("records/??????.json", scene.chance.choice(("cut", "zeros", "empty")))(scene)


async def spoil_undo(scene: Scene) -> None:
    await spoils("undo-*.json", scene.chance.choice(("cut", "zeros", "empty")))(scene)


async def spoil_recording(scene: Scene) -> None:
    await spoils("recordings/*.mcap", scene.chance.choice(("bits", "cut", "zeros", "empty")))(scene)


async def spoil_journal(scene: Scene) -> None:
    # With it goes the knowledge of what an interrupted write had overwritten.
    await spoils("journal.json", scene.chance.choice(("cut", "zeros", "empty")))(scene)
    scene.notes["somebody else"] = "journal"


async def tamper_journal(scene: Scene) -> None:
    """Under the old checksum, or without one: some values are no IMU's."""
    stage = scene.stage
    await stage.kill()
    path = stage.store / "journal.json"
    names = list(vectors(stage))
    if path.exists():
        whole = json.loads(path.read_bytes())
    else:
        now = {name: stage.autopilot.parameter(name) for name in names}
        whole = {"system_id": 1, "changes": [{"parameter": n, "before": v, "after": v} for n, v in now.items()]}
    for change in whole["changes"]:
        change["before"] = scene.chance.choice((9.5, 1e30, change["before"] + 0.01))
    if "sha256" not in whole:
        whole["changes"][0]["before"] = 9.5
    path.write_text(json.dumps(whole))
    scene.notes["somebody else"] = "journal"
    await begin_again(scene)


# --- control socket


async def _hold(scene: Scene, writers: list[asyncio.StreamWriter]) -> None:
    scene.notes.setdefault("writers", []).extend(writers)


async def hang_up(scene: Scene) -> None:
    for writer in scene.notes.pop("writers", []):
        writer.transport.abort()
    await asyncio.sleep(0.1)


async def _control(scene: Scene) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
    return await asyncio.open_unix_connection(str(scene.stage.config.control.path))


async def control_garbage(scene: Scene) -> None:
    for data in (
        b"\0\xff" * 300 + b"\n",
        b"{}\n",
        b"[1, 2]\n",
        b'{"command": 5}\n',
        b'{"command": "calibrate", "what": {"a": 1}}\n',
        b'{"command": "history", "limit": -1e999}\n',
        b'{"command": "record", "file": 7}\n',
        b'{"command": "align", "plan": []}\n',
        b'{"command": "\\ud800"}\n',
        b"[" * 5000 + b"\n",
        b"\n",
    ):
        reader, writer = await _control(scene)
        writer.write(data)
        answer = await asyncio.wait_for(reader.read(1 << 16), 8.0)
        assert json.loads(answer.splitlines()[-1])["kind"] in ("error", "result"), answer
        writer.close()


async def control_half_lines(scene: Scene) -> None:
    writers = []
    for _ in range(12):
        _, writer = await _control(scene)
        writer.write(b'{"command": "sta')
        writers.append(writer)
    await _hold(scene, writers)


async def control_huge_line(scene: Scene) -> None:
    for _ in range(3):
        reader, writer = await _control(scene)
        with contextlib.suppress(ConnectionError):
            for _ in range(160):
                writer.write(b"a" * 65536)
                await writer.drain()
            await asyncio.wait_for(reader.read(100), 8.0)
        writer.transport.abort()


async def control_crowd(scene: Scene) -> None:
    writers = []
    for _ in range(200):
        with contextlib.suppress(OSError):
            _, writer = await _control(scene)
            writers.append(writer)
        if len(writers) % 20 == 0:
            await asyncio.sleep(0.01)
    await _hold(scene, writers)


async def control_deaf(scene: Scene) -> None:
    writers = []
    for request in (b'{"command": "monitor"}\n',) * 3 + (b'{"command": "history"}\n', b'{"command": "status"}\n'):
        reader, writer = await _control(scene)
        writer.transport.pause_reading()  # type: ignore[attr-defined]
        writer.write(request)
        writers.append(writer)
        del reader
    await _hold(scene, writers)


def faults() -> list[Fault]:
    back: dict[str, Any] = {
        "excused": f"{LOST}|{STILLNESS}|companion stops|daemon's end|interrupted|reboot",
        "restarts": True,
    }
    disk: dict[str, Any] = {"excused": DISK, "recordings_mb": 8}
    return [
        disk_fault("disk-full", "no space is left", *refuses("full"), names=DISK, **disk),
        disk_fault("disk-read-only", "the file system has become read-only", *refuses("read-only"), names=DISK, **disk),
        disk_fault("disk-error", "fsync fails: a worn-out card", *refuses("fsync"), names=DISK, **disk),
        disk_fault(
            "disk-slow",
            "every write takes up to 6 s",
            slow,
            quick,
            lasts_s=(6.0, 10.0),
            recordings_mb=8,
            excused=STILLNESS,
        ),
        disk_fault("folder-removed", "somebody removes the state directory", remove_folder, excused=DISK),
        clock_fault("clock-step", "the wall clock is set forward or back by an hour", step_clock),
        clock_fault(
            "clock-1970", "the wall clock is in 1970, and right again later", sets_clock(to_s=5.0), right_clock
        ),
        process_fault("kill", "kill -9, and started again", kill, **back),
        process_fault("kill-again-and-again", "kill -9 four times within seconds", kill_again_and_again, **back),
        process_fault("stop", "stopped in order, and started again", end_in_order, **back),
        process_fault(
            "power-cut",
            "power cut of everything at any byte of a write",
            power_cut(autopilot=True),
            recordings_mb=8,
            **back,
        ),
        process_fault(
            "power-cut-companion",
            "power cut of the companion alone, at any byte of a write",
            power_cut(autopilot=False),
            recordings_mb=8,
            **back,
        ),
        file_fault("record-damaged", "the newest record is damaged", spoil_record, names=r"skipped", **back),
        file_fault(
            "record-newer",
            "the newest record is of a later version",
            spoils("records/??????.json", "newer"),
            names=r"skipped",
            **back,
        ),
        file_fault("undo-damaged", "the values for undo are damaged", spoil_undo, names=r"cannot be used", **back),
        file_fault(
            "journal-damaged",
            "the journal of a write is damaged",
            spoil_journal,
            names=r"cannot be used",
            **back,
        ),
        file_fault(
            "journal-tampered",
            "the journal of a write names values that no IMU has",
            tamper_journal,
            names=r"cannot be used",
            **back,
        ),
        file_fault(
            "alignment-damaged",
            "the gradienter's alignment is damaged",
            spoils("alignment.json", "cut"),
            names=r"cannot be used",
            **back,
        ),
        file_fault("recording-damaged", "the newest recording is damaged", spoil_recording, recordings_mb=8, **back),
        face_fault("control-garbage", "nonsense at the control socket", control_garbage),
        face_fault(
            "control-half-lines",
            "twelve clients of the control socket that never finish",
            control_half_lines,
            hang_up,
            lasts_s=(6.0, 9.0),
        ),
        face_fault("control-huge-line", "lines of 10 MB at the control socket", control_huge_line),
        face_fault("control-crowd", "200 connections to the control socket", control_crowd, hang_up),
        face_fault(
            "control-deaf",
            "clients of the control socket that read nothing",
            control_deaf,
            hang_up,
            lasts_s=(6.0, 10.0),
        ),
    ]

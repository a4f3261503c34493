"""`companion flight --fetch` in the daemon: a log of either double comes byte for byte, whatever happens meanwhile."""

from __future__ import annotations

import asyncio
import contextlib
import random
import signal
import sys
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any, Literal

import pytest

from companion.errors import AutopilotError, CompanionError, NotDisarmedError, StorageError
from companion.storage import flight_logs
from sim.ardupilot.double import ArduPilotDouble
from sim.firmware.file_server import FileServer
from sim.px4.double import PX4Double
from tests.e2e.test_commands import DONE, FAILED, NO_DAEMON, USAGE, companion, flight_line
from tests.support.flown import dataflash, fly, messages, parameters
from tests.support.rig import Rig
from tests.support.virtual_time import run_virtual

Firmware = Literal["ardupilot", "px4"]
FIRMWARES: tuple[Firmware, ...] = ("ardupilot", "px4")
both = pytest.mark.parametrize("firmware", FIRMWARES)
PATHS = {"ardupilot": "/APM/LOGS/00000012.BIN", "px4": "@MAV_LOG/2026-11-23/10_20_30.ulg"}
NAMES = {"ardupilot": "00000012.BIN", "px4": "2026-11-23_10_20_30.ulg"}


def content(size: int, seed: int = 1) -> bytes:
    return random.Random(seed).randbytes(size)


@contextlib.asynccontextmanager
async def grounded(folder: Path, firmware: Firmware, log: bytes, **more: Any) -> AsyncIterator[tuple[Rig, FileServer]]:
    async with Rig(folder, firmware=firmware, **more).running() as rig:
        files = served(rig)
        files.files[PATHS[firmware]] = log
        if firmware == "ardupilot":
            files.files["/APM/LOGS/LASTLOG.TXT"] = b"12\r\n"
        await rig.ready()
        yield rig, files


def served(rig: Rig) -> FileServer:
    assert isinstance(rig.autopilot, ArduPilotDouble | PX4Double)
    return rig.autopilot.file_server


async def fetch(rig: Rig, log: str | None = None, look: Callable[[dict[str, Any]], object] = lambda _: None) -> Any:
    """The last reply; `look` is shown each."""
    last: dict[str, Any] = {}
    async for last in rig.service.faces.answer({"command": "fetch", "log": log}):
        look(last)
    return last


def read(result: Any) -> bytes:
    return Path(result["file"]).read_bytes()


async def refused(rig: Rig, kind: type[CompanionError] = AutopilotError, log: str | None = None) -> str:
    with pytest.raises(kind) as found:
        await fetch(rig, log)
    return str(found.value)


@both
def test_it_arrives_byte_for_byte_and_is_not_fetched_twice(tmp_path: Path, firmware: Firmware) -> None:
    log = content(100_000)
    shown: list[dict[str, Any]] = []

    async def main() -> None:
        async with grounded(tmp_path, firmware, log) as (rig, files):
            result = await fetch(rig, look=shown.append)
            path = Path(result["file"])
            assert path == tmp_path / "logs" / NAMES[firmware]
            assert read(result) == log
            assert [*path.parent.iterdir()] == [path]
            texts = [reply["text"] for reply in shown if reply["kind"] == "progress"]
            assert any("kB/s" in text and "left" in text and "of 0.1 MB" in text for text in texts), texts
            before = files.asked
            assert (await fetch(rig))["file"] == str(path)
            assert files.asked - before < 10

    run_virtual(main())


def test_losses_and_copies(tmp_path: Path) -> None:
    log = content(40_000)

    async def main() -> None:
        async with grounded(tmp_path, "px4", log, loss=0.1, duplicate=0.1) as (rig, _):
            assert read(await fetch(rig)) == log

    run_virtual(main())


def test_answers_that_come_late_twice_or_to_others(tmp_path: Path) -> None:
    log = content(60_000)
    kept: list[bytes] = []

    def disturb(payload: bytes) -> list[bytes]:
        """Each seventh comes behind the next one; copies, other data for requests that nobody made."""
        wrong, other = bytearray(payload), bytearray(payload)
        wrong[12:20] = other[12:20] = b"nonsense"
        wrong[0] ^= 0x55
        other[5] = 14
        kept.append(payload)
        if len(kept) % 7 == 0:
            return []
        late = [kept[-2]] if len(kept) % 7 == 1 and len(kept) > 7 else []
        return [bytes(other), payload, *late, payload, bytes(wrong)]

    async def main() -> None:
        async with grounded(tmp_path, "ardupilot", log) as (rig, files):
            files.disturb = disturb
            assert read(await fetch(rig)) == log

    run_virtual(main())


@both
def test_the_cable_comes_out_and_the_fetch_goes_on(tmp_path: Path, firmware: Firmware) -> None:
    log = content(100_000)

    async def main() -> None:
        async with grounded(tmp_path, firmware, log) as (rig, _):
            fetching = asyncio.create_task(fetch(rig))
            await asyncio.sleep(1.0)
            assert not fetching.done()
            rig.wire.cut = True
            await asyncio.sleep(25.0)  # longer than a session lives
            rig.wire.cut = False
            assert read(await fetching) == log

    run_virtual(main())


def test_what_has_come_is_kept_for_the_next_time(tmp_path: Path) -> None:
    log = content(150_000)

    async def main() -> None:
        async with grounded(tmp_path, "ardupilot", log) as (rig, files):
            fetching = asyncio.create_task(fetch(rig))
            await asyncio.sleep(2.0)
            rig.wire.cut = True
            with pytest.raises(AutopilotError, match=r"no answer .* for 30 s: stopped at \d+ % of the log"):
                await fetching
            part = tmp_path / "logs" / f"{NAMES['ardupilot']}.part"
            there = part.stat().st_size
            assert there > 20_000
            assert log.startswith(part.read_bytes())
            rig.wire.cut = False
            await rig.restart()
            await rig.ready()
            asked = files.asked
            assert read(await fetch(rig)) == log
            assert files.asked - asked < (len(log) - there) / 239 * 1.05 + 20

    run_virtual(main())


@both
def test_after_a_crash_the_file_that_was_left_open_is_waited_for(tmp_path: Path, firmware: Firmware) -> None:
    log = content(60_000)

    async def main() -> None:
        async with grounded(tmp_path, firmware, log) as (rig, files):
            fetching = asyncio.create_task(fetch(rig))
            await asyncio.sleep(1.0)
            rig.wire.cut = True
            fetching.cancel()
            await asyncio.gather(fetching, return_exceptions=True)
            await rig.restart()
            await rig.ready()
            files.keep_open()
            shown: list[str] = []
            assert read(await fetch(rig, look=lambda reply: shown.append(reply.get("text", "")))) == log
            assert any("left open on the autopilot: waits 13 s" in text for text in shown)
            if firmware == "px4":
                await asyncio.sleep(0.1)  # it is closed at the end
                before_s = rig.now_s
                files.open_as_another_station(PATHS["px4"])
                asking = asyncio.create_task(refused(rig))
                while not asking.done():
                    await asyncio.sleep(1.0)
                    files.keep_open()
                assert "another station reads files" in await asking
                assert rig.now_s - before_s < 20.0

    run_virtual(main())


def test_a_client_that_goes_away_ends_it_and_another_goes_on(tmp_path: Path) -> None:
    log = content(400_000)

    async def main() -> None:
        async with grounded(tmp_path, "px4", log) as (rig, _):
            first = rig.service.faces.answer({"command": "fetch"})
            for _ in range(4):
                await anext(first)
            assert await refused(rig) == "a log is being fetched already"
            await first.aclose()  # type: ignore[attr-defined]
            await asyncio.sleep(0.1)
            assert (tmp_path / "logs" / f"{NAMES['px4']}.part").stat().st_size > 10_000
            assert read(await fetch(rig)) == log

    run_virtual(main())


@both
def test_arming_ends_it_at_once_and_nothing_more_is_asked(tmp_path: Path, firmware: Firmware) -> None:
    async def main() -> None:
        async with grounded(tmp_path, firmware, content(150_000)) as (rig, files):
            fetching = asyncio.create_task(fetch(rig))
            await asyncio.sleep(1.0)
            rig.autopilot.armed = True
            armed_s = rig.now_s
            with pytest.raises(NotDisarmedError, match=r"the aircraft was armed: stopped at \d+ % of the log"):
                await fetching
            assert rig.now_s - armed_s < 1.2  # PX4 sends a heartbeat a second
            await asyncio.sleep(0.1)  # what is on the wire
            asked = files.asked
            assert "the aircraft is armed" in await refused(rig, NotDisarmedError)
            await asyncio.sleep(5.0)
            assert files.asked == asked

    run_virtual(main())


def test_while_nobody_knows_whether_it_is_armed_nothing_is_asked(tmp_path: Path) -> None:
    log = content(200_000)

    async def main() -> None:
        async with grounded(tmp_path, "ardupilot", log) as (rig, files):
            fetching = asyncio.create_task(fetch(rig))
            await asyncio.sleep(0.5)
            rig.autopilot.faults.heartbeat_off = True
            await asyncio.sleep(2.5)
            asked = files.asked
            await asyncio.sleep(5.0)
            assert files.asked == asked
            assert not fetching.done()
            rig.autopilot.faults.heartbeat_off = False
            assert read(await fetching) == log

    run_virtual(main())


def test_a_calibration_goes_first(tmp_path: Path) -> None:
    log = content(100_000)

    async def main() -> None:
        async with grounded(tmp_path, "ardupilot", log) as (rig, files):
            shown: list[str] = []
            fetching = asyncio.create_task(fetch(rig, look=lambda reply: shown.append(reply.get("text", ""))))
            await asyncio.sleep(2.0)
            async for reply in rig.service.faces.answer({"command": "calibrate", "wait": True}):
                if reply["kind"] == "progress" and reply["percent"] == 0:
                    asked = files.asked
            assert reply["record"]["state"] == "done"
            assert files.asked - asked <= 5
            assert read(await fetching) == log
            assert any("waits for the calibration" in text for text in shown)

    run_virtual(main())


@both
def test_half_of_a_slow_line_stays_free(tmp_path: Path, firmware: Firmware) -> None:
    log = content(20_000)
    # What PX4's streams take of it by default (MAV_1_RATE = 0).
    more = {"data_rate": 2880.0} if firmware == "px4" else {}

    async def main() -> None:
        async with grounded(tmp_path, firmware, log, baud=57600, **more) as (rig, files):
            before_s, before = rig.now_s, rig.link.received["HEARTBEAT"]
            result = await fetch(rig)
            took_s = rig.now_s - before_s
            assert read(result) == log
            assert files.asked * 266 / took_s < 0.5 * 5760
            assert len(log) / took_s > 500
            assert rig.link.received["HEARTBEAT"] - before > 0.9 * took_s

    run_virtual(main())


def test_another_station_takes_px4s_only_session(tmp_path: Path) -> None:
    """Its file has other bytes where ours are asked for; they must not be taken for the log's."""
    log, other = content(100_000), content(500_000, seed=2)

    async def main() -> None:
        async with grounded(tmp_path, "px4", log) as (rig, files):
            files.files["/other"] = other
            fetching = asyncio.create_task(fetch(rig))
            await asyncio.sleep(1.0)
            files.open_as_another_station("/other")
            assert read(await fetching) == log

    run_virtual(main())


def test_a_log_of_another_aircraft_with_the_same_name_stays(tmp_path: Path) -> None:
    log, other = content(30_000), content(20_000, seed=2)

    async def main() -> None:
        async with grounded(tmp_path, "ardupilot", other) as (rig, files):
            first = await fetch(rig)
            files.files[PATHS["ardupilot"]] = log
            second = await fetch(rig)
            assert Path(second["file"]).name == "00000012-2.BIN"
            assert (read(first), read(second)) == (other, log)
            grown = files.files[PATHS["ardupilot"]] = log + content(10_000, seed=3)
            again = await fetch(rig)
            assert (again["file"], read(again)) == (second["file"], grown)

    run_virtual(main())


def test_a_log_that_grows_is_fetched_to_the_end_that_it_had(tmp_path: Path) -> None:
    log = content(100_000)

    async def main() -> None:
        async with grounded(tmp_path, "ardupilot", log) as (rig, files):
            fetching = asyncio.create_task(fetch(rig))
            await asyncio.sleep(1.5)
            files.files[PATHS["ardupilot"]] += content(50_000, seed=2)
            assert read(await fetching) == log

    run_virtual(main())


def test_a_log_that_goes_away_or_gets_shorter(tmp_path: Path) -> None:
    async def main() -> None:
        async with grounded(tmp_path, "ardupilot", content(100_000)) as (rig, files):
            fetching = asyncio.create_task(fetch(rig))
            await asyncio.sleep(1.5)
            files.files[PATHS["ardupilot"]] = files.files[PATHS["ardupilot"]][:20_000]
            with pytest.raises(AutopilotError, match="not on the autopilot any more as it was"):
                await fetching

    run_virtual(main())


@pytest.mark.parametrize("knows_times", [True, False])
def test_the_latest_of_px4(tmp_path: Path, knows_times: bool) -> None:
    """Dates and numbered folders; which is later tells only the time of writing."""
    latest = "@MAV_LOG/sess010/log002.ulg" if knows_times else PATHS["px4"]

    async def main() -> None:
        async with grounded(tmp_path, "px4", b"dated" * 100) as (rig, files):
            files.knows_times = knows_times
            for number, path in enumerate(("2026-11-22/23_59_59.ulg", "sess009/log999.ulg", "sess010/log001.ulg")):
                files.files[f"@MAV_LOG/{path}"] = b"old" * number
                files.times[f"@MAV_LOG/{path}"] = 1_700_000_000 + number
            files.files["@MAV_LOG/sess010/log002.ulg"] = b"numbered" * 100
            files.files["@MAV_LOG/sess010/other.txt"] = b"?"
            files.times |= {"@MAV_LOG/sess010/log002.ulg": 1_800_000_000, PATHS["px4"]: 1_700_000_005}
            assert read(await fetch(rig)) == files.files[latest]
            assert (
                await refused(rig, log="2026-11-22/23_59_59.ulg")
                == "@MAV_LOG/2026-11-22/23_59_59.ulg: empty on the autopilot"
            )

    run_virtual(main())


def test_one_by_its_number(tmp_path: Path) -> None:
    log = content(5_000, seed=9)

    async def main() -> None:
        async with grounded(tmp_path, "ardupilot", b"latest") as (rig, files):
            files.files["/APM/LOGS/00000007.BIN"] = log
            for wanted in ("7", "00000007.BIN"):
                assert read(await fetch(rig, wanted)) == log
            assert await refused(rig, log="8") == "/APM/LOGS/00000008.BIN: not on the autopilot"

    run_virtual(main())


@both
def test_what_cannot_be_fetched_is_one_line(
    tmp_path: Path, firmware: Firmware, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def main() -> None:
        async with grounded(tmp_path, firmware, content(50_000)) as (rig, files):
            rig.autopilot.faults.silent = True
            assert await refused(rig) == "no answer to MAVLink FTP for 5 s"
            rig.autopilot.faults.silent = False
            monkeypatch.setattr(flight_logs, "RESERVE_BYTES", 1 << 60)
            words = await refused(rig, StorageError)
            assert words.endswith("no room for the log: 0.1 MB needed, 0.0 MB free"), words
            assert not [*(tmp_path / "logs").iterdir()]
            files.files.clear()
            assert await refused(rig) == "no log on the autopilot: has it a card, and does it log?"
            rig.service.core.vehicle.capabilities = 0
            assert (await refused(rig)).startswith("this autopilot has no MAVLink FTP: take the log from its card")

    run_virtual(main())


def test_the_disk_refuses_in_the_middle(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    log = content(100_000)

    async def main() -> None:
        async with grounded(tmp_path, "ardupilot", log) as (rig, _):

            def full(_: int) -> None:
                raise OSError(28, "No space left on device")

            fetching = asyncio.create_task(fetch(rig))
            await asyncio.sleep(0.5)
            monkeypatch.setattr("os.fsync", full)
            with pytest.raises(StorageError, match=r"\.part: the log cannot be kept: No space left on device"):
                await fetching
            monkeypatch.undo()
            assert [path.name for path in (tmp_path / "logs").iterdir()] == ["00000012.BIN.part"]
            assert read(await fetch(rig)) == log

    run_virtual(main())


def test_old_logs_make_room(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(flight_logs, "MOST_BYTES", 25_000)

    async def main() -> None:
        async with grounded(tmp_path, "ardupilot", b"") as (rig, files):
            for number in (1, 2, 3):
                files.files[f"/APM/LOGS/{number:08d}.BIN"] = content(10_000, seed=number)
                await fetch(rig, str(number))
            kept = ["00000002.BIN", "00000003.BIN"]
            assert sorted(path.name for path in (tmp_path / "logs").iterdir()) == kept
            files.files["/APM/LOGS/00000004.BIN"] = content(30_000)
            assert "no room for the log: 0.0 MB needed, 0.0 MB free" in await refused(rig, StorageError, "4")
            assert sorted(path.name for path in (tmp_path / "logs").iterdir()) == kept

    run_virtual(main())


def test_a_name_from_the_wire_stays_in_the_folder(tmp_path: Path) -> None:
    async def main() -> None:
        async with grounded(tmp_path, "px4", b"") as (rig, files):
            files.files = {"@MAV_LOG/2026-11-24/..\\..\\..%2e\x1b.ulg": b"x" * 500}
            path = Path((await fetch(rig))["file"])
            assert path.parent == tmp_path / "logs"
            assert path.name == "2026-11-24_.._.._.._2e_.ulg"

    run_virtual(main())


def test_on_the_command_line(tmp_path: Path) -> None:
    """Fetched, then read; Ctrl-C keeps what has come; without a daemon exit code 3."""
    log = tmp_path / "flown.BIN"
    dataflash(log, messages(fly(seconds=90.0, rate_hz=25.0), parameters()))

    async def main() -> None:
        async with flight_line(tmp_path) as line:
            config, autopilot = str(line.config), line.scenario.autopilot
            assert isinstance(autopilot, ArduPilotDouble)
            autopilot.file_server.files = {PATHS["ardupilot"]: log.read_bytes(), "/APM/LOGS/LASTLOG.TXT": b"12\r\n"}
            command = (sys.executable, "-m", "companion", "-c", config, "flight", "--fetch")
            stopped = await asyncio.create_subprocess_exec(*command, stderr=asyncio.subprocess.PIPE)
            assert stopped.stderr is not None
            async with asyncio.timeout(30.0):
                await stopped.stderr.readuntil(b"left")
                stopped.send_signal(signal.SIGINT)
                rest = (await stopped.stderr.read()).decode()
            assert "the next companion flight --fetch goes on from there" in rest
            assert await stopped.wait() == FAILED

            found = await companion("-c", config, "flight", "--fetch", "--json")
            assert found.code == DONE, found.err
            assert found.json["file"] == str(tmp_path / "state" / "logs" / "00000012.BIN")
            assert len(found.json["flights"]) == 1
            assert read(found.json) == log.read_bytes()
            assert "of 0." in found.err
            assert "fetched: " in found.err

            autopilot.arm()
            await asyncio.sleep(1.5)
            refused = await companion("-c", config, "flight", "--fetch", "7")
            assert (refused.code, refused.out) == (FAILED, "")
            assert refused.err.strip() == "companion: the aircraft is armed: logs are fetched on the ground, disarmed"
        gone = await companion("-c", config, "flight", "--fetch")
        assert gone.code == NO_DAEMON
        which = await companion("flight")
        assert (which.code, which.err.strip()) == (
            USAGE, "companion flight: which LOG? --fetch gets the latest from the autopilot"
        )  # fmt: skip

    asyncio.run(main())

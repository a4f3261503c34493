"""Delay from the last sample to the full record: solved, on the disk, and published on the control socket.

The last sample is the one with which every source has ended the last second that is needed: the serial IMU's, the
gradienter's or the compass', whichever is the latest. It is timed where it is written, in the simulator; the record
where it comes out of the control socket. Results are not pushed: a write takes as long as the autopilot likes. With an
autopilot's IMU among the sources its offsets are read again before the record is believed, which takes as long as the
autopilot likes, too. Beside it what the disk alone takes for files of that size, made durable one after the other.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import re
import statistics
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

from companion.component.service import Refusal
from companion.estimation.machine import What
from companion.storage.records import RecordStore
from companion.storage.state import write_atomically
from sim.pty_device import PtyDevice
from sim.scenario import Scenario
from sim.station import UdpEnd
from tests.bench_memory import daemon, last_reply, status_when
from tests.support.live_aircraft import live_aircraft
from tests.support.rig import Rig
from tests.support.virtual_time import run_virtual

LIMIT_MS: Final = 50.0
_SOLVE: Final = "Estimator.solve.<locals>.<lambda>"
_KEEP: Final = RecordStore.save.__qualname__
SETTINGS: Final = """
[push]
parameters = false
[calibration]
min_still_s = 5
max_s = 6
at_arm = "off"
"""
RECORD_BYTES: Final = 6_000


@contextlib.contextmanager
def noting() -> Iterator[dict[str, list[float]]]:
    """Note just before each write of every device and of the autopilot."""
    times_s: dict[str, list[float]] = {}
    write, send = PtyDevice._write, UdpEnd._send

    def written(self: PtyDevice, data: bytes) -> None:
        if data:
            times_s.setdefault(self.path.name, []).append(time.monotonic())
        write(self, data)

    def sent(self: UdpEnd, data: bytes) -> None:
        times_s.setdefault("autopilot", []).append(time.monotonic())
        send(self, data)

    PtyDevice._write, UdpEnd._send = written, sent  # type: ignore[method-assign]
    try:
        yield times_s
    finally:
        PtyDevice._write, UdpEnd._send = write, send  # type: ignore[method-assign]


def last_sample_s(times_s: dict[str, list[float]], end_s: float) -> float:
    """When the second was complete that the record had waited for: the latest in which all sources have spoken."""
    second_s = float(int(end_s))
    while True:
        firsts = [next((t_s for t_s in times if second_s <= t_s < end_s), None) for times in times_s.values()]
        spoken = [first_s for first_s in firsts if first_s is not None]
        if len(spoken) == len(firsts):
            return max(spoken)
        second_s -= 1.0


async def delays(folder: Path, calibrations: int, *, autopilot_imu: bool) -> list[float]:
    """Delay of each calibration from its last sample to its record, in seconds."""
    with noting() as times_s:
        async with live_aircraft(folder, SETTINGS) as scenario:
            if not autopilot_imu:
                config = folder / "companion.toml"
                config.write_text(_AUTOPILOT_IMU.sub("", config.read_text(), count=1))
            return await _calibrated(folder, scenario, times_s, calibrations, autopilot_imu=autopilot_imu)


_AUTOPILOT_IMU: Final = re.compile(r"\[\[imu\]\]\nname = \"fc\"\n(?:[^\[\n].*\n)*")


async def _calibrated(
    folder: Path, scenario: Scenario, times_s: dict[str, list[float]], calibrations: int, *, autopilot_imu: bool
) -> list[float]:
    found = []
    async with daemon(folder) as (_, control):
        for _ in range(calibrations):
            # Arming ends the still stretch: one that is long enough already would give a record at once.
            for change, state in ((scenario.autopilot.arm, "armed"), (scenario.autopilot.disarm, "disarmed")):
                change()
                await status_when(control, lambda now, state=state: bool(now["vehicle"]["armed"] == state))  # type: ignore[misc]
            for times in times_s.values():
                times.clear()
            reply = await last_reply(control, {"command": "calibrate", "wait": True})
            end_s = time.monotonic()
            assert reply["record"]["state"] == "done", reply["record"]["reason"]
            assert {"fc", "own"}.issuperset(imu["name"] for imu in reply["record"]["imus"])
            counted = {name: times for name, times in times_s.items() if autopilot_imu or name != "autopilot"}
            found.append(end_s - last_sample_s(counted, end_s))
    return found


def disk_alone_s(folder: Path) -> float:
    """Return the median time of writing a record as the storage does."""
    took = []
    for number in range(9):
        begun_s = time.perf_counter()
        write_atomically(folder / f"{number}", os.urandom(RECORD_BYTES))
        took.append(time.perf_counter() - begun_s)
    return statistics.median(took)


async def _processor_s(folder: Path) -> dict[str, float]:
    """Processor time of the work in threads from the last sample to the record: the least of some calibrations."""
    rig, least = Rig(folder, own_imu=True, more="[push]\nparameters = false\n"), dict[str, float]()
    spent: dict[str, float] = {}

    async def offload(function: Any, *arguments: Any) -> Any:
        begun_s = time.process_time()
        try:
            return function(*arguments)
        finally:
            name = getattr(function, "__qualname__", repr(function))
            spent[name] = spent.get(name, 0.0) + time.process_time() - begun_s

    rig.offload = offload
    async with rig.running():
        await rig.ready()
        for _ in range(5):
            job = rig.service.calibrating.manager.start_calibration(What.BOTH, "bench")
            assert not isinstance(job, Refusal)
            await rig.until(lambda job=job: job.words == "working out the biases" or job.finished.done(), 100.0)  # type: ignore[misc]
            await job.finished
            for name in (_SOLVE, _KEEP):
                least[name] = min(least.get(name, float("inf")), spent.pop(name))
    return least


def table(calibrations: int) -> None:
    """Beside the limit."""
    with tempfile.TemporaryDirectory() as text:
        folder = Path(text)
        disk_ms = 1e3 * disk_alone_s(folder)
        for name in ("False", "True"):
            (folder / name).mkdir()
        own_ms, both_ms = (
            sorted(1e3 * s for s in asyncio.run(delays(folder / f"{fc}", calibrations, autopilot_imu=fc)))
            for fc in (False, True)
        )
        processor = run_virtual(_processor_s(folder / "virtual"))
    print(f"\n{'from the last sample to the full record (ms)':60} {'best':>6} {'median':>7} {'worst':>6}")
    for words, took_ms in (("serial IMU, gradienter, compass", own_ms),
                           ("the same and an autopilot's IMU, whose offsets are read again", both_ms)):  # fmt: skip
        print(f"{words:60} {took_ms[0]:6.1f} {statistics.median(took_ms):7.1f} {took_ms[-1]:6.1f}")
    print(f"{'floor: the disk alone, for a record':60} {'':6} {disk_ms:7.1f}")
    print(f"{'processor time of it: biases':60} {1e3 * processor[_SOLVE]:6.1f}")
    print(f"{'processor time of it: record and file':60} {1e3 * processor[_KEEP]:6.1f}")
    median_ms = statistics.median(own_ms)
    print(f"limit {LIMIT_MS:g} ms: median {median_ms:.1f} ms, {'held' if median_ms <= LIMIT_MS else 'NOT HELD'}; "
          f"load average {os.getloadavg()[0]:.1f}")  # fmt: skip


if __name__ == "__main__":
    table(10)

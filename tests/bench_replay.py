"""Replay speed in IMU samples a second, against the cost of reading the same file alone.

Recordings of a still aircraft, as a daemon would have written them, and a log of somebody's own. Beside each, in the
same run: the MCAP library that reads every message of the file and does nothing with it, or `numpy.loadtxt` for the
log. Times are the best of several rounds, in processor time and on the wall; a ratio says the same on every machine.

Part of `make bench` with a tenth of the samples; by itself, with a million in each: python -m tests.bench_replay
"""

from __future__ import annotations

import argparse
import asyncio
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np

from companion.lab.estimate import Given, estimate
from companion.lab.log_files import read_logs
from companion.lab.recording import Recording
from companion.lab.replay import replay
from companion.lab.still_log import read_csv
from tests.support.long_recordings import write_log, write_recording
from tests.support.rig import Rig
from tests.support.virtual_time import run_virtual

ROUNDS: Final = 3
MILLION: Final = 1_000_000
_LIVE_S: Final = 240.0
"""Nearly what one file of such a recording holds."""


def best_s(work: Callable[[], object], rounds: int = ROUNDS) -> tuple[float, float]:
    """Processor and wall time of one call, the best of several."""
    cpu_s = wall_s = float("inf")
    for _ in range(rounds):
        start_cpu_s, start_wall_s = time.process_time(), time.perf_counter()
        work()
        cpu_s = min(cpu_s, time.process_time() - start_cpu_s)
        wall_s = min(wall_s, time.perf_counter() - start_wall_s)
    return cpu_s, wall_s


def _read(path: Path) -> int:
    return sum(1 for _ in Recording(path).read())


def _replayed(path: Path) -> None:
    assert replay([path]).seconds > 1.0


def _estimated(path: Path) -> None:
    record, _ = estimate(read_csv(path), Given(pitch_deg=5.0, roll_deg=-3.0, heading_deg=40.0, latitude_deg=40.0))
    assert record.state == "done", record.reason


def _line(words: str, samples: int, took_s: tuple[float, float]) -> None:
    cpu_s, wall_s = took_s
    rate, per_million = samples / cpu_s, MILLION / samples
    print(f"  {words:56} {rate:11,.0f} {per_million * cpu_s:8.2f} {per_million * wall_s:8.2f}")


def _recordings(folder: Path, samples: int) -> None:
    kinds: tuple[tuple[str, dict[str, Any]], ...] = (
        ("one serial IMU at 1 kHz, a read a frame", {"seconds": samples / 1000.0}),
        ("the same, read every 16 ms as by a USB adapter", {"seconds": samples / 1000.0, "read_s": 0.016}),
        ("two serial IMUs at 500 Hz", {"seconds": samples / 1000.0, "rate_hz": 500.0, "imus": 2}),
        ("one serial IMU at 200 Hz", {"seconds": samples / 200.0, "rate_hz": 200.0}),
    )
    for number, (words, kind) in enumerate(kinds):
        path = folder / f"{number}.mcap"
        count = write_recording(path, **kind)
        _line(f"{words}: replayed", count, best_s(partial(_replayed, path)))
        if number == 0:
            _line("  the same, read with the mcap library only", count, best_s(partial(_read, path), 1))
        path.unlink()


def _log(folder: Path, samples: int) -> None:
    path = folder / "imu.csv"
    write_log(path, samples)
    _line("a log of text at 100 Hz (2.8 h a million): replayed", samples, best_s(partial(_estimated, path)))
    _line("  the same, numpy.loadtxt only", samples, best_s(lambda: np.loadtxt(path, delimiter=",", skiprows=1)))


async def _live(folder: Path) -> None:
    async with Rig(folder, own_imu=True, recordings_mb=64).running() as rig:
        await rig.ready()
        await asyncio.sleep(_LIVE_S)


def main(samples: int = MILLION // 10) -> None:
    print(f"\nreplay, {samples:,} IMU samples in each:")
    print(f"  {'':56} {'samples/s':>11} {'s/million':>8} {'wall':>7}")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        _recordings(folder, samples)
        _log(folder, samples)
        run_virtual(_live(folder / "live"))
        path = folder / "live" / "recordings" / "000001.mcap"
        count = sum(len(log.t_s) for log in read_logs([path]))
        took_s = best_s(partial(_replayed, path))
        _line("200 Hz serial and the autopilot's 100 Hz, samples of both", count, took_s)
        seconds = replay([path]).seconds
        print(f"    {seconds:.0f} s of it: {seconds / took_s[0]:.0f} times real time by the processor")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--samples", type=int, default=MILLION)
    main(parser.parse_args().samples)

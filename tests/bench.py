"""`make bench`: what the daemon's hot paths cost, as ratios to one reference measured in the same run.

The reference is the least that any decoder must do: one CRC over a 44-byte frame and one unpacking of its floats. A
ratio says the same on every machine; a microsecond does not. Read a ratio against the one of the last commit.
"""

from __future__ import annotations

import asyncio
import binascii
import json
import struct
import tempfile
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Final

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.component.component import ArmAuthoriser
from companion.daemon.job import Job
from companion.estimation.collector.intake import Settings
from companion.estimation.collector.rolling import RollingCollector
from companion.estimation.machine import What
from companion.estimation.means.windows import ImuInput
from companion.estimation.noise.allan import noise_profile
from companion.lab.replay import replay
from companion.links.mavlink.link import MavlinkLink
from companion.protocols.registry import Kind
from companion.samples import ImuSample
from companion.storage.records import BiasStore, KnownImu
from tests import bench_daemon, bench_replay, bench_start
from tests.support.component import ScriptedGate
from tests.support.decoders import make_decoder
from tests.support.frames import (
    imu_line,
    mip_imu,
    pni_heading,
    rion_angles,
    stim300,
    vectornav_imu,
    wit,
    wit_imu,
    xsens_imu,
)
from tests.support.histories import two_years
from tests.support.rig import Rig
from tests.support.virtual_time import run_virtual

ROUNDS: Final = 7
CALLS: Final = 2000


def seconds_a_call(work: Callable[[], object], calls: int = CALLS) -> float:
    """The best of several rounds in processor time: the machine may be doing something else."""
    best_s = float("inf")
    for _ in range(ROUNDS):
        start_s = time.process_time()
        for _ in range(calls):
            work()
        best_s = min(best_s, (time.process_time() - start_s) / calls)
    return best_s


def reference() -> Callable[[], object]:
    frame, floats = bytes(range(44)), struct.Struct("<6f")
    return lambda: (binascii.crc_hqx(frame, 0), floats.unpack_from(frame, 8))


def decoder(name: str, frame: bytes, kind: Kind = "imu") -> Callable[[], object]:
    device = make_decoder(kind, name, 1e-5)
    cut = 33 if len(frame) > 33 else len(frame) // 2
    head, tail = frame[:cut], frame[cut:]  # a port seldom gives a frame in one piece

    def work() -> None:
        device.feed(head, 1.0)
        device.feed(tail, 1.0)

    return work


def mavlink_imu() -> Callable[[], object]:
    sender = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    message = mavlink.MAVLink_highres_imu_message(1, 0.1, 0.2, -9.8, 0.01, 0.02, 0.03, 0, 0, 0, 0, 0, 0, 0, 63, 0)
    frame, link = message.pack(sender), MavlinkLink()
    link.subscribe(mavlink.MAVLink_highres_imu_message, lambda message, t_s: None)
    return lambda: link.receive(frame, 1.0)


def collector_sample() -> Callable[[], object]:
    wanted = Settings(min_still_s=10, max_s=60, target_gyro_sigma_rad_s=1e-5, target_accel_sigma_m_s2=1e-3)
    imu = ImuInput(name="fc", rotation=np.eye(3), profile=noise_profile(None))
    collector = RollingCollector(wanted, [imu])
    noise = np.random.default_rng(1).standard_normal((CALLS, 6)) * 1e-3
    rows = [((r[0], r[1], r[2]), (r[3], r[4], r[5] - 9.8)) for r in noise.tolist()]
    count = 0

    def work() -> None:
        nonlocal count
        gyro, accel = rows[count % CALLS]
        collector.add_imu("fc", ImuSample(count * 0.005, gyro, accel))
        count += 1

    return work


async def _one_calibration(folder: Path, recordings_mb: int = 0) -> float:
    async with Rig(folder, own_imu=True, recordings_mb=recordings_mb).running() as rig:
        await rig.ready()
        start_s, virtual_s = time.process_time(), rig.now_s
        job = rig.service.calibrating.manager.start_calibration(What.BOTH, "bench")
        assert isinstance(job, Job), job
        await job.finished
        return (time.process_time() - start_s) / (rig.now_s - virtual_s)


def _replay_speed(path: Path) -> float:
    """Ratio of recorded time to processor time of a replay."""
    best = 0.0
    for _ in range(ROUNDS):
        start_s = time.process_time()
        result = replay([path])
        best = max(best, result.seconds / (time.process_time() - start_s))
    return best


def arm_request() -> Callable[[], object]:
    """MAV_CMD_ARM_AUTHORIZATION_REQUEST received, judged from the cache, and the COMMAND_ACK packed."""
    sender = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    frame = mavlink.MAVLink_command_long_message(1, 0, 3001, 0, 0, 0, 0, 0, 0, 0, 0).pack(sender)
    link, answers = MavlinkLink(), deque[bytes](maxlen=1)
    link.join((1, 1))
    link.attach(answers.append)
    ArmAuthoriser(link, ScriptedGate(), lambda severity, text, weight: None)

    def work() -> None:
        link.receive(frame, 1.0)
        answers.pop()

    return work


def _store(folder: Path) -> tuple[int, float, float]:
    """Two years of daily sessions of three IMUs: their bytes, the time to read them, and that of json.loads alone."""
    points, store = two_years(), BiasStore(folder)
    store.write({name: KnownImu(identity={}, points=points) for name in ("one", "two", "three")})
    (path,) = folder.iterdir()
    data = path.read_bytes()
    return len(data), seconds_a_call(store.all, 20), seconds_a_call(lambda: json.loads(data), 20)


async def _answering() -> float:
    return seconds_a_call(arm_request())


def main() -> None:
    base_s = seconds_a_call(reference())
    print(f"{'one':44} {'x reference':>12}")
    for words, work in (
        ("reference: CRC and unpacking of 44 bytes", reference()),
        ("VectorNav binary frame, decoded", decoder("vectornav", vectornav_imu())),
        ("$IMU line, decoded", decoder("imu_line", imu_line(1, 2))),
        ("WitMotion epoch of four frames, decoded", decoder("witmotion", wit_imu() + wit(0x53, 9, 9) + wit(0x54, 9))),
        ("PNI heading, pitch and roll, decoded", decoder("pni", pni_heading(123.5), "compass")),
        ("RION angles, decoded", decoder("rion", rion_angles(1.5, -2.5, 123.5), "compass")),
        ("MIP packet, decoded", decoder("mip", mip_imu())),
        ("MTData2 message, decoded", decoder("xsens", xsens_imu())),
        ("STIM300 datagram with all clusters, decoded", decoder("stim300", stim300(0xA7))),
        ("HIGHRES_IMU, received and handed on", mavlink_imu()),
        ("IMU sample into the rolling collector", collector_sample()),
    ):
        print(f"{words:44} {seconds_a_call(work) / base_s:12.1f}")
    print(f"{'arm authorisation, from request to answer':44} {asyncio.run(_answering()) / base_s:12.1f}")
    with tempfile.TemporaryDirectory() as folder:
        share = run_virtual(_one_calibration(Path(folder)))
        recording = run_virtual(_one_calibration(Path(folder) / "recorded", recordings_mb=64))
        speed = _replay_speed(Path(folder) / "recorded" / "recordings" / "000001.mcap")
        size, read_s, loads_s = _store(Path(folder) / "store")
    print(f"\na calibration with simulator and daemon in one process: {share:.1%} of a core (100 Hz FC, 200 Hz serial)")
    print(f"the same while it is recorded: {recording:.1%}")
    print(f"a recording of it is replayed {speed:.0f} times as fast as it was made")
    print(
        f"biases of two years of three IMUs ({size} bytes) are read in {1e3 * read_s:.2f} ms,"
        f" {read_s / loads_s:.2f} x json.loads"
    )
    bench_start.main()
    bench_replay.main()
    bench_daemon.table(1, bench_daemon.TABLE_S, "vectornav")


if __name__ == "__main__":
    main()

"""Cost of a start without a clock: imports up to the first heartbeat; an interrupted start."""

from __future__ import annotations

import asyncio
import os
import re
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from companion.config import parse
from companion.daemon.job import Job
from companion.estimation.machine import What
from tests.bench_start import FULL, MINIMAL
from tests.support.first_heartbeat import modules_at_first_heartbeat
from tests.support.rig import Rig
from tests.support.virtual_time import run_virtual

pytestmark = pytest.mark.real_clock

NOT_YET = (
    "_ssl", "aiomqtt", "anyio", "companion.mqtt", "companion.web", "h11", "starlette", "uvicorn",
    "companion.daemon.heading.attitude_service",
    "companion.daemon.process.check", "companion.storage.fleet_items",
    "companion.cli.setup", "companion.ground", "companion.installation", "companion.setup",
    "companion.lab", "companion.report", "csv", "email", "http", "importlib.metadata", "lxml", "lz4", "mavsdk",
    "mcap", "multiprocessing", "numpy.fft", "numpy.ma", "numpy.polynomial", "numpy.random", "numpy.testing", "paho",
    "pymavlink.mavutil", "rich", "sqlite3", "unittest", "urllib.request", "xml", "zipfile", "zstandard",
)  # fmt: skip
"""Each takes milliseconds; what of it is needed is imported by who needs it, in a thread."""


@pytest.mark.parametrize(("text", "most"), [(FULL, 543), (MINIMAL, 537)], ids=["everything on", "minimal"])
def test_nothing_heavy_before_the_first_heartbeat(tmp_path: Path, text: str, most: int) -> None:
    config = tmp_path / "companion.toml"
    with socket.create_server(("127.0.0.1", 0)) as broker, socket.socket(type=socket.SOCK_DGRAM) as heard:
        heard.bind(("127.0.0.1", 0))
        config.write_text(
            text.format(port=heard.getsockname()[1], folder=tmp_path, broker=broker.getsockname()[1]), encoding="utf-8"
        )
        modules, _ = modules_at_first_heartbeat(config, {**os.environ, "PYTHONPATH": os.getcwd()})
    assert "companion.daemon.process.service" in modules
    assert {
        name for name in NOT_YET if any(found == name or found.startswith(f"{name}.") for found in modules)
    } == set()
    # Debian's Python imports it by itself, others have none.
    assert len(modules - {"sitecustomize"}) <= most, "what is all this imported for before the companion is heard?"


SETTLED = """
import gc, os
from companion.daemon.__main__ import prepare

prepare()
assert not gc.isenabled() and os.environ["OPENBLAS_NUM_THREADS"] == "1"
from pymavlink.dialects.v20 import ardupilotmega
from companion.daemon.process.service import settle
settle()
assert gc.isenabled() and gc.get_freeze_count() > 10_000
print("good")
"""


def test_what_is_there_is_not_looked_through_again() -> None:
    """In a process of its own: it is for the whole of one."""
    ended = subprocess.run([sys.executable, "-c", SETTLED], capture_output=True, text=True, timeout=60.0, check=False)
    assert ended.stdout == "good\n", ended.stderr


def test_the_record_waits_for_nothing_after_its_last_second(tmp_path: Path) -> None:
    """Without an autopilot's IMU, whose offsets would be read again: what is left is processor time and the disk."""

    async def main() -> list[float]:
        rig, waited_s = Rig(tmp_path, own_imu=True, feed_s=0.01, more="[push]\nparameters = false\n"), list[float]()
        rig.config = parse(re.sub(r"\[\[imu\]\]\nname = \"fc\"\n(?:[^\[\n].*\n)*", "", rig.text), "rig.toml")
        async with rig.running():
            await rig.until(lambda: rig.service.core.vehicle.alive, 10.0)
            collector, judged_s = rig.service.core.collector, 0.0
            evaluate = collector._evaluate

            def noted() -> None:
                nonlocal judged_s
                before = collector._next
                evaluate()
                judged_s = rig.now_s if collector._next != before else judged_s

            collector._evaluate = noted  # type: ignore[method-assign]
            for pause_s in (5.0, 0.0, 0.37):
                await asyncio.sleep(pause_s)
                asked_s = rig.now_s
                job = rig.service.calibrating.manager.start_calibration(What.GYROS, "test")
                assert isinstance(job, Job)
                result = await job.finished
                assert result.outcome == "done", result.reason
                waited_s.append(rig.now_s - max(judged_s, asked_s))
        return waited_s

    assert max(run_virtual(main())) < 1e-6

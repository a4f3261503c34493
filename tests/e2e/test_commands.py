"""The commands as a person types them: real processes, ptys and sockets, in real time."""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import json
import re
import signal
import stat
import sys
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from companion.estimation.records.record import ImuRecord, Record, WrittenParameter
from sim.companion_process import POLL_S, READY_WITHIN_S, status_of
from sim.devices import VectorNavBinary
from sim.pty_device import PtyDevice
from sim.scenario import Scenario, demo
from sim.serve import configuration
from sim.station import open_udp

pytestmark = pytest.mark.real_clock

DONE, FAILED, USAGE, NO_DAEMON = 0, 1, 2, 3


class CommandOutput(NamedTuple):
    code: int
    out: str
    err: str

    @property
    def json(self) -> Any:
        return json.loads(self.out)


async def companion(*words: str, within_s: float = 150.0) -> CommandOutput:
    process = await asyncio.create_subprocess_exec(
        sys.executable, "-m", "companion", *words, stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.PIPE
    )
    async with asyncio.timeout(within_s):
        out, err = await process.communicate()
    assert process.returncode is not None
    return CommandOutput(process.returncode, out.decode(), err.decode())


class FlightLine(NamedTuple):
    scenario: Scenario
    config: Path
    daemon: asyncio.subprocess.Process | None


@contextlib.asynccontextmanager
async def flight_line(
    folder: Path, *, daemon: bool = True, more: str = "", still_s: tuple[float, float] = (3.0, 4.0)
) -> AsyncIterator[FlightLine]:
    """A virtual aircraft on ptys and UDP, its configuration (and `more` of it), and the daemon as a process.

    A calibration takes `still_s` of stillness, at least and at most.
    """
    made = demo(seed=25)
    # An eighth of its usual rate, which costs processor time all the while.
    scenario = dataclasses.replace(made, imu=VectorNavBinary(made.serial_imu, rate_hz=25.0))
    async with contextlib.AsyncExitStack() as stack:
        scenario.aircraft.begin(asyncio.get_running_loop().time())
        devices = (("imu", scenario.imu), ("gradienter", scenario.gradienter), ("compass", scenario.compass))
        for name, device in devices:
            await stack.enter_async_context(PtyDevice(device, folder / name))
        link = await open_udp(scenario.autopilot, listen=("127.0.0.1", 0))
        stack.callback(link.close)
        autopilot = asyncio.create_task(scenario.autopilot.run())
        stack.callback(autopilot.cancel)
        text = configuration(scenario, directory=folder, udp=link.local).replace("udpin:", "udpout:")
        text += f'[calibration]\nmin_still_s = {still_s[0]}\nmax_s = {still_s[1]}\nat_arm = "off"\n{more}'
        config = folder / "companion.toml"
        config.write_text(text)
        process = None
        if daemon:
            process = await asyncio.create_subprocess_exec(
                sys.executable, "-m", "companion", "run", "--config", str(config), stderr=asyncio.subprocess.PIPE
            )
            stack.push_async_callback(_end, process)
            await _until_disarmed(config)
        yield FlightLine(scenario, config, process)


async def _end(process: asyncio.subprocess.Process) -> None:
    if process.returncode is None:
        process.kill()
    await process.communicate()


async def _until_disarmed(config: Path) -> None:
    await _until(config, "disarmed")


async def _until(config: Path, armed: str) -> None:
    await until_status(config, armed, lambda status: status["vehicle"]["armed"] == armed)


async def _until_read(config: Path) -> None:
    await until_status(config, "good devices", lambda status: all(one["good"] for one in status["devices"]))


async def until_status(config: Path, what: str, holds: Callable[[Any], bool]) -> None:
    status: Any = None
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(READY_WITHIN_S):
            while status is None or not holds(status):
                await asyncio.sleep(POLL_S)
                status = await status_of(config)
            return
    raise AssertionError(f"the daemon never said {what}: {status}")


async def test_a_day_at_the_flight_line(tmp_path: Path) -> None:
    async with flight_line(tmp_path) as line:
        config = str(line.config)
        autopilot = line.scenario.autopilot
        assert stat.S_IMODE((tmp_path / "control.sock").stat().st_mode) == 0o600
        before = autopilot.parameter("INS_GYROFFS_X")

        await _until_read(line.config)
        status = await companion("status", "-c", config)
        assert status.code == DONE
        for word in ("active calibration: ", "ArduPilot", "disarmed", "vectornav on", "hmr3300 on"):
            assert word in status.out

        done = await companion("-c", config, "calibrate", "--timeout", "60", "--json")
        assert done.code == DONE, done.err
        _check_record(done.json)
        assert "still" in done.err
        assert autopilot.parameter("INS_GYROFFS_X") != before
        x = done.json["imus"][0]["written"]["INS_GYROFFS_X"]
        assert x["outcome"] == "verified"
        assert autopilot.parameter("INS_GYROFFS_X") == x["read_back"]

        history = await companion("history", "-n", "5", "--json", "-c", config)
        assert history.json["records"] == [done.json]
        assert history.json["numbers"] == [1]

        check = await companion("-c", config, "check", "--json")
        assert check.code == DONE, check.out
        assert {finding["name"] for finding in check.json["findings"]} >= {
            "configuration", "daemon", "autopilot", "fc", "own", "gradienter", "compass",
        }  # fmt: skip

        undone = await companion("-c", config, "undo", "--json")
        assert undone.code == DONE, undone
        assert undone.json["written"]["INS_GYROFFS_X"]["outcome"] == "rolled_back"
        again = await companion("-c", config, "--json", "undo")
        assert again.code == FAILED
        assert "nothing to undo" in again.json["reason"]

        # Something worth correcting; for the gyros the firmware's own calibration would do so nearly as well.
        autopilot.write_as_another_station("INS_ACCOFFS_X", 0.3)
        autopilot.faults.echo_without_effect = True
        broken = await companion("-c", config, "calibrate", "--json")
        assert broken.code == FAILED
        assert broken.json["state"] == "failed"
        assert "INS_ACCOFFS_X" in broken.json["reason"]
        assert "does not use" in broken.json["reason"]
        assert broken.json["imus"][0]["written"]["INS_ACCOFFS_X"]["outcome"] == "rolled_back"
        autopilot.faults.echo_without_effect = False

        autopilot.arm()
        await _until(line.config, "armed")
        armed = await companion("-c", config, "calibrate", "--json")
        assert armed.code == FAILED
        assert "armed" in armed.json["reason"]
        autopilot.disarm()

        assert line.daemon is not None
        line.daemon.send_signal(signal.SIGTERM)
        _, log = await line.daemon.communicate()
        assert line.daemon.returncode == DONE
        assert b"Traceback" not in log
        assert not (tmp_path / "control.sock").exists()
        gone = await companion("-c", config, "status", "--json")
        assert gone.code == NO_DAEMON
        assert "the companion is not running" in gone.json["reason"]
        assert gone.err.count("\n") == 2, "the line, and what to do"


def _check_record(record: Any) -> None:
    """Every key that others rely on is there, null where unknown."""
    assert set(record) == set(Record.__struct_fields__)
    assert record["state"] == "done"
    for imu in record["imus"]:
        assert set(imu) == set(ImuRecord.__struct_fields__)
        assert len(imu["covariance"]) == 6
        assert all(len(row) == 6 for row in imu["covariance"])
        for written in imu["written"].values():
            assert set(written) == set(WrittenParameter.__struct_fields__)
    assert record["pose"]["theta_deg"] == pytest.approx(5.0, abs=0.02)
    assert record["pose"]["gamma_deg"] == pytest.approx(-3.0, abs=0.02)
    assert record["pose"]["psi_deg"] == pytest.approx(40.0, abs=3.0)
    assert record["site"]["latitude_deg"] == pytest.approx(40.0, abs=1e-3)
    own = next(imu for imu in record["imus"] if imu["name"] == "own")
    assert own["residual_gyro_rad_s"] is None
    assert own["written"] == {}


async def test_ctrl_c_cancels_the_calibration_that_is_watched(tmp_path: Path) -> None:
    async with flight_line(tmp_path, still_s=(600.0, 600.0)) as line:
        config = str(line.config)
        watched = await asyncio.create_subprocess_exec(
            *(sys.executable, "-m", "companion", "-c", config, "calibrate"),
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.PIPE,
        )
        assert watched.stderr is not None
        async with asyncio.timeout(40.0):
            await watched.stderr.readuntil(b"hold still")
            watched.send_signal(signal.SIGINT)
            out, _ = await watched.communicate()
        assert watched.returncode == FAILED
        assert out.decode() == "cancelled by Ctrl-C; nothing written\n"
        status = (await companion("-c", config, "status", "--json")).json
        assert status["state"] not in ("waiting", "measuring")
        assert line.scenario.autopilot.writes == []


async def test_check_without_a_daemon_says_what_is_wrong(tmp_path: Path) -> None:
    async with flight_line(tmp_path, daemon=False) as line:
        good = await companion("-c", str(line.config), "check")
        assert good.code == DONE, good.out
        assert "not running" in good.out
        assert line.scenario.autopilot.writes == []
        broken = line.config.with_name("broken.toml")
        text = line.config.read_text().replace(str(tmp_path / "compass"), str(tmp_path / "nothing"))
        broken.write_text(re.sub('url = ".*"', 'url = "tcp:127.0.0.1:9"', text))
        bad = await companion("-c", str(broken), "check", "--json")
        assert bad.code == FAILED
        # On a busy machine others may have said nothing in so short a time.
        (finding,) = [each for each in bad.json["findings"] if each["name"] == "compass"]
        assert not finding["good"]
        assert "nothing" in finding["words"]
        assert "compass" in bad.json["reason"]
        (finding,) = [each for each in bad.json["findings"] if each["name"] == "autopilot"]
        assert "127.0.0.1:9" in finding["words"], "the cause, not what a working link would need"
        assert bad.err.startswith("checking: 3 s")
        assert not any(each["name"] == "fc" for each in bad.json["findings"]), "named once"

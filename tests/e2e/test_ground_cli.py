"""`companion ground ...` as a person types it: real processes, the real daemon, MAVSDK, a double of the autopilot.

What a lost, late or foreign answer does: tests/unit/ground/test_exchange.py and tests/unit/ground/test_station.py.
"""

from __future__ import annotations

import asyncio
import os
import signal
import socket
import sys
from pathlib import Path

import pytest

from sim.motions import Handling
from tests.support.ground_line import Said, finish, ground, ground_line

pytestmark = pytest.mark.real_clock

DONE, FAILED, USAGE, NOBODY = 0, 1, 2, 3
GYRO = "INS_GYROFFS_X"


async def test_calibrated_and_undone_from_the_ground(tmp_path: Path) -> None:
    async with ground_line(tmp_path, "ardupilot") as line:
        autopilot = line.scenario.autopilot
        before = autopilot.parameter(GYRO)

        status = await line.ground("status", chosen=False)
        assert status.code == DONE, status
        for words in ("system 1, component 191: idle", "ArduPilot, disarmed", "none since", "off"):
            assert words in status.out

        done = await line.ground("calibrate", "--gyros", "--json")
        assert done.code == DONE, done
        assert done.json["state"] == "done"
        assert done.json["vehicle"] == {"system_id": 1, "firmware": "ArduPilot", "armed": "disarmed"}
        assert autopilot.parameter(GYRO) != before
        # The daemon's own word for it, on the aircraft, by another way.
        record = (await line.daemon.ask("history"))["records"][0]
        assert record["state"] == "done"
        sigma_rad_s = max(sigma for imu in record["imus"] for sigma in imu["gyro_sigma_use_rad_s"])
        assert done.json["gyro_sigma_deg_h"] == pytest.approx(sigma_rad_s * 57.29578 * 3600, rel=1e-3)
        assert done.json["accel_sigma_mg"] is None
        assert f"sigma {done.json['gyro_sigma_deg_h']:.3g} deg/h" in done.json["reason"]
        for words in ("Calibration started", "[ 70 %]", "writing", "checking", "Calibration done"):
            assert words in done.err

        shown = await line.ground("status", "--json")
        assert shown.json["last"] == "done"
        assert shown.json["gyro_sigma_deg_h"] == done.json["gyro_sigma_deg_h"]

        undone = await line.ground("undo")
        assert undone.code == DONE, undone
        assert undone.out.startswith("DONE: ")
        assert autopilot.parameter(GYRO) == before
        again = await line.ground("undo", "--json")
        assert again.code == FAILED
        assert (again.json["state"], again.json["reason"]) == ("refused", "Undo refused: nothing to undo")


async def test_cancelled_and_refused(tmp_path: Path) -> None:
    async with asyncio.TaskGroup() as group:
        for number, one in enumerate((while_the_aircraft_is_handled, while_armed)):
            folder = tmp_path / str(number)  # short: a socket's path has 107 bytes
            folder.mkdir()
            group.create_task(one(folder), name=one.__name__)


async def while_the_aircraft_is_handled(folder: Path) -> None:
    """A request waits and says for what; its time limit and Ctrl-C cancel it."""
    async with ground_line(folder, "ardupilot", motions=[Handling(start_s=-200.0, duration_s=600.0)]) as line:
        late = await line.ground("calibrate", "--timeout", "2", "--json")
        assert late.code == FAILED, late
        assert late.json["state"] == "cancelled"
        assert "not finished within 2 s" in late.json["reason"]
        assert "still" in late.err

        process = await line.start("calibrate")
        await _until_said(process, "Calibration started")
        process.send_signal(signal.SIGINT)
        interrupted = await finish(process)
        assert interrupted.code == FAILED
        assert "Ctrl-C: cancelling" in interrupted.err
        assert "CANCELLED after" in interrupted.out
        assert "Traceback" not in interrupted.err

        idle = await line.ground("cancel", "--json")
        assert idle.code == DONE
        assert idle.json["reason"] == "nothing was running"
        assert line.scenario.autopilot.writes == []


async def while_armed(folder: Path) -> None:
    async with ground_line(folder, "px4") as line:
        autopilot = line.scenario.autopilot
        autopilot.arm()
        await asyncio.sleep(1.5)  # until the heartbeat says so
        armed = await line.ground("calibrate", "--json")
        assert armed.code == FAILED
        assert (armed.json["state"], armed.json["reason"]) == ("refused", "Calibration refused: armed: disarm first")
        assert armed.json["vehicle"]["armed"] == "armed"


async def test_an_autopilot_without_a_companion(tmp_path: Path) -> None:
    async with ground_line(tmp_path, "px4", daemon=False) as line:
        said = await line.ground("calibrate", "--within", "2", "--json")
        assert said.code == NOBODY
        assert said.err.count("\n") == 1
        for words in ("only system 1 (PX4)", "component 191", "companion status", "MAV_1_FORWARD"):
            assert words in said.err
        assert said.json["reason"] in said.err
        assert line.scenario.autopilot.writes == []


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["calibrat"], "did you mean calibrate?"),
        (["status", "--url", "udp://x"], "udpin:HOST:PORT"),
        (["params", "CMP_PUSH=0"], "params was removed in 0.2: set CMP_ parameters in the parameter list"),
    ],
)
def test_usage(words: list[str], expected: str) -> None:
    said = asyncio.run(_run(*words))
    assert said.code == USAGE
    assert expected in said.err
    assert said.err.count("\n") == 1


async def _run(*words: str) -> Said:
    return await finish(await ground(*words))


def test_a_port_that_another_ground_station_has_is_named() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 0))
        port = other.getsockname()[1]
        said = asyncio.run(_run("status", "--url", f"udpin:127.0.0.1:{port}"))
    assert said.code == FAILED
    assert said.err.count("\n") == 1
    assert f"{port} cannot be opened: Address already in use; another ground station has it" in said.err


async def test_without_the_extra_one_line_says_how_to_get_it() -> None:
    code = "import sys; sys.modules['mavsdk'] = None; from companion.cli import main; sys.exit(main(sys.argv[1:]))"
    process = await asyncio.create_subprocess_exec(
        sys.executable, "-c", code, "ground", "status", "--url", "udpout:127.0.0.1:9",
        stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": os.getcwd()},
    )  # fmt: skip
    said = await finish(process)
    assert said.code == USAGE
    assert said.out == ""
    assert said.err.count("\n") == 1
    assert "pip install '.[ground]'" in said.err


async def _until_said(process: asyncio.subprocess.Process, words: str) -> None:
    assert process.stderr is not None
    async with asyncio.timeout(60.0):
        while words not in (line := await process.stderr.readline()).decode():
            assert line, f"{words!r} was never said"


async def test_over_a_signed_link_with_the_key_and_with_another(tmp_path: Path) -> None:
    """MAVSDK has no signing: what it says and hears goes through ours, which the autopilot judges by pymavlink's."""
    right, wrong = tmp_path / "right.key", tmp_path / "wrong.key"
    for path, words in ((right, "a passphrase for the field"), (wrong, "another one altogether")):
        path.write_text(f"{words}\n")
        path.chmod(0o600)
    async with ground_line(tmp_path, "ardupilot", signing_key=right) as line:
        key = ("--signing-key-file", str(right))
        # The double answers whoever spoke last: one after the other.
        strange = await line.ground("cancel", "--within", "2", "--signing-key-file", str(wrong), chosen=False)
        assert strange.code == NOBODY, strange
        assert "messages dropped because of their signature:" in strange.err
        assert "other key" in strange.err
        cancelled = await line.ground("cancel", "--json", *key)
        assert (cancelled.code, cancelled.json["state"]) == (DONE, "idle"), cancelled
        status = await line.daemon.status()
        assert status is not None
        assert status["vehicle"]["signing"]["good"]
        assert status["vehicle"]["signing"]["mode"] == "require"
        for said in (cancelled, strange):
            assert "passphrase for" not in said.err + said.out

"""The simulator's command line, UDP, and its independence."""

from __future__ import annotations

import ast
import asyncio
import hashlib
import os
import re
import signal
import socket
import subprocess
import sys
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion import config
from sim.__main__ import main
from sim.hands import Hands, take_lines
from sim.imu_model import DEG_H
from sim.scenario import COMPASSES, GRADIENTERS, IMUS, demo
from sim.serve import configuration, describe, serve
from sim.station import Station, open_udp

ROOT = Path(__file__).resolve().parents[3]


def test_the_simulator_takes_nothing_from_the_science_it_judges() -> None:
    for path in sorted((ROOT / "sim").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom):
                names = [node.module or ""]
            for name in names:
                foreign = name.split(".")[0] == "companion" and name != "companion.links.mavlink.link"
                # The demonstration and the accuracy bench run the whole chain; a simulated fleet sends records.
                shows_all = path.name == "demo.py" or {"accuracy", "fleet"} & set(path.parts)
                assert not foreign or shows_all, f"{path}: {name}"


def test_the_printed_configuration_is_one_the_companion_takes(tmp_path: Path) -> None:
    scenario = demo()
    printed = configuration(scenario, directory=tmp_path, udp=("127.0.0.1", 14650))
    both = config.parse(printed, "both")
    assert both.mavlink.url == "udpin:127.0.0.1:14650"
    assert [(imu.name, imu.source) for imu in both.imu] == [("fc", "autopilot"), ("own", "serial")]
    assert both.gradienter is not None
    assert both.gradienter.port == str(tmp_path / "gradienter")
    assert both.compass is not None
    assert both.compass.protocol == "hmr3300"
    words = printed.splitlines()[0].partition("companion -c companion.toml setup ")[2].split()
    assert words == [*(str(tmp_path / name) for name in scenario.ports), "--udp", "14650"]
    devices = config.parse(configuration(scenario, directory=tmp_path, udp=None), "devices")
    assert devices.vehicle.latitude_deg == 40.0
    autopilot = config.parse(configuration(scenario, directory=None, udp=("127.0.0.1", 14650)), "autopilot")
    assert autopilot.gradienter is None


@pytest.mark.parametrize(
    ("imu", "gradienter", "compass"),
    [*product(list(IMUS)[:1], GRADIENTERS, COMPASSES), *product(IMUS, list(GRADIENTERS)[:1], list(COMPASSES)[:1])],
)
def test_the_printed_configuration_fits_every_family(tmp_path: Path, imu: str, gradienter: str, compass: str) -> None:
    scenario = demo(devices=(imu, gradienter, compass))
    printed = config.parse(configuration(scenario, directory=tmp_path, udp=None), "devices")
    assert printed.gradienter is not None
    assert printed.compass is not None
    (own,) = printed.imu
    assert (own.protocol, printed.gradienter.protocol, printed.compass.protocol) == (imu, gradienter, compass)
    served = {str(tmp_path / name) for name in scenario.ports}
    assert {own.port, printed.gradienter.port, printed.compass.port} == served
    # One name is one device on one port.
    assert (printed.gradienter.port == printed.compass.port) == (scenario.gradienter is scenario.compass)
    assert len(served) == len({imu, gradienter, compass})
    for device in scenario.ports.values():
        assert device.aircraft is scenario.aircraft


@pytest.mark.real_clock
def test_serving_everything_makes_the_ports_and_takes_them_away(tmp_path: Path) -> None:
    async def scene() -> None:
        station = Station()
        client = await open_udp(station, listen=("127.0.0.1", 0))
        started = asyncio.Event()
        serving = asyncio.create_task(serve(demo(), directory=tmp_path / "ports", udp=client.local, started=started))
        await asyncio.wait_for(started.wait(), 30.0)
        assert sorted(path.name for path in (tmp_path / "ports").iterdir()) == ["compass", "gradienter", "imu"]
        async with asyncio.timeout(30.0):
            while not station.all(mavlink.MAVLink_heartbeat_message):
                await asyncio.sleep(0.01)
        serving.cancel()
        with pytest.raises(asyncio.CancelledError):
            await serving
        assert list((tmp_path / "ports").iterdir()) == []
        client.close()
        await asyncio.sleep(0)

    asyncio.run(scene())


@pytest.mark.real_clock
def test_the_command_line_runs_says_how_to_connect_and_ends_cleanly(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "sim", "devices", "--dir", str(tmp_path / "ports"), "--pose", "1", "362", "3"]
    command += ["--without", "gradienter"]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        lines = []
        for line in process.stdout:
            lines.append(line)
            if line.startswith("height_m"):
                break
        text = "".join(lines)
        assert "pitch 1, roll 2, heading 3 deg" in text
        assert {path.name for path in (tmp_path / "ports").iterdir()} == {"imu", "compass"}
        process.send_signal(signal.SIGTERM)
        assert process.wait(timeout=60.0) == 0
    assert config.parse(text, "printed").compass is not None
    assert config.parse(text, "printed").gradienter is None
    assert list((tmp_path / "ports").iterdir()) == []


def test_the_truth_of_the_last_minute_is_what_its_readings_show_and_not_the_truth_at_the_start() -> None:
    """The z gyro of seed 0 wanders by 15 deg/h in five minutes: no calibration then agrees with the start."""
    scenario = demo()
    times = 240.0 + np.arange(6000) / 100.0
    readings = scenario.flight_controller_imus[0].read(times, 0.01)[:, :3].mean(axis=0)
    measured = (readings - scenario.aircraft.truth_at(300.0).rate_rad_s) / DEG_H
    start, now = (
        [float(each) for each in re.findall(r"gyro bias (\S+), (\S+), (\S+) deg/h", text)[0]]
        for text in (describe(scenario, devices=False, autopilot=True, t_s=t_s) for t_s in (0.0, 300.0))
    )
    # White noise of 7.1 deg/h in a second leaves 0.9 after a minute.
    assert measured == pytest.approx(now, abs=4.0)
    assert measured[2] < start[2] - 10.0


def test_mistakes_on_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for wrong in (["nonsense"], ["autopilot", "--udp", "localhost"], ["devices", "--pose", "1"]):
        with pytest.raises(SystemExit) as error:
            main(wrong)
        assert error.value.code == 2
    (tmp_path / "imu").write_text("in the way")
    assert main(["devices", "--dir", str(tmp_path)]) == 1
    assert "no symlink" in capsys.readouterr().err


@pytest.mark.real_clock
def test_an_autopilot_that_was_given_a_passphrase_speaks_and_listens_to_who_has_it() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        one.bind(("127.0.0.1", 0))
        one.settimeout(30.0)
        command = ["autopilot", "--udp", f"127.0.0.1:{one.getsockname()[1]}", "--signing", "a field of words"]
        with subprocess.Popen([sys.executable, "-m", "sim", *command], cwd=ROOT, stdout=subprocess.DEVNULL) as process:
            try:
                data = one.recv(2048)
            finally:
                process.terminate()
    key = hashlib.sha256(b"a field of words").digest()
    assert data[2] & mavlink.MAVLINK_IFLAG_SIGNED
    assert hashlib.sha256(key + data[:-6]).digest()[:6] == data[-6:]


@pytest.mark.parametrize("typed", ["", "turn 90\nleap\ntruth\n"])
async def test_hands_read_a_file_or_the_null_device_to_its_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, typed: str
) -> None:
    file = tmp_path / "typed" if typed else Path(os.devnull)
    file.write_text(typed)
    aircraft, said = demo().aircraft, list[str]()
    with file.open(encoding="utf-8") as stdin:
        monkeypatch.setattr(sys, "stdin", stdin)
        await take_lines(Hands(aircraft), aircraft, said.append, "pose at {:.0f}".format)
    assert [words.split(maxsplit=1)[0] for words in said] == (["moving", "found", "pose"] if typed else [])

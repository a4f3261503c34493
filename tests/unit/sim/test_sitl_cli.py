"""`python -m sim ardupilot | px4`: what is said when the binary is missing, dies, or lives."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from companion.config import parse
from sim.__main__ import main
from sim.sitl.cli import parser, scenario_of, vehicle_of
from sim.sitl.daemon import daemon_configuration
from sim.sitl.process import unlocked

pytestmark = pytest.mark.real_clock

# A firmware in a few lines: finds the port in its arguments as the real one does, and asks for physics.
FAKE_ARDUPILOT = f"""\
#!{sys.executable}
import socket, struct, sys, time
port = int(sys.argv[sys.argv.index("--sim-port-out") + 1])
print("arguments", *sys.argv[1:], flush=True)
peer = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
peer.connect(("127.0.0.1", port))
count = 0
while True:
    peer.send(struct.pack("<HHI16H", 18458, 1000, count, *[1000] * 16))
    peer.recv(2000)
    count += 1
    time.sleep(0.0005)
"""


def executable(path: Path, text: str) -> Path:
    path.write_text(text)
    path.chmod(0o755)
    return path


@pytest.mark.parametrize("command", ["ardupilot", "px4", "residuals"])
def test_a_missing_binary_is_one_line_that_names_it(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([command, "--binary", "/nowhere/firmware"]) == 1
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err == (
        f"python -m sim {command}: --binary: found no file /nowhere/firmware; give the path of the firmware's binary\n"
    )


@pytest.mark.parametrize("command", ["ardupilot", "px4"])
def test_the_daemons_configuration_for_a_firmware_is_one_the_daemon_takes(tmp_path: Path, command: str) -> None:
    binary = executable(tmp_path / command, "#!/bin/sh\n")
    (tmp_path / "etc" / "init.d-posix").mkdir(parents=True)
    (tmp_path / "etc" / "init.d-posix" / "rcS").touch()
    words = [command, "--binary", str(binary), "--part", "white_only"]
    arguments = parser().parse_args([*words, "--etc", str(tmp_path / "etc")] if command == "px4" else words)
    vehicle = vehicle_of(arguments, scenario_of(arguments), tmp_path / "firmware")
    config = parse(daemon_configuration(vehicle, tmp_path, "[calibration]\nmax_s = 45\n"), "companion.toml")
    assert config.calibration.max_s == 45
    assert [imu.name for imu in config.imu] == (["fc1"] if command == "ardupilot" else ["fc1", "fc2"])
    assert config.mavlink.url == vehicle.url


def test_an_instance_whose_lock_another_process_holds_is_taken(tmp_path: Path) -> None:
    path = tmp_path / "px4_lock-0"
    assert unlocked(path)
    path.touch()
    assert unlocked(path)
    # As PX4 does it: a record lock of a process that lives on.
    script = "import fcntl, sys; f = open(sys.argv[1], 'r+'); fcntl.lockf(f, fcntl.LOCK_EX); print(flush=True); input()"
    with subprocess.Popen(
        [sys.executable, "-c", script, str(path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as holder:
        assert holder.stdout is not None
        holder.stdout.readline()
        assert not unlocked(path)
        holder.communicate(b"\n")
    assert unlocked(path)


def test_it_says_how_to_connect_and_ctrl_c_ends_firmware_and_devices(tmp_path: Path) -> None:
    binary = executable(tmp_path / "arducopter", FAKE_ARDUPILOT)
    folder = tmp_path / "run"
    words = ["--binary", str(binary), "--dir", str(folder), "--udp", "127.0.0.1:14999", "--ground", "127.0.0.1:14998"]
    running = subprocess.Popen(
        [sys.executable, "-m", "sim", "ardupilot", *words, "--gyro-bias", "1", "2", "3", "--hands"],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert running.stdout is not None
    assert running.stdin is not None
    running.stdin.write("wait 0.1\ntruth\nhold 90 0\n")
    running.stdin.flush()
    said = ""
    while "[storage]" not in said or "# moving for 6 s; then pitch" not in said:
        line = running.stdout.readline()
        assert line, running.communicate()
        said += line
    assert 'url = "udpin:127.0.0.1:14999"' in said
    assert "# Ground station: listen on UDP 127.0.0.1:14998" in said
    assert "gyro bias 1.0, 2.0, 3.0 deg/h" in said
    assert re.search(
        r"^# The truth of the last minute, at \d+ s: pitch 0.6, roll -0.4, heading 40 deg", said, re.MULTILINE
    )
    process = int(said.partition("# Firmware: process ")[2].partition(",")[0])
    assert (folder / "gradienter").is_symlink()
    arguments = (folder / "firmware" / "firmware.log").read_text()
    assert "--serial0 udpclient:127.0.0.1:14998 --serial1 udpclient:127.0.0.1:14999" in arguments
    running.send_signal(signal.SIGINT)
    _, errors = running.communicate(timeout=60)
    assert running.returncode == 0
    assert errors == ""
    assert not (folder / "gradienter").exists()
    with pytest.raises(ProcessLookupError):
        os.kill(process, 0)


def test_a_firmware_does_not_outlive_a_killed_simulator(tmp_path: Path) -> None:
    binary = executable(tmp_path / "arducopter", FAKE_ARDUPILOT)
    running = subprocess.Popen(
        [sys.executable, "-m", "sim", "ardupilot", "--binary", str(binary), "--dir", str(tmp_path / "run")],
        stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert running.stdout is not None
    line = ""
    while "# Firmware: process " not in line:
        line = running.stdout.readline()
        assert line
    process = int(line.split()[3].rstrip(","))
    running.kill()
    running.communicate()
    deadline = time.monotonic() + 30.0
    while Path(f"/proc/{process}").exists() and Path(f"/proc/{process}/cmdline").read_bytes():
        assert time.monotonic() < deadline
        time.sleep(0.02)

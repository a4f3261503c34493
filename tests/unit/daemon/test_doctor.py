"""Conflicts of the system with a port, read from made-up trees; and their texts."""

from __future__ import annotations

import asyncio
import errno
import os
import sys
from pathlib import Path

import pytest

from companion.config import parse
from companion.config.sections import Config
from companion.daemon.process.check import find_law, storage_finding, system_findings
from companion.errors import LinkError
from companion.links.serial.ports import port_faults, same_ports
from tests.support.usb_tree import UsbTree

pytestmark = pytest.mark.real_clock

CONFIG = """
[mavlink]
url = "{autopilot}"
[[imu]]
name = "own"
source = "serial"
port = "{imu}"
protocol = "vectornav"
[gradienter]
port = "{gradienter}"
protocol = "inclinometer_xy"
law = "slope"
"""
FTDI_ID = "/dev/serial/by-id/usb-FTDI_FT232R_A5-if00-port0"


class CheckedBoard(UsbTree):
    """An FTDI bridge with a serial number, a CH340 without, and an on-board port; processes as a test needs them."""

    def __init__(self, root: Path) -> None:
        super().__init__(root)
        ftdi = self.device("1.1", vendor="0403", product="6001", serial="A5")
        self.serial_port(ftdi, "ttyUSB0", driver="ftdi_sio")
        ch340 = self.device("1.2", vendor="1a86", product="7523")
        self.serial_port(ch340, "ttyUSB1", driver="ch341-uart")
        self._timer("ttyUSB1").unlink()  # FTDI's own
        (root / FTDI_ID[1:]).parent.mkdir(parents=True)
        (root / FTDI_ID[1:]).symlink_to("../../ttyUSB0")
        self.on_board("ttyS0", "bcm2835-aux-uart")
        self.write("proc/cmdline", "root=/dev/mmcblk0p2 quiet\n")

    def write(self, path: str, text: str) -> None:
        file = self.root / path
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)

    def on_board(self, name: str, driver: str) -> None:
        place = f"sys/devices/platform/soc/3f215040.serial/{name}.port"
        self._node(place, "platform", {"DRIVER": driver})
        node = f"{place}/tty/{name}"
        self._node(node, "tty", {"DEVNAME": name}, dev="4:64", type="4")
        self._link(f"{node}/device", place)
        self._link(f"sys/class/tty/{name}", node)
        self.write(f"dev/{name}", "")

    def process(self, pid: int, *words: str, opened: tuple[str, ...] = ()) -> None:
        self.write(f"proc/{pid}/comm", words[0] + "\n")
        self.write(f"proc/{pid}/cmdline", "\0".join(words) + "\0")
        (self.root / f"proc/{pid}/fd").mkdir()
        for number, target in enumerate(opened):
            (self.root / f"proc/{pid}/fd/{number}").symlink_to(target)

    def timer(self, name: str, milliseconds: int) -> None:
        self._timer(name).write_text(f"{milliseconds}\n")

    def _timer(self, name: str) -> Path:
        (timer,) = (self.root / "sys/devices").rglob(f"{name}/latency_timer")
        return timer


@pytest.fixture
def board(tmp_path: Path) -> CheckedBoard:
    made = CheckedBoard(tmp_path)
    made.timer("ttyUSB0", 1)
    return made


def faults(board: CheckedBoard, port: str) -> list[str]:
    return [str(fault) for fault in port_faults(port, root=board.root)]


def config(
    imu: str = FTDI_ID,
    gradienter: str = "/dev/serial/by-path/platform-soc-usb-0:1.2:1.0-port0",
    autopilot: str = "udpin:127.0.0.1:14550",
) -> Config:
    return parse(CONFIG.format(imu=imu, gradienter=gradienter, autopilot=autopilot), "test.toml")


def test_a_board_in_order_has_nothing_to_say(board: CheckedBoard) -> None:
    assert system_findings(config(), [], board.root) == []
    board.process(412, "agetty", "--noclear", "tty1", "linux", opened=("/dev/tty1",))
    board.process(900, "companion", "run", opened=("/dev/ttyUSB0", "/dev/ttyUSB1"))
    assert system_findings(config(), [900], board.root) == []


def test_a_login_console_is_named_with_what_ends_it(board: CheckedBoard) -> None:
    board.process(412, "agetty", "-o", "-p", "--keep-baud", "115200,57600", "ttyS0", "vt220", opened=("/dev/ttyS0",))
    (line,) = [line for line in faults(board, "/dev/ttyS0") if "console" in line]
    assert line == (
        "/dev/ttyS0 carries a login console (agetty, process 412): "
        "sudo systemctl disable --now serial-getty@ttyS0.service"
    )
    board.write("proc/cmdline", "console=ttyS0,115200 console=tty1\n")
    (line,) = [line for line in faults(board, "/dev/ttyS0") if "login" in line]
    assert "(agetty, process 412)" in line
    assert "remove console=ttyS0,... from the kernel's command line" in line


def test_modem_manager_is_named_with_what_keeps_it_away(board: CheckedBoard) -> None:
    board.process(600, "ModemManager")
    assert not any("Modem" in line for line in faults(board, "/dev/ttyUSB1")), "it leaves the port alone"
    (board.root / "proc/600/fd/7").symlink_to("/dev/ttyUSB1")
    lines = faults(board, "/dev/ttyUSB1")
    assert any("/dev/ttyUSB1: in use by another program (ModemManager, process 600)" in line for line in lines)
    assert any("sudo companion service install" in line for line in lines)
    assert sum("in use" in line for line in lines) == 1, "one line is enough"


def test_a_second_reader_is_named_unless_it_is_ours(board: CheckedBoard) -> None:
    board.process(900, "companion", "run", opened=("/dev/ttyUSB0",))
    board.process(1234, "gpsd", "-n", opened=("/dev/null", "/dev/ttyUSB0"))
    found = system_findings(config(), [900], board.root)
    (finding,) = found
    assert finding.name == "own"
    assert not finding.good
    assert finding.words.startswith("/dev/ttyUSB0: in use by another program (gpsd, process 1234)")
    assert finding.remedy.startswith("sudo kill 1234, ")
    assert len(system_findings(config(), [], board.root)) == 2


def test_a_running_companion_is_named_with_how_it_is_stopped(board: CheckedBoard) -> None:
    words = ("-m", "companion.daemon", "/etc/companion/companion.toml")
    board.process(900, "python3", *words, opened=("/dev/ttyUSB0",))
    (finding,) = system_findings(config(), [], board.root)
    assert finding.words.startswith("/dev/ttyUSB0: in use by another program (the companion, process 900): ")
    assert finding.remedy == "sudo systemctl stop companion (without the service: kill 900)"


def test_the_ftdi_timer_is_wrong_for_an_imu_and_a_remark_for_a_gradienter(board: CheckedBoard) -> None:
    board.timer("ttyUSB0", 16)
    (fault,) = port_faults(FTDI_ID, is_fast=True, root=board.root)
    assert not fault.good
    assert "16 ms" in fault.words
    assert "sudo sh -c 'echo 1 > /sys/bus/usb-serial/devices/ttyUSB0/latency_timer'" in fault.remedy
    (fault,) = port_faults(FTDI_ID, root=board.root)
    assert fault.good
    (finding,) = system_findings(config(), [], board.root)
    assert (finding.name, finding.good) == ("own", False)


def test_a_name_that_changes_is_told_the_one_that_stays(board: CheckedBoard) -> None:
    (fault,) = port_faults("/dev/ttyUSB0", root=board.root)
    assert fault.good, "it works today"
    assert fault.remedy == f'set port = "{FTDI_ID}"'
    # The CH340 has no serial number: where it is plugged in is what stays.
    remedies = [fault.remedy for fault in port_faults("/dev/ttyUSB1", root=board.root) if "order of" in fault.words]
    assert remedies == ['set port = "/dev/serial/by-path/platform-soc-usb-0:1.2:1.0-port0"']


def device(name: str, speaks: str | None, trouble: str | None = "undecodable") -> dict[str, object]:
    return {"name": name, "trouble": trouble, "speaks": speaks}


def test_one_port_under_two_names(board: CheckedBoard) -> None:
    assert same_ports({"own": FTDI_ID, "gradienter": "/dev/ttyUSB0"}, board.root) == [
        ("own", "gradienter", "/dev/ttyUSB0")
    ]
    found = system_findings(config(gradienter="/dev/ttyUSB0"), [], board.root)
    assert any("own and gradienter are one and the same port, /dev/ttyUSB0" in one.words for one in found)


def test_a_machine_without_anything(tmp_path: Path) -> None:
    assert port_faults("/dev/ttyUSB0", root=tmp_path) == []
    assert system_findings(config(), [], tmp_path) == []


def test_a_full_card_is_found_before_a_calibration(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert storage_finding(tmp_path / "new" / "state").verdict == "ok"
    assert list(tmp_path.iterdir()) == []

    def full(_descriptor: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    found = storage_finding(tmp_path)
    assert (found.verdict, found.words) == ("wrong", f"{tmp_path} not usable: No space left on device")
    assert list(tmp_path.iterdir()) == []


async def test_the_test_of_the_law_is_refused_at_once_while_another_program_has_the_port() -> None:
    master, slave = os.openpty()
    port = os.ttyname(slave)
    holds = [sys.executable, "-c", "import sys; f = open(sys.argv[1]); print(flush=True); sys.stdin.read()", port]
    process = await asyncio.create_subprocess_exec(
        *holds, stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE
    )
    try:
        assert process.stdout is not None
        await process.stdout.readline()
        config = parse(CONFIG.format(autopilot="serial:/dev/none:57600", imu="/dev/nobody", gradienter=port), "test")
        with pytest.raises(LinkError, match=rf"^{port}: in use .*, process {process.pid}\): sudo kill {process.pid}"):
            await asyncio.wait_for(find_law(config, pytest.fail), 10.0)
    finally:
        process.kill()
        await process.wait()
        os.close(master)
        os.close(slave)

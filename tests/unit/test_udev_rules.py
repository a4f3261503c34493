"""The udev rules, shipped and generated, as systemd's own udev understands them."""

from __future__ import annotations

from pathlib import Path

import pytest

from companion import cli
from companion.errors import CompanionError, ConfigError
from companion.installation import install as installing
from companion.installation import udev
from companion.links.serial.ports import list_ports
from tests.support.usb_tree import UsbTree, needs_udevadm


@pytest.fixture
def tree(tmp_path: Path) -> UsbTree:
    """Two bridges of one kind without serial numbers, one with, a double one, an autopilot, a modem."""
    tree = UsbTree(tmp_path / "machine")
    for number, socket in enumerate(("1.1", "1.2")):
        tree.serial_port(tree.device(socket, vendor="1a86", product="7523"), f"ttyUSB{number}", driver="ch341")
    single = tree.device("1.3", vendor="0403", product="6001", serial='A5"0*85')
    tree.serial_port(single, "ttyUSB2", driver="ftdi_sio")
    double = tree.device("1.4", vendor="0403", product="6010", serial="FT7XYZ")
    tree.serial_port(double, "ttyUSB3", driver="ftdi_sio", interface="00")
    tree.serial_port(double, "ttyUSB4", driver="ftdi_sio", interface="01")
    autopilot = tree.device("2", vendor="1209", product="5741", serial="3A00")
    tree.serial_port(autopilot, "ttyACM0", driver="cdc_acm", interface="00")
    tree.serial_port(autopilot, "ttyACM1", driver="cdc_acm", interface="02")
    modem = tree.device("3", vendor="1e0e", product="9001", serial="0123")
    tree.serial_port(modem, "ttyUSB5", driver="option")
    # An adapter with two ports on one interface: told apart by the port's number alone.
    several = tree.device("4", vendor="110a", product="1250", serial="M0XA")
    tree.serial_port(several, "ttyUSB6", driver="mxuport", number=0)
    tree.serial_port(several, "ttyUSB7", driver="mxuport", number=1)
    return tree


@pytest.fixture
def rules(tmp_path: Path) -> Path:
    folder = tmp_path / "rules"
    folder.mkdir()
    (folder / "70-companion.rules").write_bytes(installing.content(installing.RULES))
    return folder


@needs_udevadm
def test_the_shipped_rules(tree: UsbTree, rules: Path) -> None:
    links, properties, said = tree.links(rules, "ttyACM0")
    assert "/dev/companion-autopilot" in links
    assert properties["ID_MM_DEVICE_IGNORE"] == properties["ID_MM_PORT_IGNORE"] == "1"
    complaints = [line for line in said.splitlines() if "70-companion.rules" in line and "nvalid" in line]
    assert complaints == []
    links, properties, _ = tree.links(rules, "ttyACM1")
    assert "/dev/companion-autopilot" not in links  # its second port does not speak MAVLink
    assert properties["ID_MM_DEVICE_IGNORE"] == "1"
    for bridge in ("ttyUSB0", "ttyUSB2"):
        assert tree.links(rules, bridge)[1]["ID_MM_DEVICE_IGNORE"] == "1"
    assert "ID_MM_DEVICE_IGNORE" not in tree.links(rules, "ttyUSB5")[1]  # a modem stays one


@needs_udevadm
def test_an_ftdi_bridge_does_not_wait_for_samples(tree: UsbTree, rules: Path) -> None:
    node = "/sys/devices/platform/soc/usb1/1-1.{0}/1-1.{0}:1.0/ttyUSB{1}"
    assert "/ttyUSB2/latency_timer' writing '1'" in tree.judge(rules, node.format(3, 2))
    assert "latency_timer" not in tree.judge(rules, node.format(1, 0))  # no FTDI


@needs_udevadm
@pytest.mark.parametrize("number", range(8))
def test_a_generated_rule_names_that_port_and_no_other(tree: UsbTree, rules: Path, number: int) -> None:
    ports = list_ports(tree.root)
    line, _ = udev.rule("mine", f"/dev/ttyUSB{number}", ports)
    (rules / "71-companion-devices.rules").write_text(line + "\n")
    named = [port.device for port in ports if "/dev/companion-mine" in tree.links(rules, port.device[5:])[0]]
    assert named == [f"/dev/ttyUSB{number}"]


def test_by_what_a_port_is_recognised(tree: UsbTree) -> None:
    ports = list_ports(tree.root)
    words = {port.device: udev.rule("mine", port.device, ports)[1] for port in ports}
    assert words["/dev/ttyUSB2"] == words["/dev/ttyUSB4"] == words["/dev/ttyACM0"] == "its serial number"
    assert words["/dev/ttyUSB0"].startswith("the socket it is plugged into (it has no serial number)")
    assert "/dev/ttyUSB7 has the same serial number" in words["/dev/ttyUSB6"]


def test_what_a_device_says_of_itself_cannot_break_the_rule(tree: UsbTree) -> None:
    line, _ = udev.rule("mine", "/dev/ttyUSB2", list_ports(tree.root))
    assert 'ATTRS{serial}=="A5?0?85"' in line


def test_one_clear_line_where_there_is_no_rule(tree: UsbTree, capsys: pytest.CaptureFixture[str]) -> None:
    ports = list_ports(tree.root)
    with pytest.raises(CompanionError, match="/dev/ttyUSB9: no such serial port; `companion ports` lists"):
        udev.rule("mine", "/dev/ttyUSB9", ports)
    with pytest.raises(ConfigError, match="--name: found 'My Sensor'; allowed: small letters"):
        udev.rule("My Sensor", "/dev/ttyUSB0", ports)
    assert cli.main(["udev-rule", "--port", "/dev/nowhere"]) == 1
    assert capsys.readouterr().err.count("\n") == 1

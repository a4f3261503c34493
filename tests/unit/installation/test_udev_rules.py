"""The udev rules, as shipped, as systemd's own udev understands them."""

from __future__ import annotations

from pathlib import Path

import pytest

from companion.installation import install as installing
from tests.support.usb_tree import UsbTree, needs_udevadm

pytestmark = pytest.mark.real_clock


@pytest.fixture
def tree(tmp_path: Path) -> UsbTree:
    """Two bridges of one kind without serial numbers, one with, an autopilot, a modem."""
    tree = UsbTree(tmp_path / "machine")
    for number, socket in enumerate(("1.1", "1.2")):
        tree.serial_port(tree.device(socket, vendor="1a86", product="7523"), f"ttyUSB{number}", driver="ch341")
    single = tree.device("1.3", vendor="0403", product="6001", serial='A5"0*85')
    tree.serial_port(single, "ttyUSB2", driver="ftdi_sio")
    autopilot = tree.device("2", vendor="1209", product="5741", serial="3A00")
    tree.serial_port(autopilot, "ttyACM0", driver="cdc_acm", interface="00")
    tree.serial_port(autopilot, "ttyACM1", driver="cdc_acm", interface="02")
    modem = tree.device("3", vendor="1e0e", product="9001", serial="0123")
    tree.serial_port(modem, "ttyUSB5", driver="option")
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

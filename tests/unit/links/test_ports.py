"""List of ports, read from a made-up Raspberry Pi with an FTDI, two CH340 and a flight controller."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from companion.links.serial.ports import Holder, SerialPort, find_holders, list_ports

FTDI_ID = "/dev/serial/by-id/usb-FTDI_FT232R_USB_UART_A50285BI-if00-port0"
CH340_ID = "/dev/serial/by-id/usb-1a86_USB_Serial-if00-port0"
CUBE_ID = "/dev/serial/by-id/usb-Hex_ProfiCNC_CubeOrange_1E0041-if00"


class PortsMachine:
    """A tree that looks like /sys, /dev and /proc; links are relative as the kernel's and udev's are."""

    def __init__(self, root: Path) -> None:
        self.root = root
        (root / "sys/class/tty").mkdir(parents=True)
        (root / "dev/serial").mkdir(parents=True)
        (root / "proc").mkdir()

    def write(self, path: str, text: str = "") -> None:
        file = self.root / path
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)

    def link(self, path: str, target: str) -> None:
        """A relative link at `path` to another place below the root."""
        place = self.root / path
        place.parent.mkdir(parents=True, exist_ok=True)
        (self.root / target).mkdir(parents=True, exist_ok=True) if target.startswith("sys") else None
        place.symlink_to(os.path.relpath(self.root / target, place.parent))

    def tty(self, name: str, device: str | None, driver: str | None = None, *, driver_at: str | None = None) -> None:
        """A tty of the class, the hardware it belongs to, and the driver there or further up."""
        self.write(f"dev/{name}")
        node = f"{device}/tty/{name}" if device else f"sys/devices/virtual/tty/{name}"
        self.write(f"{node}/dev", "4:64\n")
        self.link(f"sys/class/tty/{name}", node)
        if device:
            self.link(f"{node}/device", device)
        if device and driver:
            self.link(f"{driver_at or device}/driver", f"sys/bus/x/drivers/{driver}")

    def usb(self, where: str, *, vendor: str, product: str, serial: str = "", maker: str = "", words: str = "") -> str:
        place = f"sys/devices/platform/soc/usb1/{where}"
        for name, text in {
            "idVendor": vendor, "idProduct": product, "serial": serial, "manufacturer": maker, "product": words,
        }.items():  # fmt: skip
            if text:
                self.write(f"{place}/{name}", text + "\n")
        return place

    def process(self, pid: int, name: str, *opened: str) -> None:
        self.write(f"proc/{pid}/comm", name + "\n")
        (self.root / f"proc/{pid}/fd").mkdir()
        for number, target in enumerate(opened):
            (self.root / f"proc/{pid}/fd/{number}").symlink_to(target)


@pytest.fixture
def machine(tmp_path: Path) -> PortsMachine:
    pi = PortsMachine(tmp_path)
    ftdi = pi.usb("1-1.1", vendor="0403", product="6001", serial="A50285BI", maker="FTDI", words="FT232R USB UART")
    pi.tty("ttyUSB0", f"{ftdi}/1-1.1:1.0/ttyUSB0", "ftdi_sio")
    pi.write(f"{ftdi}/1-1.1:1.0/ttyUSB0/latency_timer", "16\n")
    pi.link(FTDI_ID[1:], "dev/ttyUSB0")
    pi.link("dev/serial/by-path/usb-1.1-port0", "dev/ttyUSB0")
    for number, port in ((1, "1-1.2"), (2, "1-1.3")):
        chip = pi.usb(port, vendor="1a86", product="7523", words="USB Serial")
        pi.tty(f"ttyUSB{number}", f"{chip}/{port}:1.0/ttyUSB{number}", "ch341-uart")
        pi.link(f"dev/serial/by-path/usb-{port[2:]}-port0", f"dev/ttyUSB{number}")
    pi.link(CH340_ID[1:], "dev/ttyUSB2")  # both claim it; the last one plugged in has it
    pi.link("dev/gradienter", "dev/ttyUSB1")
    cube = pi.usb("1-1.4", vendor="2dae", product="1016", serial="1E0041", maker="Hex/ProfiCNC", words="CubeOrange")
    pi.tty("ttyACM0", f"{cube}/1-1.4:1.0", "cdc_acm")
    pi.link(CUBE_ID[1:], "dev/ttyACM0")
    uart = "sys/devices/platform/soc/fe201000.serial"
    pi.tty("ttyAMA0", f"{uart}/fe201000.serial:0/fe201000.serial:0.0", "port")
    pi.link(f"{uart}/driver", "sys/bus/amba/drivers/uart-pl011")
    pi.link("dev/serial0", "dev/ttyAMA0")
    mini = "sys/devices/platform/soc/fe215040.serial"
    pi.tty("ttyS0", mini, "bcm2835-aux-uart")
    pi.write(f"{mini}/tty/ttyS0/type", "4\n")
    absent = "sys/devices/platform/serial8250"
    pi.tty("ttyS1", absent, "serial8250")
    pi.write(f"{absent}/tty/ttyS1/type", "0\n")
    pi.tty("tty1", None)
    pi.tty("ptmx", None)
    pi.write("proc/cmdline", "console=serial0,115200 console=tty1 root=/dev/mmcblk0p2\n")
    pi.process(77, "picocom", "/dev/null", "/dev/ttyUSB0", "/dev/ttyUSB0")
    pi.process(812, "gpsd", "/dev/ttyUSB1", "socket:[1]")
    pi.write("proc/self", "")
    return pi


def ports_of(machine: PortsMachine) -> dict[str, SerialPort]:
    return {port.device: port for port in list_ports(machine.root)}


def test_ports_with_hardware_are_listed_and_no_others(machine: PortsMachine) -> None:
    expected = ["/dev/ttyACM0", "/dev/ttyAMA0", "/dev/ttyS0", "/dev/ttyUSB0", "/dev/ttyUSB1", "/dev/ttyUSB2"]
    assert [port.device for port in list_ports(machine.root)] == expected


def test_everything_about_one_port(machine: PortsMachine) -> None:
    assert ports_of(machine)["/dev/ttyUSB0"] == SerialPort(
        device="/dev/ttyUSB0",
        stable_name=FTDI_ID,
        by_id=(FTDI_ID,),
        by_path=("/dev/serial/by-path/usb-1.1-port0",),
        aliases=(),
        description="FTDI FT232R USB UART",
        driver="ftdi_sio",
        vendor_id=0x0403,
        product_id=0x6001,
        serial_number="A50285BI",
        latency_timer_ms=16,
        holders=(Holder(77, "picocom"),),
        is_console=False,
    )


def test_chips_without_a_serial_number_are_named_by_their_place(machine: PortsMachine) -> None:
    ports = ports_of(machine)
    assert ports["/dev/ttyUSB1"].stable_name == "/dev/serial/by-path/usb-1.2-port0"
    assert ports["/dev/ttyUSB2"].stable_name == "/dev/serial/by-path/usb-1.3-port0"
    assert ports["/dev/ttyUSB2"].by_id == (CH340_ID,)
    assert ports["/dev/ttyUSB1"].aliases == ("/dev/gradienter",)
    assert ports["/dev/ttyUSB1"].serial_number is None
    assert ports["/dev/ttyUSB1"].latency_timer_ms is None


def test_without_udev_a_usb_port_has_no_stable_name_and_an_on_board_one_has_its_own(machine: PortsMachine) -> None:
    for link in (machine.root / "dev/serial/by-path").iterdir():
        link.unlink()
    ports = ports_of(machine)
    assert ports["/dev/ttyUSB1"].stable_name is None
    assert ports["/dev/ttyUSB2"].stable_name == CH340_ID
    assert ports["/dev/ttyAMA0"].stable_name == "/dev/ttyAMA0"


def test_the_driver_is_that_of_the_hardware(machine: PortsMachine) -> None:
    drivers = {device: port.driver for device, port in ports_of(machine).items()}
    assert drivers == {
        "/dev/ttyACM0": "cdc_acm",
        "/dev/ttyAMA0": "uart-pl011",
        "/dev/ttyS0": "bcm2835-aux-uart",
        "/dev/ttyUSB0": "ftdi_sio",
        "/dev/ttyUSB1": "ch341-uart",
        "/dev/ttyUSB2": "ch341-uart",
    }


def test_a_console_is_seen_through_its_alias(machine: PortsMachine) -> None:
    ports = ports_of(machine)
    assert [device for device, port in ports.items() if port.is_console] == ["/dev/ttyAMA0"]
    assert ports["/dev/ttyAMA0"].aliases == ("/dev/serial0",)
    assert ports["/dev/ttyAMA0"].description == "on-board port (uart-pl011)"


def test_holders_are_found_by_link_and_by_device(machine: PortsMachine) -> None:
    assert find_holders("/dev/gradienter", machine.root) == (Holder(812, "gpsd"),)
    assert find_holders(FTDI_ID, machine.root) == (Holder(77, "picocom"),)
    assert find_holders("/dev/ttyACM0", machine.root) == ()


def test_what_a_device_says_of_itself_is_cut_and_cleaned(machine: PortsMachine) -> None:
    place = "sys/devices/platform/soc/usb1/1-1.4"
    (machine.root / place / "manufacturer").write_bytes(b"\x1b[2JBad\x00\xff" + b"x" * 500)
    (machine.root / place / "idProduct").write_text("zz\n")
    port = ports_of(machine)["/dev/ttyACM0"]
    assert port.description.isprintable()
    assert port.description.startswith(r"\x1b[2JBad\x00")
    assert len(port.description) < 200
    assert port.product_id is None


def test_a_machine_without_anything_has_no_ports(tmp_path: Path) -> None:
    assert list_ports(tmp_path) == []
    assert find_holders("/dev/ttyUSB0", tmp_path) == ()


def test_this_machine_can_be_read() -> None:
    for port in list_ports():
        assert port.device.startswith("/dev/")
        assert port.description


@pytest.mark.real_clock
def test_who_holds_a_port_of_this_machine() -> None:
    master, slave = os.openpty()
    try:
        assert os.getpid() in [holder.pid for holder in find_holders(os.ttyname(slave))]
    finally:
        os.close(master)
        os.close(slave)

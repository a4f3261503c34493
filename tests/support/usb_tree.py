"""A made-up /sys with serial devices on USB, complete enough for systemd's own udev to judge rules by it."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from pathlib import Path
from typing import Final

import pytest

from tests.support.namespaces import OWN_MOUNTS, why_no_mounts

UDEVADM: Final = shutil.which("udevadm") or ""
SOC: Final = "sys/devices/platform/soc"
# In a mount namespace of its own: the tree as /sys, the rules, and a /dev in which links may be made.
_TEST: Final = """
set -e
mount -n --make-rprivate /
mount -n -t tmpfs tmpfs /run
mkdir -p /run/udev/rules.d
cp "$2"/* /run/udev/rules.d/
mount -n --bind "$1/sys" /sys
mount -n -t tmpfs tmpfs /dev
SYSTEMD_DEVICE_VERIFY_SYSFS=0 exec "$3" test --action=add "$4" 2>&1
"""


def _why_not() -> str | None:
    if not UDEVADM:
        return "udevadm is not here (Debian: apt-get install udev)"
    return why_no_mounts()


_WHY_NOT: Final = _why_not()
needs_udevadm = pytest.mark.skipif(_WHY_NOT is not None, reason=str(_WHY_NOT))


class UsbTree:
    """The tree below a root, as `companion.links.serial.ports` reads it too."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self._minor = 0
        (root / "dev/serial/by-path").mkdir(parents=True)
        (root / "proc").mkdir()
        self._node(SOC, "platform", {"DRIVER": "simple-bus"})
        self._node(f"{SOC}/usb1", "usb", {"DEVTYPE": "usb_device", "MAJOR": "189", "MINOR": "0"})

    def device(self, socket: str, *, vendor: str, product: str, serial: str | None = None) -> str:
        """Plug a device into a socket such as "1.2"; its path."""
        place = f"{SOC}/usb1/1-{socket}"
        self._minor += 1
        attributes = {"idVendor": vendor, "idProduct": product, "bcdDevice": "0100", "bDeviceClass": "00"}
        attributes |= {"serial": serial} if serial is not None else {}
        uevent = {"DEVTYPE": "usb_device", "MAJOR": "189", "MINOR": str(self._minor), "DRIVER": "usb"}
        self._node(place, "usb", uevent, **attributes)
        return place

    def serial_port(self, device: str, name: str, *, driver: str, interface: str = "00") -> None:
        """A port of a device: ttyUSB behind a bridge, ttyACM on the interface itself."""
        socket = device.rpartition("/")[2]
        here = f"{device}/{socket}:1.{int(interface)}"
        uevent = {"DEVTYPE": "usb_interface", "DRIVER": driver}
        numbers = {"bInterfaceNumber": interface, "bInterfaceClass": "ff", "bInterfaceSubClass": "ff"}
        self._node(here, "usb", uevent, **numbers, bInterfaceProtocol="ff")
        if name.startswith("ttyUSB"):
            here += f"/{name}"
            self._node(here, "usb-serial", {"DRIVER": driver}, port_number="0", latency_timer="16")
        major, minor = (188 if "USB" in name else 166), re.sub(r"\D", "", name)
        node = f"{here}/tty/{name}"
        self._node(node, "tty", {"MAJOR": str(major), "MINOR": minor, "DEVNAME": name}, dev=f"{major}:{minor}")
        self._link(f"{node}/device", here)
        self._link(f"sys/class/tty/{name}", node)
        (self.root / f"dev/{name}").touch()
        path = f"platform-soc-usb-0:{socket.partition('-')[2]}:1.{int(interface)}"
        path += "-port0" if name.startswith("ttyUSB") else ""
        (self.root / f"dev/serial/by-path/{path}").symlink_to(f"../../{name}")

    def links(self, rules: Path, name: str) -> tuple[set[str], dict[str, str], str]:
        """Run udev with the rules of a folder for a port: links, properties, and all output."""
        (node,) = (self.root / "sys/devices").rglob(f"tty/{name}")
        said = self.judge(rules, "/" + str(node.relative_to(self.root)))
        properties = dict(line.partition("=")[::2] for line in said.splitlines() if re.match(r"[A-Z_.]+=", line))
        return set(properties.get("DEVLINKS", "").split()), properties, said

    def judge(self, rules: Path, node: str) -> str:
        """Return udev's output for a node being added."""
        command = [*OWN_MOUNTS, "sh", "-c", _TEST, "sh", str(self.root), str(rules), UDEVADM, node]
        return subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True).stdout

    def _node(self, place: str, subsystem: str, uevent: dict[str, str], **attributes: str) -> None:
        folder = self.root / place
        if folder.exists() and (folder / "uevent").exists():
            return
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "uevent").write_text("".join(f"{key}={value}\n" for key, value in uevent.items()))
        for key, value in attributes.items():
            (folder / key).write_text(value + "\n")
        kind = "class" if subsystem == "tty" else "bus"
        self._link(f"{place}/subsystem", f"sys/{kind}/{subsystem}")
        if "DRIVER" in uevent:
            self._link(f"{place}/driver", f"sys/bus/{subsystem}/drivers/{uevent['DRIVER']}")

    def _link(self, place: str, target: str) -> None:
        path = self.root / place
        path.parent.mkdir(parents=True, exist_ok=True)
        (self.root / target).mkdir(parents=True, exist_ok=True)
        path.symlink_to(os.path.relpath(self.root / target, path.parent))

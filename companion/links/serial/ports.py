"""Serial ports: stable names, processes that use them, and faults such as consoles, ModemManager and slow timers.

All facts come from sysfs, /dev/serial and /proc below a `root` that a test may replace; an unreadable file shows no
fault. pyserial's list is not used, because it hides platform UARTs.
"""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from companion.formats import printable
from companion.messages import message

ROOT = Path("/")
_BY_ID, _BY_PATH = "/dev/serial/by-id/", "/dev/serial/by-path/"
_TEXT_LIMIT = 80
COMPANION: Final = "the companion"  # Name of our daemon among the programs that use a port


@dataclass(frozen=True, slots=True)
class Holder:
    pid: int
    name: str


@dataclass(frozen=True, slots=True)
class SerialPort:
    """One serial port of the system; an unknown value is None or an empty tuple."""

    device: str
    stable_name: str | None
    """Name to use in a configuration: by-id with a serial number, else by-path; None for a USB port without udev."""
    by_id: tuple[str, ...]
    by_path: tuple[str, ...]
    aliases: tuple[str, ...]
    description: str
    driver: str | None
    vendor_id: int | None
    product_id: int | None
    serial_number: str | None
    latency_timer_ms: int | None
    holders: tuple[Holder, ...]
    is_console: bool


def list_ports(root: Path = ROOT) -> list[SerialPort]:
    links = _links_by_device(root)
    holders = _holders_by_device(root)
    consoles = _consoles(root)
    return [
        _describe(root, entry, links.get(device, []), tuple(holders.get(device, ())), is_console=device in consoles)
        for entry in entries(root / "sys/class/tty")
        if _has_hardware(entry)
        for device in [f"/dev/{entry.name}"]
    ]


def find_holders(device: str, root: Path = ROOT) -> tuple[Holder, ...]:
    return tuple(_holders_by_device(root).get(resolve(root, device), ()))


def find_udp_holders(port: int, root: Path = ROOT) -> tuple[Holder, ...]:
    try:
        rows = [line.split() for line in (root / "proc/net/udp").read_text().splitlines()[1:]]
    except OSError:
        return ()
    sockets = {f"socket:[{row[9]}]" for row in rows if int(row[1].rpartition(":")[2], 16) == port}
    return tuple(one for name, holders in _holders_by_device(root).items() if name in sockets for one in holders)


def in_use(port: str, holders: Sequence[Holder]) -> str:
    """Return the message that a port is in use; `holders`: programs that use it, empty if we lack the right to see."""
    programs = ", ".join(f"{holder.name}, process {holder.pid}" for holder in holders)
    return message("port_in_use", port=port, programs=f" ({programs})" if programs else "")


def how_to_free(holder: Holder) -> str:
    """Return the command that ends a program which uses a port."""
    if holder.name == COMPANION:
        return f"sudo systemctl stop companion (without the service: kill {holder.pid})"
    return _MODEM_REMEDY if holder.name == "ModemManager" else f"sudo kill {holder.pid}, and end its service"


def _describe(
    root: Path, entry: Path, links: list[str], holders: tuple[Holder, ...], *, is_console: bool
) -> SerialPort:
    hardware = (entry / "device").resolve()
    usb = _node_with(root, hardware, "idVendor")
    serial_number = read_attribute(usb / "serial") if usb else None
    by_id, by_path = (tuple(link for link in links if link.startswith(folder)) for folder in (_BY_ID, _BY_PATH))
    # All chips of a model without serial numbers (CH340, PL2303) claim the same by-id name; the last one gets it.
    names = by_id + by_path if serial_number else by_path + by_id
    driver = _driver(hardware)
    description = f"on-board port ({driver})" if driver else "on-board port"
    if usb:
        words = [read_attribute(usb / "manufacturer"), read_attribute(usb / "product")]
        description = " ".join(word for word in words if word) or "USB device"
    return SerialPort(
        device=f"/dev/{entry.name}",
        stable_name=names[0] if names else None if usb else f"/dev/{entry.name}",
        by_id=by_id,
        by_path=by_path,
        aliases=tuple(link for link in links if not link.startswith("/dev/serial/")),
        description=description,
        driver=driver,
        vendor_id=_number(usb / "idVendor", 16) if usb else None,
        product_id=_number(usb / "idProduct", 16) if usb else None,
        serial_number=serial_number,
        latency_timer_ms=_number(hardware / "latency_timer", 10),
        holders=holders,
        is_console=is_console,
    )


def _has_hardware(entry: Path) -> bool:
    """Check that a tty has hardware: virtual consoles and ptys have no device, absent ports of 8250 have type 0."""
    return (entry / "device").exists() and _number(entry / "type", 10) != 0


def _driver(hardware: Path) -> str | None:
    """Return the name of a port's driver; newer kernels insert two nodes of the serial core in the path."""
    for node in (hardware, *hardware.parents[:2]):
        link = node / "driver"
        if link.is_symlink() and link.resolve().name not in ("port", "ctrl"):
            return link.resolve().name
    return None


def _node_with(root: Path, hardware: Path, attribute: str) -> Path | None:
    for node in (hardware, *hardware.parents):
        if node == root.resolve():
            return None
        if (node / attribute).exists():
            return node
    return None


def _links_by_device(root: Path) -> dict[str, list[str]]:
    found: dict[str, list[str]] = {}
    for folder in ("dev/serial/by-id", "dev/serial/by-path", "dev"):
        for entry in entries(root / folder):
            if entry.is_symlink():
                name = f"/{folder}/{entry.name}"
                found.setdefault(resolve(root, name), []).append(name)
    return found


def resolve(root: Path, name: str) -> str:
    """Follow the symbolic links of a device name below `root`; return the device's path without `root`."""
    for _ in range(8):
        path = root / name.lstrip("/")
        try:
            target = os.readlink(path)
        except OSError:
            break
        name = os.path.normpath(os.path.join(os.path.dirname(name), target))
    return name


def _holders_by_device(root: Path) -> dict[str, list[Holder]]:
    found: dict[str, list[Holder]] = {}
    for process in entries(root / "proc"):
        if not process.name.isdigit():
            continue
        seen = set()
        for descriptor in entries(process / "fd"):  # another user's is unreadable, hence empty
            try:
                target = os.readlink(descriptor)
            except OSError:
                continue
            if target.startswith(("/dev/", "socket:")) and target not in seen:
                seen.add(target)
                found.setdefault(target, []).append(Holder(int(process.name), _name(process)))
    return found


def _name(process: Path) -> str:
    if "companion.daemon" in (read_attribute(process / "cmdline", limit=4096) or ""):
        return COMPANION  # the kernel names it after its Python
    return read_attribute(process / "comm") or "?"


def _consoles(root: Path) -> set[str]:
    words = (read_attribute(root / "proc/cmdline", limit=4096) or "").split()
    names = [word.removeprefix("console=").split(",")[0] for word in words if word.startswith("console=")]
    return {resolve(root, f"/dev/{name}") for name in names}


def entries(folder: Path) -> Iterator[Path]:
    """Yield the entries of a folder, sorted by name; nothing if the folder cannot be read."""
    try:
        yield from sorted(folder.iterdir())
    except OSError:
        return


def read_attribute(path: Path, limit: int = _TEXT_LIMIT) -> str | None:
    """Read a one-line sysfs or procfs file, shortened and made printable, as a device may report any text."""
    try:
        raw = path.read_bytes()[:limit]
    except OSError:
        return None
    return printable(raw.decode("utf-8", "replace").strip()) or None


def _number(path: Path, base: int) -> int | None:
    try:
        return int(read_attribute(path) or "", base)
    except ValueError:
        return None


SLOW_TIMER_MS: Final = 1
_GETTY: Final = re.compile(r"a?getty|login|mgetty|getty")
_MODEM_REMEDY: Final = "sudo companion service install (its udev rule), or: sudo systemctl disable --now ModemManager"
_PASSING: Final = re.compile(r"/dev/tty(USB|ACM)\d+")


@dataclass(frozen=True, slots=True)
class PortFault:
    """One fault of a port as text, and the command that repairs it; `good`: only a warning."""

    words: str
    remedy: str
    good: bool = False  # True: a warning

    def __str__(self) -> str:
        return f"{self.words}: {self.remedy}"


def port_faults(
    port: str, *, is_fast: bool = False, ours: Sequence[int] = (), among: Sequence[SerialPort] | None = None,
    root: Path = ROOT,
) -> list[PortFault]:  # fmt: skip
    """List a port's faults, worst first. `is_fast`: it has an IMU; `ours`: our process ids; `among`: all ports."""
    device = resolve(root, port)
    ports = list_ports(root) if among is None else among
    found = next((one for one in ports if one.device == device), None)
    holders = [] if found is None else [holder for holder in found.holders if holder.pid not in ours]
    faults = [*_console(device, found, holders, root)]
    for holder in holders:
        if not _GETTY.fullmatch(holder.name):
            faults.append(PortFault(in_use(device, [holder]), how_to_free(holder)))
    if found is None:
        return faults
    if found.latency_timer_ms is not None and found.latency_timer_ms > SLOW_TIMER_MS:
        name = device.removeprefix("/dev/")
        words = message("usb_bridge_delays", port=device, milliseconds=found.latency_timer_ms)
        remedy = (
            f"sudo sh -c 'echo 1 > /sys/bus/usb-serial/devices/{name}/latency_timer'"
            " (for good: sudo companion service install)"
        )
        faults.append(PortFault(words, remedy, good=not is_fast))
    if _PASSING.fullmatch(port):
        stable = found.stable_name
        remedy = f'set port = "{stable}"' if stable is not None else "set up udev, which gives permanent names"
        faults.append(PortFault(message("port_name_changes", port=port), remedy, good=True))
    return faults


def same_ports(configured: dict[str, str], root: Path = ROOT) -> list[tuple[str, str, str]]:
    """List the pairs of configuration entries whose two port names are one device, and this device."""
    seen: dict[str, str] = {}
    found = []
    for name, port in configured.items():
        device = resolve(root, port)
        if device in seen and configured[seen[device]] != port:
            found.append((seen[device], name, device))
        seen.setdefault(device, name)
    return found


def _console(device: str, port: SerialPort | None, holders: Sequence[Holder], root: Path) -> Iterator[PortFault]:
    name = device.removeprefix("/dev/")
    disable = f"sudo systemctl disable --now serial-getty@{name}.service"
    boot = f"remove console={name},... from the kernel's command line (cmdline.txt), then a reboot"
    is_console = port is not None and port.is_console
    # Another user's process can be recognised by its command line only.
    gettys = [holder for holder in holders if _GETTY.fullmatch(holder.name)] or list(_gettys_on(name, root))
    if gettys:
        console = f"a login console ({gettys[0].name}, process {gettys[0].pid})"
        remedy = f"{disable} and {boot}" if is_console else disable
        yield PortFault(message("console_on_the_port", port=device, console=console), remedy)
    elif is_console:
        words = message("console_on_the_port", port=device, console="kernel messages")
        yield PortFault(words, f"{boot}; {disable}")


def _gettys_on(name: str, root: Path) -> Iterator[Holder]:
    for entry in entries(root / "proc"):
        comm = read_attribute(entry / "comm") if entry.name.isdigit() else None
        if comm is None or not _GETTY.fullmatch(comm):
            continue
        with contextlib.suppress(OSError):
            words = (entry / "cmdline").read_bytes()[:4096].decode(errors="replace").split("\0")
            if any(word.removeprefix("/dev/") == name for word in words):
                yield Holder(int(entry.name), comm)

"""Serial ports, their stable names, and who holds them: for `companion ports`.

Read from sysfs, /dev/serial and /proc below a `root` that a test may replace. pyserial's list hides platform UARTs.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from companion.printable import printable

ROOT = Path("/")
_BY_ID, _BY_PATH = "/dev/serial/by-id/", "/dev/serial/by-path/"
_TEXT_LIMIT = 80


@dataclass(frozen=True, slots=True)
class Holder:
    """A process that has the port open."""

    pid: int
    name: str


@dataclass(frozen=True, slots=True)
class SerialPort:
    """One serial port as found; what is unknown is None, or an empty tuple."""

    device: str
    stable_name: str | None
    """The name for a configuration: by-id with a serial number, else by-path; None for a USB port without udev."""
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
    """All serial ports with hardware behind them, by device name."""
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
    """List the processes that have a port open; `device` may be a link."""
    return tuple(_holders_by_device(root).get(resolve(root, device), ()))


def _under(folder: str, links: list[str]) -> tuple[str, ...]:
    return tuple(link for link in links if link.startswith(folder))


def _best_first(by_id: tuple[str, ...], by_path: tuple[str, ...], serial_number: str | None) -> tuple[str, ...]:
    """Chips without a serial number (CH340, PL2303) of one kind all claim the same by-id name; the last one gets it."""
    return by_id + by_path if serial_number else by_path + by_id


def _describe(
    root: Path, entry: Path, links: list[str], holders: tuple[Holder, ...], *, is_console: bool
) -> SerialPort:
    hardware = (entry / "device").resolve()
    usb = _node_with(root, hardware, "idVendor")
    serial_number = read_attribute(usb / "serial") if usb else None
    by_id, by_path = _under(_BY_ID, links), _under(_BY_PATH, links)
    names = _best_first(by_id, by_path, serial_number)
    driver = _driver(hardware)
    return SerialPort(
        device=f"/dev/{entry.name}",
        stable_name=names[0] if names else None if usb else f"/dev/{entry.name}",
        by_id=by_id,
        by_path=by_path,
        aliases=tuple(link for link in links if not link.startswith("/dev/serial/")),
        description=_usb_description(usb) if usb else f"on-board port ({driver})" if driver else "on-board port",
        driver=driver,
        vendor_id=_number(usb / "idVendor", 16) if usb else None,
        product_id=_number(usb / "idProduct", 16) if usb else None,
        serial_number=serial_number,
        latency_timer_ms=_number(hardware / "latency_timer", 10),
        holders=holders,
        is_console=is_console,
    )


def _has_hardware(entry: Path) -> bool:
    """Virtual consoles and ptys have no device; the 8250 driver registers ports that are not there as type 0."""
    return (entry / "device").exists() and _number(entry / "type", 10) != 0


def _driver(hardware: Path) -> str | None:
    """The driver that serves the hardware; newer kernels put two nodes of the serial core's own in between."""
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


def _usb_description(usb: Path) -> str:
    words = [read_attribute(usb / "manufacturer"), read_attribute(usb / "product")]
    found = " ".join(word for word in words if word)
    return found or "USB device"


def _links_by_device(root: Path) -> dict[str, list[str]]:
    found: dict[str, list[str]] = {}
    for folder in ("dev/serial/by-id", "dev/serial/by-path", "dev"):
        for entry in entries(root / folder):
            if entry.is_symlink():
                name = f"/{folder}/{entry.name}"
                found.setdefault(resolve(root, name), []).append(name)
    return found


def resolve(root: Path, name: str) -> str:
    """The device that a name leads to, without `root`: links are followed below it, relative and absolute ones."""
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
            if target.startswith("/dev/") and target not in seen:
                seen.add(target)
                holder = Holder(int(process.name), read_attribute(process / "comm") or "?")
                found.setdefault(target, []).append(holder)
    return found


def _consoles(root: Path) -> set[str]:
    words = (read_attribute(root / "proc/cmdline", limit=4096) or "").split()
    names = [word.removeprefix("console=").split(",")[0] for word in words if word.startswith("console=")]
    return {resolve(root, f"/dev/{name}") for name in names}


def entries(folder: Path) -> Iterator[Path]:
    """Yield the entries of a folder by name; none where it cannot be read."""
    try:
        yield from sorted(folder.iterdir())
    except OSError:
        return


def read_attribute(path: Path, limit: int = _TEXT_LIMIT) -> str | None:
    """A one-line attribute; what a device says of itself is cut and cleaned before anyone prints it."""
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

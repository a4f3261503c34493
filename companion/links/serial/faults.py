"""What the system itself has against a serial port: consoles, ModemManager, other readers, slow timers, names.

Read from /sys and /proc below a `root` that a test may replace. What cannot be looked into says nothing.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from companion.links.serial.ports import ROOT, Holder, SerialPort, entries, list_ports, read_attribute, resolve

SLOW_TIMER_MS: Final = 1
_GETTY: Final = re.compile(r"a?getty|login|mgetty|getty")
_PASSING: Final = re.compile(r"/dev/tty(USB|ACM)\d+")


@dataclass(frozen=True, slots=True)
class PortFault:
    """One thing that is wrong with a port: in words, and what to type against it."""

    words: str
    remedy: str
    good: bool = False

    def __str__(self) -> str:
        return f"{self.words}: {self.remedy}"


def port_faults(
    port: str, *, is_fast: bool = False, ours: Sequence[int] = (), among: Sequence[SerialPort] | None = None,
    root: Path = ROOT,
) -> list[PortFault]:  # fmt: skip
    """List the faults of a port, worst first. `is_fast`: an IMU; `ours`: our processes; `among`: all ports."""
    device = resolve(root, port)
    ports = list_ports(root) if among is None else among
    found = next((one for one in ports if one.device == device), None)
    holders = [] if found is None else [holder for holder in found.holders if holder.pid not in ours]
    faults = [*_console(device, found, holders, root)]
    faults += [_second_reader(device, holder) for holder in holders if not _GETTY.fullmatch(holder.name)]
    if found is None:
        return faults
    if found.latency_timer_ms is not None and found.latency_timer_ms > SLOW_TIMER_MS:
        name = device.removeprefix("/dev/")
        words = f"the FTDI bridge collects bytes for {found.latency_timer_ms} ms, samples come in bunches"
        remedy = (
            f"sudo sh -c 'echo 1 > /sys/bus/usb-serial/devices/{name}/latency_timer'"
            " (for good: sudo companion install-service)"
        )
        faults.append(PortFault(words, remedy, good=not is_fast))
    if _PASSING.fullmatch(port):
        stable = found.stable_name
        remedy = f'set port = "{stable}"' if stable is not None else "start udev, which gives a name that stays"
        faults.append(PortFault(f"the name {port} changes with the order of plugging", remedy, good=True))
    return faults


def same_ports(configured: dict[str, str], root: Path = ROOT) -> list[tuple[str, str, str]]:
    """Pairs of names whose ports are one device under two names, and that device."""
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
    # Another user's process shows by its command line only.
    gettys = [holder for holder in holders if _GETTY.fullmatch(holder.name)] or list(_gettys_on(name, root))
    if gettys:
        who = f"{gettys[0].name}, process {gettys[0].pid}"
        remedy = f"{disable} and {boot}" if is_console else disable
        yield PortFault(f"a login console runs on {device} ({who})", remedy)
    elif is_console:
        yield PortFault(f"the kernel's messages go to {device}", f"{boot}; {disable}")


def _gettys_on(name: str, root: Path) -> Iterator[Holder]:
    for entry in entries(root / "proc"):
        comm = read_attribute(entry / "comm") if entry.name.isdigit() else None
        if comm is None or not _GETTY.fullmatch(comm):
            continue
        with contextlib.suppress(OSError):
            words = (entry / "cmdline").read_bytes()[:4096].decode(errors="replace").split("\0")
            if any(word.removeprefix("/dev/") == name for word in words):
                yield Holder(int(entry.name), comm)


def _second_reader(device: str, holder: Holder) -> PortFault:
    pid = holder.pid
    if holder.name == "ModemManager":
        return PortFault(
            f"ModemManager (process {pid}) has {device} open, and sends commands to it",
            "sudo companion install-service (its udev rule), or: sudo systemctl disable --now ModemManager",
        )
    words = f"{holder.name} (process {pid}) has {device} open too: each of two readers gets a part of the bytes"
    return PortFault(words, f"end it (sudo kill {pid}), and what starts it")

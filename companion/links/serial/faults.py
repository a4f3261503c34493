"""What the system itself has against a serial port: consoles, ModemManager, other readers, slow timers, names.

Read from /sys, /proc, /etc and /run below a `root` that a test may replace. What cannot be looked into says nothing.
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
_USUAL_MODEMS_FREE: Final = ("ID_MM_DEVICE_IGNORE", "ID_MM_PORT_IGNORE", "ID_MM_TTY_BLACKLIST")
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
    faults = [*_console(device, found, holders, root), *_modem_manager(device, found, holders, root)]
    said = {holder.pid for holder in holders if _GETTY.fullmatch(holder.name) or holder.name == "ModemManager"}
    faults += [_second_reader(device, holder) for holder in holders if holder.pid not in said]
    if found is None:
        return faults
    return [*faults, *_timer(found, is_fast=is_fast), *_name(port, found)]


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
    holding = {holder.pid: holder.name for holder in holders if _GETTY.fullmatch(holder.name)}
    asked = {pid: comm for pid, comm, words in _processes(root) if _GETTY.fullmatch(comm) and name in words}
    boot = f" and remove console={name},... from the kernel's command line (cmdline.txt), then a reboot"
    for pid, comm in {**holding, **asked}.items():
        yield PortFault(
            f"a login console runs on {device} ({comm}, process {pid})",
            f"sudo systemctl disable --now serial-getty@{name}.service"
            + (boot if port is not None and port.is_console else ""),
        )
        return
    if port is not None and port.is_console:
        yield PortFault(
            f"the kernel's messages go to {device}",
            f"remove console={name},... from the kernel's command line (cmdline.txt), then a reboot; "
            f"sudo systemctl disable --now serial-getty@{name}.service",
        )


def _modem_manager(device: str, port: SerialPort | None, holders: Sequence[Holder], root: Path) -> Iterator[PortFault]:
    pid = next((pid for pid, comm, _ in _processes(root) if comm == "ModemManager"), None)
    if pid is None or port is None:
        return
    remedy = (
        "keep it away by the udev rule of sudo companion install-service, or: sudo systemctl disable --now ModemManager"
    )
    if any(holder.pid == pid for holder in holders):
        yield PortFault(f"ModemManager (process {pid}) has {device} open, and sends commands to it", remedy)
        return
    known = _udev_properties(device, root)
    if (
        port.vendor_id is not None
        and known is not None
        and not any(known.get(key) == "1" for key in _USUAL_MODEMS_FREE)
    ):
        yield PortFault(f"ModemManager (process {pid}) may take {device} for a modem and send commands to it", remedy)


def _second_reader(device: str, holder: Holder) -> PortFault:
    return PortFault(
        f"{holder.name} (process {holder.pid}) has {device} open too: each of two readers gets a part of the bytes",
        f"end it (sudo kill {holder.pid}), and what starts it",
    )


def _timer(port: SerialPort, *, is_fast: bool) -> Iterator[PortFault]:
    if port.latency_timer_ms is not None and port.latency_timer_ms > SLOW_TIMER_MS:
        name = port.device.removeprefix("/dev/")
        yield PortFault(
            f"the FTDI bridge collects bytes for {port.latency_timer_ms} ms, samples come in bunches",
            f"sudo sh -c 'echo 1 > /sys/bus/usb-serial/devices/{name}/latency_timer'"
            " (for good: sudo companion install-service)",
            good=not is_fast,
        )


def _name(port: str, found: SerialPort) -> Iterator[PortFault]:
    if not _PASSING.fullmatch(port):
        return
    remedy = "start udev, which gives a name that stays"
    if found.stable_name is not None:
        remedy = f'set port = "{found.stable_name}"'
    yield PortFault(f"the name {port} changes with the order of plugging", remedy, good=True)


def _processes(root: Path) -> Iterator[tuple[int, str, tuple[str, ...]]]:
    for entry in entries(root / "proc"):
        if not entry.name.isdigit() or (comm := read_attribute(entry / "comm")) is None:
            continue
        words: list[str] = []
        with contextlib.suppress(OSError):
            words = (entry / "cmdline").read_bytes()[:4096].decode(errors="replace").split("\0")
        yield int(entry.name), comm, tuple(word.removeprefix("/dev/") for word in words)


def _udev_properties(device: str, root: Path) -> dict[str, str] | None:
    try:
        number = (root / "sys/class/tty" / device.removeprefix("/dev/") / "dev").read_text().strip()
        lines = (root / f"run/udev/data/c{number}").read_text(errors="replace").splitlines()
    except OSError:
        return None
    return dict(line[2:].partition("=")[::2] for line in lines if line.startswith("E:"))

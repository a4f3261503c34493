"""What is wrong with a sensor, and what to type: `companion check` asks this where no good samples come."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from companion.config.sections import Config
from companion.configured.models import serial_devices
from companion.errors import LinkError
from companion.links.serial.faults import port_faults, same_ports, unnamed
from companion.links.serial.listening import Heard, listen
from companion.links.serial.ports import ROOT, list_ports
from companion.links.system.request import Object
from companion.protocols.guess import Line
from companion.protocols.registry import PROTOCOLS, Kind, main_kind

STOP_FIRST: Final = "to try other speeds: sudo systemctl stop companion, then companion check again"
_TO_BE_TRIED: Final = ("undecodable", "damaged")


@dataclass(frozen=True, slots=True)
class Configured:
    """One of our own sensors as the configuration has it."""

    name: str
    kind: Kind
    port: str
    protocol: str
    line: Line

    @property
    def section(self) -> str:
        """Where its keys stand."""
        return f'[[imu]] "{self.name}"' if self.kind == "imu" else f"[{self.kind}]"

    @property
    def is_serial(self) -> bool:
        """Whether it is on a port of this machine."""
        return self.port.startswith("/")


@dataclass(frozen=True, slots=True)
class Finding:
    """One line of the check: whose, whether all is well, in words, what to type (empty: nothing), and of which port."""

    name: str
    good: bool
    words: str
    remedy: str = ""
    port: str = ""


def configured_sensors(config: Config) -> list[Configured]:
    """Our own sensors; one that serves several sections once, under its first."""
    return [
        Configured(device.name, device.roles[0].kind, device.port, device.info.name, Line(device.baud, device.parity))
        for device in serial_devices(config)
    ]


def _ports(config: Config) -> dict[str, str]:
    """Ports of this machine, by the names of those that use them."""
    ports = {sensor.name: sensor.port for sensor in configured_sensors(config) if sensor.is_serial}
    if config.mavlink.url.startswith("serial:"):
        ports["autopilot"] = config.mavlink.url.removeprefix("serial:").rpartition(":")[0]
    return ports


def where_it_may_be(config: Config, root: Path = ROOT) -> Finding | None:
    """Where a device may be whose port is not there; None where nothing else is plugged in."""
    free = unnamed(list_ports(root), list(_ports(config).values()), root)
    if not free:
        return None
    words = f"nobody names {', '.join(free)}: companion ports --listen tells who speaks there"
    return Finding("ports", good=False, words=words, remedy="companion ports --listen")


def system_findings(config: Config, ours: Sequence[int], root: Path = ROOT) -> list[Finding]:
    """What the system has against the configured ports."""
    sensors = configured_sensors(config)
    ports = _ports(config)
    among = list_ports(root)
    fast = {sensor.name for sensor in sensors if sensor.kind == "imu"}
    found = [
        Finding(name, fault.good, str(fault), fault.remedy, port)
        for name, port in ports.items()
        for fault in port_faults(port, is_fast=name in fast, ours=ours, among=among, root=root)
    ]
    for first, second, device in same_ports(ports, root):
        words = f"{first} and {second} are one and the same port, {device}"
        found.append(Finding(second, good=False, words=f"{words}: give each its own", remedy="", port=device))
    return found


async def sensor_findings(config: Config, status: Object, *, may_listen: bool) -> list[Finding]:
    """Why no good samples come from a sensor, as far as its bytes tell.

    Args:
        config: what was believed.
        status: of a daemon, or of a check that has just listened.
        may_listen: no daemon runs, so that ports may be tried at other settings.
    """
    devices = {device["name"]: device for device in status["devices"]}
    sick = [
        sensor for sensor in configured_sensors(config) if devices.get(sensor.name, {}).get("trouble") in _TO_BE_TRIED
    ]
    tried: dict[str, Heard | str] = {}
    if may_listen:
        serial = [sensor for sensor in sick if sensor.is_serial]
        heard = await asyncio.gather(*(_try(sensor) for sensor in serial))
        tried = dict(zip((sensor.name for sensor in serial), heard, strict=True))
    speaks = {sensor.name: _protocol_heard(sensor, devices[sensor.name], tried) for sensor in sick}
    swapped = _swapped(sick, speaks)
    found = [
        Finding(
            "ports",
            good=False,
            words=f"{a.name}'s port speaks {speaks[a.name]}, {b.name}'s port speaks {speaks[b.name]}: "
            "swap the two port lines",
            remedy=f'in {a.section} port = "{b.port}"; in {b.section} port = "{a.port}"',
            port=a.port,
        )
        for a, b in swapped
    ]
    done = {sensor.name for pair in swapped for sensor in pair}
    for sensor in sick:
        if sensor.name not in done:
            found += _explain(sensor, devices[sensor.name], tried.get(sensor.name), may_listen=may_listen)
    return found


async def _try(sensor: Configured) -> Heard | str:
    try:
        return await listen(sensor.port, [sensor.line])
    except LinkError as error:
        return str(error)


def _protocol_heard(sensor: Configured, device: Object, tried: Mapping[str, Heard | str]) -> str | None:
    heard = tried.get(sensor.name)
    if isinstance(heard, Heard) and heard.candidate is not None:
        return heard.candidate.protocol
    speaks = device.get("speaks")
    return speaks if isinstance(speaks, str) else None


def _swapped(sick: Sequence[Configured], speaks: Mapping[str, str | None]) -> list[tuple[Configured, Configured]]:
    return [
        (a, b)
        for number, a in enumerate(sick)
        for b in sick[number + 1 :]
        if a.protocol != b.protocol and speaks[a.name] == b.protocol and speaks[b.name] == a.protocol
    ]


def _explain(sensor: Configured, device: Object, heard: Heard | str | None, *, may_listen: bool) -> list[Finding]:
    def bad(words: str, remedy: str = "") -> list[Finding]:
        said = f"{words}: {remedy}" if remedy else words
        return [Finding(sensor.name, good=False, words=said, remedy=remedy, port=sensor.port)]

    if isinstance(heard, str):
        return []  # its device's own line has said so
    if heard is None:
        speaks = device.get("speaks")
        if isinstance(speaks, str):
            return bad(*_other_protocol(sensor, speaks))
        if sensor.is_serial and not may_listen:
            return bad("it may be set to another speed or parity", STOP_FIRST)
        return []
    if heard.stranger is not None:
        return bad(f"who speaks on {sensor.port} ({heard.line}) is {heard.stranger}", "another port, or unplug it")
    if heard.candidate is None or heard.line is None:
        if not heard.bytes_heard:
            return []
        return bad(f"{heard.bytes_heard} bytes came, and at no usual speed anything known", "wire, levels, protocol?")
    lines = _line_keys(sensor, heard.line)
    if heard.candidate.protocol == sensor.protocol:
        if not lines:
            return []
        return bad(f"it sends at {heard.line}, not {sensor.line}", f"set {' and '.join(lines)} in {sensor.section}")
    words, remedy = _other_protocol(sensor, heard.candidate.protocol)
    return bad(words, f"{remedy} with {' and '.join(lines)}" if lines else remedy)


def _line_keys(sensor: Configured, line: Line) -> list[str]:
    keys = []
    if line.baud != sensor.line.baud:
        keys.append(f"baud = {line.baud}")
    if line.parity != sensor.line.parity:
        keys.append(f'parity = "{line.parity}"')
    return keys


def _other_protocol(sensor: Configured, protocol: str) -> tuple[str, str]:
    change = f'set protocol = "{protocol}" in {sensor.section}'
    main, right = main_kind(protocol), f"give {sensor.section} the port of the {sensor.kind}"
    if main == sensor.kind:
        return f"this is {protocol}, not {sensor.protocol}", change
    if protocol in PROTOCOLS[sensor.kind]:
        return f"this is {protocol}, a device for {main}", f"{right}; or, to make do with it as {sensor.kind}, {change}"
    return f"this is {protocol}, a device for {main}", right

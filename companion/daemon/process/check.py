"""`companion check`: tests whether everything configured answers, and lists faults with the remedy to type.

The check asks a running daemon, which has the ports open; without a daemon it opens every port and reads for a while.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

import msgspec
import numpy as np

from companion.autopilot.firmware.firmwares import port_needs
from companion.config.sections import UNKNOWN, Config, Imu
from companion.configured.models import SerialDevice, baud_of, doubtful_settings, ineffective_settings, serial_devices
from companion.daemon.interfaces.control import process_behind
from companion.daemon.process.service import Service
from companion.errors import CalibrationRefusedError, DaemonDeniedError, DaemonUnreachableError
from companion.formats import Object
from companion.links.serial.listening import Heard, listen_to_all, refuse_if_held
from companion.links.serial.ports import ROOT, list_ports, port_faults, same_ports
from companion.links.system.connection import ask
from companion.messages import message
from companion.physics.gradienter import Law
from companion.protocols.guess import Line
from companion.protocols.registry import PROTOCOLS, main_kind
from companion.setup.law import Tilt, TiltTest, law_of

STOP_FIRST: Final = "to try other speeds: sudo systemctl stop companion, then companion check again"
ONLY_CHECKING: Final = "only a check is running: start companion run"
LOST_S: Final = 5.0
HEARTBEAT_WITHIN_S: Final = 4.0
IMUS_MOST_S: Final = 30.0
"""Longest wait until an autopilot's IMUs are known: enough for all retries on a slow line that loses packets."""
TRIED_BYTES: Final = 2**20  # Size of the file by which the check tries the storage
GONE_S: Final = 3  # Without a reading of the gradienter for so long, the guided test asks to tilt back
TILTS_WITHIN_S: Final = 120.0  # Longest wait for the two tilts of the gradienter's test
_TO_BE_TRIED: Final = ("undecodable", "damaged")


@dataclass(frozen=True, slots=True)
class CheckLine:
    """One line of the check; `remedy`: the action to take, if any."""

    name: str
    good: bool
    words: str
    remedy: str = ""

    @property
    def verdict(self) -> Literal["ok", "warning", "wrong"]:
        if not self.good:
            return "wrong"
        return "warning" if self.remedy or self.name == "warning" else "ok"


def _section(sensor: SerialDevice) -> str:
    return f'[[imu]] "{sensor.name}"' if sensor.kind == "imu" else f"[{sensor.kind}]"


def _ports(config: Config) -> dict[str, str]:
    ports = {sensor.name: sensor.port for sensor in serial_devices(config) if not sensor.settings.is_tcp}
    if config.mavlink.url.startswith("serial:"):
        ports["autopilot"] = config.mavlink.url.removeprefix("serial:").rpartition(":")[0]
    return ports


def system_findings(config: Config, ours: Sequence[int], root: Path = ROOT) -> list[CheckLine]:
    ports = _ports(config)
    among = list_ports(root)
    fast = {sensor.name for sensor in serial_devices(config) if sensor.kind == "imu"}
    found = [
        CheckLine(name, fault.good, str(fault), fault.remedy)
        for name, port in ports.items()
        for fault in port_faults(port, is_fast=name in fast, ours=ours, among=among, root=root)
    ]
    for first, second, device in same_ports(ports, root):
        words = message("ports_are_one", first=first, second=second, port=device)
        found.append(CheckLine(second, good=False, words=words))
    return found


async def sensor_findings(config: Config, status: Object, *, may_listen: bool) -> list[CheckLine]:
    """Explain, from received bytes, why sensors give no good samples; `may_listen`: no daemon has the ports open."""
    devices = {device["name"]: device for device in status["devices"]}
    sick = [sensor for sensor in serial_devices(config) if devices.get(sensor.name, {}).get("trouble") in _TO_BE_TRIED]
    tried: dict[str, Heard | str] = {}
    if may_listen:
        lines = {sensor.port: [sensor.line] for sensor in sick if not sensor.settings.is_tcp}
        heard = await listen_to_all(list(lines), lines.__getitem__)
        tried = {sensor.name: heard[sensor.port] for sensor in sick if sensor.port in heard}
    return [
        finding
        for sensor in sick
        for finding in _explain(sensor, devices[sensor.name], tried.get(sensor.name), may_listen=may_listen)
    ]


def _explain(sensor: SerialDevice, device: Object, heard: Heard | str | None, *, may_listen: bool) -> list[CheckLine]:
    def bad(words: str, remedy: str = "") -> list[CheckLine]:
        return [CheckLine(sensor.name, good=False, words=f"{words}: {remedy}" if remedy else words, remedy=remedy)]

    if isinstance(heard, str):
        return []  # the status line of the device reports it
    if heard is None:
        speaks = device.get("speaks")
        if isinstance(speaks, str):
            return bad(*_other_protocol(sensor, speaks))
        if not sensor.settings.is_tcp and not may_listen:
            return bad(message("no_known_frames", where="at this speed and parity"), STOP_FIRST)
        return []
    if heard.stranger is not None:
        found = f"{heard.stranger} ({sensor.port}, {heard.line})"
        return bad(message("other_device", found=found, wanted="a sensor"), "another port, or unplug it")
    if heard.candidate is None or heard.line is None:
        if not heard.bytes_heard:
            return []
        where = f"in {heard.bytes_heard} bytes at any usual speed"
        return bad(message("no_known_frames", where=where), "wire, levels, protocol?")
    lines = _line_keys(sensor, heard.line)
    if heard.candidate.protocol == sensor.info.name:
        if not lines:
            return []
        words = message("other_device", found=f"{sensor.info.name} at {heard.line}", wanted=f"at {sensor.line}")
        return bad(words, f"set {' and '.join(lines)} in {_section(sensor)}")
    words, remedy = _other_protocol(sensor, heard.candidate.protocol)
    return bad(words, f"{remedy} with {' and '.join(lines)}" if lines else remedy)


def _line_keys(sensor: SerialDevice, line: Line) -> list[str]:
    keys = [f"baud = {line.baud}"] if line.baud != sensor.line.baud else []
    return keys + ([f'parity = "{line.parity}"'] if line.parity != sensor.line.parity else [])


def _other_protocol(sensor: SerialDevice, protocol: str) -> tuple[str, str]:
    change = f'set protocol = "{protocol}" in {_section(sensor)}'
    main, right = main_kind(protocol), f"give {_section(sensor)} the port of the {sensor.kind}"
    if main == sensor.kind:
        return message("other_device", found=protocol, wanted=sensor.info.name), change
    if protocol in PROTOCOLS[sensor.kind]:
        right = f"{right}; or, to make do with it as {sensor.kind}, {change}"
    return message("other_device", found=f"{protocol}, a device for {main}", wanted=f"for {sensor.kind}"), right


async def run_check(
    config: Config, seconds: float, say: Callable[[str], object] = lambda _words: None
) -> list[CheckLine]:
    findings = [CheckLine("configuration", good=True, words="understood")]
    status: Object | None = None
    ours = {os.getpid()}
    try:
        async for reply in ask(config.control.path, {"command": "status"}):
            status = reply.get("status")
    except DaemonDeniedError:
        raise  # a daemon runs and has the ports open
    except DaemonUnreachableError:
        pass
    is_running = status is not None
    if status is not None:
        ours |= process_behind(config.control.path)
        fault = status["fault"]
        findings.append(CheckLine("daemon", good=fault is None, words=fault or f"running, {status['state']}"))
    else:
        findings.append(CheckLine("daemon", good=True, words="not running: ports opened by this check"))
        findings.append(storage_finding(config.storage.path))
        say(f"checking: {seconds:g} s, half a minute more for a sensor not understood")
        # Start a daemon that writes nothing, and use its status after some seconds.
        service = Service(config, only_listening=ONLY_CHECKING)
        status = await service.listen(lambda listened_s: listened_s < seconds)
    findings += [CheckLine("configuration", good=False, words=words) for words in ineffective_settings(config)]
    findings += [CheckLine("warning", good=True, words=words) for words in doubtful_settings(config)]
    vehicle = status["vehicle"]
    findings.append(_autopilot(config, vehicle))
    if (signing := vehicle["signing"]) is not None:
        findings.append(CheckLine("signing", good=signing["good"], words=signing["summary"]))
    findings += _devices(config, status)
    findings += system_findings(config, list(ours))
    findings += await sensor_findings(config, status, may_listen=not is_running)
    findings += [CheckLine("warning", good=True, words=words) for words in status["warnings"]]
    for name in ("mqtt", "fleet", *(["page"] if is_running else [])):
        if (face := status[name]) is not None:
            findings.append(CheckLine(name, good=face["good"], words=face["summary"]))
    findings += _profiles(status["profiles"])
    if config.push.attitude != "off" and is_running:
        findings.append(await _heading(config))
    if config.calibration.at_arm == "gate":
        findings.append(_gate(config, status["arming"]["setup"]))
    no_tilt = message("sensor_missing", sensor="gradienter", sensors="accelerometers")
    lacks = {"gradienter": f"{no_tilt}: by hand, companion align faces"}
    lacks["compass"] = message("no_heading", reason="no compass")
    missing = [kind for kind in lacks if getattr(config, kind) is None]
    return findings + [CheckLine(kind, good=True, words=lacks[kind]) for kind in missing]


async def answering_imus(config: Config, imus: Sequence[Imu]) -> dict[str, str | None]:
    """Return the autopilot IMUs whose offsets and samples arrive, with their sensor models (None: unknown)."""
    alone = msgspec.structs.replace(config, imu=list(imus), gradienter=None, compass=None, mqtt=None, web=None)
    service = Service(alone, only_listening=ONLY_CHECKING)

    def undecided(listened_s: float) -> bool:
        most_s = IMUS_MOST_S if service.core.vehicle.alive else HEARTBEAT_WITHIN_S
        return listened_s < most_s and not all(imu.decided for imu in service.devices.imus.values())

    status = await service.listen(undecided)
    parts = {profile["imu"]: profile["name"] for profile in status["profiles"]}
    return {device["name"]: parts[device["name"]] for device in status["devices"] if device["good"]}


async def find_law(config: Config, say: Callable[[str], object]) -> tuple[Law, int]:
    """Guide through two tilts; return the law of the gradienter's readings and its yaw in the aircraft, deg.

    Raises:
        LinkError: another program, such as the companion, uses the gradienter's port.
        CalibrationRefusedError: the tilts did not come in time, or no law explains them.
    """
    if config.gradienter is not None:
        refuse_if_held(config.gradienter.port)
    alone = msgspec.structs.replace(config, mqtt=None, web=None)
    service, test = Service(alone, only_listening=ONLY_CHECKING), TiltTest(say)

    def goes_on(listened_s: float) -> bool:
        collector = service.core.collector
        tilt, imus = collector.tilt_second(), collector.imu_seconds()
        # Only the autopilot's samples are in the vehicle's axes, whatever the mountings.
        seconds = [imus[imu.name] for imu in config.imu if imu.source == "autopilot" and imu.name in imus]
        if tilt is not None and seconds:
            late_s = seconds[0].slot - tilt.slot
            readings_deg = tilt.mean[:2] if late_s == 0 else np.full(2, np.nan)
            if late_s == 0 or late_s >= GONE_S:
                test.add(seconds[0].slot, Tilt(readings_deg, seconds[0].mean[3:]))
        return not test.complete and listened_s < TILTS_WITHIN_S

    await service.listen(goes_on)
    if not test.complete:
        raise CalibrationRefusedError(f"no steady tilt {len(test.tilts) + 1} within {TILTS_WITHIN_S:g} s")
    return law_of(test.tilts)


def _devices(config: Config, status: Object) -> list[CheckLine]:
    """List the devices; without a heartbeat leave out all that only an autopilot can show."""
    names = {imu.name for imu in config.imu if imu.source == "autopilot"}
    devices, ground = status["devices"], {**status["ground_stations"], "name": "ground stations"}
    is_heard = status["vehicle"]["heartbeat_age_s"] is not None
    shown = [*devices, ground] if is_heard else [device for device in devices if device["name"] not in names]
    found = [CheckLine(one["name"], one["good"], one["summary"]) for one in shown]
    return found + [CheckLine(one["name"], good=True, words=one["summary"]) for one in status["compasses"]]


def _autopilot(config: Config, vehicle: Object) -> CheckLine:
    if (age_s := vehicle["heartbeat_age_s"]) is not None:
        if age_s < LOST_S:
            return CheckLine("autopilot", good=True, words=vehicle["summary"])
        remedy = "power? cable?"
        words = message("no_heartbeat_for", seconds=f"{age_s:.0f}", remedy=remedy)
        return CheckLine("autopilot", good=False, words=words, remedy=remedy)
    if (fault := vehicle["fault"]) is not None:
        return CheckLine("autopilot", good=False, words=fault)
    baud = baud_of(config.mavlink.url)
    needs = "switched on, and sent there (MAVProxy --out, mavlink-router)?"
    if baud is not None:
        needs = f"{port_needs(None, baud)}; TX to RX"
    remedy = f"{needs}; companion setup searches the other ports"
    return CheckLine("autopilot", good=False, words=f"{vehicle['summary']}: {remedy}", remedy=remedy)


def _profiles(profiles: Sequence[Object]) -> list[CheckLine]:
    known = [one for one in profiles if one["name"] not in (None, UNKNOWN)]
    found = [CheckLine(f"profile {one['imu']}", good=True, words=one["summary"]) for one in known]
    if unknown := [one for one in profiles if one not in known]:
        names = ", ".join(one["imu"] for one in unknown)
        remedy = f"companion setup --part {unknown[0]['imu']}=PART"
        found.append(
            CheckLine("profile", good=True, words=f"{names}: {unknown[0]['summary']}: {remedy}", remedy=remedy)
        )
    return found


def _gate(config: Config, setup: Object) -> CheckLine:
    problem = setup["problem"]
    if not config.push.parameters:
        problem = message("gate_never_opens")
    elif not setup["known"]:
        problem = "not known whether the autopilot asks before it arms: try again"
    return CheckLine("arming", good=problem is None, words=problem or "the autopilot asks before it arms")


async def _heading(config: Config) -> CheckLine:
    replies = [reply async for reply in ask(config.control.path, {"command": "autopilot-setup"})]
    reply = replies[-1]
    words = f"{reply['reason']}; {reply['net']['words']}" if reply.get("net") else reply["reason"]
    return CheckLine("heading", good=reply.get("state") == "applied", words=words)


def storage_finding(directory: Path) -> CheckLine:
    place = next(path for path in (directory, *directory.parents) if path.exists())
    if not (place.is_dir() and os.access(place, os.W_OK)):
        words = message("path_not_usable", path=directory, reason=f"{place} is not writable")
        return CheckLine("storage", good=False, words=words)
    try:
        # A full card shows here, not in the middle of a calibration.
        with tempfile.NamedTemporaryFile(dir=place) as file:
            file.write(bytes(TRIED_BYTES))
            os.fsync(file.fileno())
    except OSError as error:
        words = message("path_not_usable", path=directory, reason=error.strerror)
        return CheckLine("storage", good=False, words=words)
    return CheckLine("storage", good=True, words=str(directory))

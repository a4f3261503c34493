"""`companion check`: does everything the configuration names answer?

With a daemon running the ports are its, so it is asked; otherwise every port is opened and listened to for a while.
"""

from __future__ import annotations

import os
from pathlib import Path

from companion.config.sections import Config
from companion.configured.models import cannot_work, doubtful, profile_in_words
from companion.daemon.devices.doctor import Finding, sensor_findings, system_findings, where_it_may_be
from companion.daemon.devices.sensor_health import ABSENT
from companion.daemon.faces.control import ask, process_behind
from companion.daemon.process.service import Service
from companion.errors import DaemonDeniedError, DaemonUnreachableError
from companion.links.system.request import Object


async def run_check(config: Config, seconds: float) -> list[Finding]:
    """Check everything the configuration names, listening for some seconds.

    Raises:
        CompanionError: something that makes the check itself impossible.
    """
    findings = [Finding("configuration", good=True, words="understood")]
    status: Object | None = None
    ours = {os.getpid()}
    try:
        async for reply in ask(config.control.path, {"command": "status"}):
            status = reply.get("status")
    except DaemonDeniedError:
        raise  # its ports are in use: opening them would only find that
    except DaemonUnreachableError:
        pass
    is_running = status is not None
    if status is not None:
        ours |= process_behind(config.control.path)
        fault = status["fault"]
        findings.append(Finding("daemon", good=fault is None, words=fault or f"running, {status['state']}"))
    else:
        findings.append(Finding("daemon", good=True, words="not running: ports opened by this check"))
        findings.append(_storage(config.storage.path))
        status = await _listen(config, seconds)
    findings += [Finding("configuration", good=False, words=words) for words in cannot_work(config)]
    findings += [Finding("warning", good=True, words=words) for words in doubtful(config)]
    vehicle = status["vehicle"]
    findings.append(Finding("autopilot", good=vehicle["system_id"] is not None, words=vehicle["summary"]))
    if (signing := vehicle["signing"]) is not None:
        findings.append(Finding("signing", good=signing["good"], words=signing["summary"]))
    elsewhere = where_it_may_be(config)
    findings += [_device(device, elsewhere) for device in status["devices"]]
    findings += system_findings(config, list(ours))
    findings += await sensor_findings(config, status, may_listen=not is_running)
    findings += [Finding("warning", good=True, words=words) for words in status["warnings"]]
    ground = status["ground_stations"]
    findings.append(Finding("ground stations", good=ground["good"], words=ground["summary"]))
    if (mqtt := status["mqtt"]) is not None:
        findings.append(Finding("mqtt", good=mqtt["good"], words=mqtt["summary"]))
    # Whose noise figures an IMU's sigmas are made of.
    findings += [Finding(f"profile {imu.name}", good=True, words=profile_in_words(imu.profile)) for imu in config.imu]
    if config.push.attitude != "off" and is_running:
        findings.append(await _heading(config))
    if config.calibration.at_arm == "gate":
        findings.append(_gate(config, status["arming"]["setup"]))
    for kind in ("gradienter", "compass"):
        if getattr(config, kind) is None:
            without = {"gradienter": "gyros only", "compass": "gyro sigma widened by the Earth's rate"}[kind]
            findings.append(Finding(kind, good=True, words=f"not configured: {without}"))
    return findings


def _device(device: Object, elsewhere: Finding | None) -> Finding:
    """How a device does by its own account; and where it may be, if it is not where it should."""
    name, words, port = device["name"], device["summary"], device.get("port", "")
    if device.get("trouble") == ABSENT and port.startswith("/") and not os.path.exists(port) and elsewhere is not None:
        return Finding(name, good=False, words=f"{words}; {elsewhere.words}", remedy=elsewhere.remedy, port=port)
    return Finding(name, device["good"], words, port=port)


def _gate(config: Config, setup: Object) -> Finding:
    """Whether anybody asks before arming."""
    if not config.push.parameters:
        return Finding("arming", good=False, words="at_arm = gate with push.parameters = false never opens")
    if not setup["known"]:
        return Finding("arming", good=False, words="not known whether the autopilot asks before it arms: try again")
    problem = setup["problem"]
    return Finding("arming", good=problem is None, words=problem or "the autopilot asks before it arms")


async def _heading(config: Config) -> Finding:
    """Whether the autopilot takes in our heading."""
    replies = [reply async for reply in ask(config.control.path, {"command": "autopilot-setup"})]
    return Finding("heading", good=replies[-1].get("state") == "applied", words=replies[-1]["reason"])


async def _listen(config: Config, seconds: float) -> Object:
    """The status that a daemon would have after some seconds; writes nothing anywhere."""
    return await Service(config, only_listening="only a check is running: start companion run").listen(seconds)


def _storage(directory: Path) -> Finding:
    """Whether records can be kept."""
    place = directory
    while not place.exists() and place != place.parent:
        place = place.parent
    good = place.is_dir() and os.access(place, os.W_OK)
    words = f"{directory}" + ("" if good else f": cannot be written by this user ({place})")
    return Finding("storage", good, words)

"""The daemon's state in one line: what `systemctl status` shows."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def status_line(status: Mapping[str, Any]) -> str:
    """What a pilot wants to know, most important first; `status` is what `companion status --json` prints."""
    parts = [f"FAULT: {status['fault']}"] if status["fault"] is not None else []
    if status["putting_back"]:
        parts.append("an interrupted write is being put back")
    progress = "" if status["progress"] is None else f" {status['progress']} %"
    parts.append(f"{status['state']}{progress}" + (f", {status['reason']}" if status["reason"] else ""))
    parts.append(str(status["vehicle"]["summary"]))
    parts.append(f"in force: {status['arming']['in_force']}")
    devices = status["devices"]
    good = [device["name"] for device in devices if device["good"]]
    parts += [f"{device['name']}: {device['summary']}" for device in devices if not device["good"]]
    if good:
        parts.append(f"{', '.join(good)} good")
    return "; ".join(parts)

"""Summary of the daemon's status as rows of text, which all interfaces show alike."""

from __future__ import annotations

from typing import Final, Literal

from companion import messages
from companion.formats import Object

_LOST_SHARE: Final = 0.01  # Share of lost samples from which a calibration warns (estimation.means.windows)
_HEARTBEAT_S: Final = 2.0  # maximum age of the autopilot's heartbeat before the link counts as lost
REFUSES: Final = "will not arm"  # Name of a row with one of the autopilot's reasons against arming

StatusRow = tuple[Literal["ok", "warning", "wrong"], str, str, str]
"""One row of the status, for a connected device or a warning: verdict, name, text, remedy (empty: none)."""


def headline(status: Object) -> str:
    return f"{status['headline']['word']}: {status['headline']['reason']}"


def rows(status: Object) -> list[StatusRow]:
    """List the rows of a daemon's status: reasons against arming, devices, then connections, problems and warnings."""
    vehicle, recording, gate = status["vehicle"], status["recording"], status["arming"]["setup"]
    heartbeat_s, signing = vehicle["heartbeat_age_s"], vehicle["signing"]
    found: list[StatusRow] = [("wrong", REFUSES, one["line"], one["remedy"]) for one in status.get("diagnosis", ())]
    found += [_row(heartbeat_s is not None and heartbeat_s < _HEARTBEAT_S, "autopilot", vehicle["summary"])]
    if signing is not None:
        found.append(_row(signing["good"], f"signing ({signing['mode']})", signing["summary"]))
    found += [_row(device["good"], device["name"], device["summary"] + _counts(device)) for device in status["devices"]]
    found += [("ok", one["name"], one["summary"], "") for one in status["compasses"]]
    if not status["ground_stations"]["good"]:
        found.append(_wrong("ground stations", status["ground_stations"]["summary"]))
    found += [
        _row(one["good"], name, one["summary"]) for name in ("mqtt", "fleet") if (one := status[name]) is not None
    ]
    if recording["fault"] is not None:
        found.append(_wrong("recordings", f"none at present: {recording['fault']}"))
    if gate is not None and gate["problem"]:
        found.append(_wrong("arming", gate["problem"]))
    if (warm_up := status["arming"]["warm_up"]) is not None:
        found.append(("ok", "warm-up", warm_up["words"], ""))
    if status["automatic"]["stopped"]:
        found.append(_wrong("by itself", f"no calibration until asked: {status['automatic']['stopped']}"))
    return [*found, *(("warning", "warning", words, messages.remedy(words)) for words in status["warnings"])]


def _row(good: bool, name: str, words: str) -> StatusRow:  # noqa: FBT001 - the first column
    return ("ok", name, words, "") if good else _wrong(name, words)


def _wrong(name: str, words: str) -> StatusRow:
    return "wrong", name, words, messages.remedy(words)


def _counts(device: Object) -> str:
    lost, came = device.get("lost") or 0, device.get("frames") or 0
    words = {
        "bad frames": sum((device.get("rejected") or {}).values()),
        "samples lost": f"{lost / (lost + came):.0%}" if lost > _LOST_SHARE * (lost + came) else None,
        "repeated": (device.get("dropped") or {}).get("repeated"),
        "too late": device.get("too_late"),
        "restarts": device.get("restarts"),
        "reconnected": device.get("reconnects"),
        "clock jumps": device.get("clock_jumps"),
    }
    return "".join(f"; {what}: {number}" for what, number in words.items() if number)

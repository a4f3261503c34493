"""The commands that talk to the running daemon."""

from __future__ import annotations

import argparse
from typing import Any

from companion.cli import show
from companion.cli.terminal import DONE, FAILED, load_config, print_json, print_lines
from companion.daemon.faces.control import ask

Object = dict[str, Any]


async def request(options: argparse.Namespace, wanted: Object) -> Object:
    """Send a request, show its progress on stderr, return its last reply."""
    reply: Object = {}
    shown = ""
    async for reply in ask(load_config(options).control.path, wanted):
        if reply["kind"] == "progress" and reply["text"] != shown:
            shown = reply["text"]
            print_lines(f"[{reply['percent']:3d} %] {reply['state']}: {shown}", error=True)
    return reply


def finish(options: argparse.Namespace, reply: Object, answer: Object, lines: list[str], *, good: bool) -> int:
    """Print an answer, as JSON or as lines for people, and give the exit code."""
    if reply["kind"] == "error":
        answer, lines, good = {"state": "refused", "reason": reply["reason"]}, [], False
        print_lines(f"companion: {reply['reason']}", error=True)
    if getattr(options, "json", False):
        print_json(answer)
    else:
        print_lines(*lines)
    return DONE if good else FAILED


async def status(options: argparse.Namespace) -> int:
    """`companion status`."""
    reply = await request(options, {"command": "status"})
    answer = reply.get("status", {})
    return finish(options, reply, answer, show.status_lines(answer) if answer else [], good=True)


async def calibrate(options: argparse.Namespace) -> int:
    """`companion calibrate`."""
    what = "gyros" if options.gyros else "accelerometers" if options.accelerometers else "both"
    wanted = {
        "command": "calibrate",
        "what": what,
        "wait": options.wait,
        "timeout_s": options.timeout,
        "reboot": options.reboot,
    }
    reply = await request(options, wanted)
    if "record" in reply:
        record = reply["record"]
        return finish(options, reply, record, show.record_lines(record), good=record["state"] == "done")
    answer = {key: reply.get(key) for key in ("state", "reason")}
    return finish(options, reply, answer, [f"{answer['state']}: {answer['reason']}"], good=True)


async def cancel(options: argparse.Namespace) -> int:
    """`companion cancel`."""
    reply = await request(options, {"command": "cancel"})
    answer = {key: reply.get(key) for key in ("state", "reason")}
    return finish(options, reply, answer, [f"{answer['state']}: {answer['reason']}"], good=True)


async def undo(options: argparse.Namespace) -> int:
    """`companion undo`."""
    reply = await request(options, {"command": "undo", "force": options.force})
    answer = {key: reply.get(key) for key in ("state", "reason", "written")}
    return finish(options, reply, answer, [f"{answer['state']}: {answer['reason']}"], good=answer["state"] == "done")


async def history(options: argparse.Namespace) -> int:
    """`companion history`."""
    reply = await request(options, {"command": "history", "limit": options.limit})
    records = reply.get("records", [])
    armings = reply.get("armings", [])
    numbers = reply.get("numbers", [])
    answer = {"numbers": numbers, "records": records, "armings": armings}
    return finish(options, reply, answer, show.history_lines(numbers, records, armings), good=True)


async def setup(options: argparse.Namespace) -> int:
    """`companion autopilot-setup`."""
    reply = await request(options, {"command": "autopilot-setup"})
    answer = {key: value for key, value in reply.items() if key != "kind"}
    good = reply["kind"] != "error"
    return finish(options, reply, answer, setup_lines(answer) if good else [], good=good)


def setup_lines(answer: Object) -> list[str]:
    """The set-up as a person reads it."""
    lines = [f"{answer['state']}: {answer['reason']}"]
    for row in answer["parameters"]:
        now, wanted = _number(row["now"]), _number(row["wanted"])
        change = f"{now} -> {wanted}" if now != wanted else now
        lines.append(f"  {row['parameter']:16} {change:12}  {row['why']}")
    return [*lines, *(f"risk: {risk}" for risk in answer["risks"])]


def _number(value: float | None) -> str:
    return "none" if value is None else f"{value:g}"

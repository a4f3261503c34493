"""`companion autopilot-setup`: what the autopilot needs set to take in our heading."""

from __future__ import annotations

import argparse
from typing import Any

from companion.cli import DONE, FAILED, load_config, print_json, print_lines
from companion.daemon.faces.control import ask

Object = dict[str, Any]


async def setup(options: argparse.Namespace) -> int:
    """`companion autopilot-setup`."""
    path = load_config(options).control.path
    reply = [reply async for reply in ask(path, {"command": "autopilot-setup"})][-1]
    if reply["kind"] == "error":
        answer: Object = {"state": "refused", "reason": reply["reason"]}
        print_lines(f"companion: {reply['reason']}", error=True)
    else:
        answer = {key: value for key, value in reply.items() if key != "kind"}
    if getattr(options, "json", False):
        print_json(answer)
    elif reply["kind"] != "error":
        print_lines(*setup_lines(answer))
    return FAILED if reply["kind"] == "error" else DONE


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


def add_command(add: Any) -> None:
    """The subcommand."""
    add("autopilot-setup", setup, "what the autopilot needs set to take in our heading")

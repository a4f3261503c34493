"""`companion autopilot-setup`: what the autopilot needs set to take in our heading."""

from __future__ import annotations

import argparse
from typing import Any

from companion.cli.client import finish, request
from companion.cli.terminal import AddCommand

Object = dict[str, Any]


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


def add_command(add: AddCommand) -> None:
    """The subcommand."""
    add("autopilot-setup", setup, "what the autopilot needs set to take in our heading")

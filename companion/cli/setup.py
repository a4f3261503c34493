"""`companion autopilot-setup`: the autopilot's parameters for our heading, shown, applied or taken back."""

from __future__ import annotations

import argparse
import sys
from typing import Any, Final

from companion.cli.client import finish, request
from companion.cli.terminal import AddCommand, print_lines

Object = dict[str, Any]

QUESTION: Final = {"command": "autopilot-setup"}


async def setup(options: argparse.Namespace) -> int:
    """`companion autopilot-setup`."""
    if options.apply:
        shown = await request(options, {**QUESTION, "action": "show"})
        for risk in shown.get("risks", []):
            print_lines(f"risk: {risk}", error=True)
        if shown["kind"] != "error" and shown["state"] != "applied" and not _agreed(options):
            return _said(options, {"kind": "error", "reason": "not applied: say --yes, or answer on a terminal"})
        return _said(options, await request(options, {**QUESTION, "action": "apply"}))
    if options.undo:
        return _said(options, await request(options, {**QUESTION, "action": "undo", "force": options.force}))
    return _said(options, await request(options, {**QUESTION, "action": "show"}))


def _agreed(options: argparse.Namespace) -> bool:
    """Whether somebody has read the risks."""
    if options.yes:
        return True
    if not sys.stdin.isatty():
        return False
    print_lines("type yes to go on: ", end="", error=True)
    return sys.stdin.readline().strip().lower() == "yes"


def _said(options: argparse.Namespace, reply: Object) -> int:
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
    for name, one in answer.get("written", {}).items():
        lines.append(f"  {name:16} {_number(one['before'])} -> {_number(one['read_back'])}  {one['outcome']}")
    lines += [f"risk: {risk}" for risk in answer["risks"]]
    return lines


def _number(value: float | None) -> str:
    return "none" if value is None else f"{value:g}"


def add_command(add: AddCommand) -> None:
    """The subcommand and its options."""
    command = add("autopilot-setup", setup, "the autopilot's parameters for our heading: show, apply, take back")
    what = command.add_mutually_exclusive_group()
    what.add_argument("--show", action="store_true", help="what is set and what would be (the default)")
    what.add_argument("--apply", action="store_true", help="write it, disarmed, after saying the risks")
    what.add_argument("--undo", action="store_true", help="put the values from before back")
    command.add_argument("--yes", action="store_true", help="the risks are known: do not ask")
    command.add_argument("--force", action="store_true", help="with --undo: leave what somebody else has changed since")

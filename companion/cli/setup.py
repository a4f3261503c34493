"""`companion autopilot-setup`: the autopilot's parameters for our heading, shown, applied or taken back."""

from __future__ import annotations

import argparse
import sys
from typing import Any

from companion.cli import DONE, FAILED, load_config, print_json, print_lines
from companion.daemon.faces.control import ask

Object = dict[str, Any]


async def _request(options: argparse.Namespace, request: Object) -> Object:
    question = {"command": "autopilot-setup", **request}
    return [reply async for reply in ask(load_config(options).control.path, question)][-1]


async def setup(options: argparse.Namespace) -> int:
    """`companion autopilot-setup`."""
    if options.apply:
        shown = await _request(options, {"action": "show"})
        for risk in shown.get("risks", []):
            print_lines(f"risk: {risk}", error=True)
        if shown["kind"] != "error" and shown["state"] != "applied" and not _agreed(options):
            return _finish(options, {"kind": "error", "reason": "not applied: say --yes, or answer on a terminal"})
        return _finish(options, await _request(options, {"action": "apply"}))
    if options.undo:
        return _finish(options, await _request(options, {"action": "undo", "force": options.force}))
    return _finish(options, await _request(options, {"action": "show"}))


def _agreed(options: argparse.Namespace) -> bool:
    """Whether somebody has read the risks."""
    if options.yes:
        return True
    if not sys.stdin.isatty():
        return False
    print_lines("type yes to go on: ", end="", error=True)
    return sys.stdin.readline().strip().lower() == "yes"


def _finish(options: argparse.Namespace, reply: Object) -> int:
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
    for name, one in answer.get("written", {}).items():
        lines.append(f"  {name:16} {_number(one['before'])} -> {_number(one['read_back'])}  {one['outcome']}")
    lines += [f"risk: {risk}" for risk in answer["risks"]]
    return lines


def _number(value: float | None) -> str:
    return "none" if value is None else f"{value:g}"


def add_command(add: Any) -> None:
    """The subcommand and its options."""
    command = add("autopilot-setup", setup, "the autopilot's parameters for our heading: show, apply, take back")
    what = command.add_mutually_exclusive_group()
    what.add_argument("--show", action="store_true", help="what is set and what would be (the default)")
    what.add_argument("--apply", action="store_true", help="write it, disarmed, after saying the risks")
    what.add_argument("--undo", action="store_true", help="put the values from before back")
    command.add_argument("--yes", action="store_true", help="the risks are known: do not ask")
    command.add_argument("--force", action="store_true", help="with --undo: leave what somebody else has changed since")

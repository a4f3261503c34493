"""The commands that make a service of the companion."""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from companion.cli.terminal import DONE, FAILED, AddCommand, print_json, print_lines

if TYPE_CHECKING:
    from companion.installation.install import Step, Target


def add_commands(add: AddCommand) -> None:
    """Add `install-service` and `uninstall-service`; `add` makes a parser of name, command and help."""
    for name, command, words in (
        ("install-service", install, "start the companion at every boot: unit, udev rules, configuration"),
        ("uninstall-service", uninstall, "take that away again; configuration and records stay"),
    ):
        service = add(name, command, words)
        service.add_argument("--root", default="/", metavar="DIR", help="below this folder, for packages (default /)")
        service.add_argument(
            "--prefix", type=Path, default=Path("/usr/local"), help="whose lib takes the unit (default /usr/local)"
        )
        service.add_argument("--dry-run", action="store_true", help="only tell what would be done")
        if command is install:
            service.add_argument("--executable", metavar="PATH", help="the companion (default: the one that runs this)")


async def install(options: argparse.Namespace) -> int:
    """`companion install-service`."""
    from companion.installation import install as installing

    return _tell(options, installing.install(_target(options, options.executable or installing.own_executable())))


async def uninstall(options: argparse.Namespace) -> int:
    """`companion uninstall-service`."""
    from companion.installation import install as installing

    return _tell(options, installing.uninstall(_target(options, installing.own_executable())))


def _target(options: argparse.Namespace, executable: str) -> Target:
    from companion.installation.install import Target

    return Target(Path(options.root).absolute(), options.prefix, executable, dry_run=options.dry_run)


def _tell(options: argparse.Namespace, steps: Iterable[Step]) -> int:
    as_json = getattr(options, "json", False)
    done: list[Step] = []
    for step in steps:
        done.append(step)
        line = f"{step.outcome:9}  {step.what}" + (f": {step.words}" if step.words else "")
        print_lines(line, error=as_json)
    failed = [step for step in done if step.outcome == "failed"]
    if as_json:
        reason = "; ".join(f"{step.what}: {step.words}" for step in failed)
        state = "failed" if failed else "would be done" if options.dry_run else "done"
        print_json({"state": state, "reason": reason, "steps": [dataclasses.asdict(step) for step in done]})
    elif options.dry_run:
        print_lines("this was a dry run: nothing was changed", error=True)
    return FAILED if failed else DONE

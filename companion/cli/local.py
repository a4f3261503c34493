"""The commands that need no daemon: run it, check what it would find, list ports."""

from __future__ import annotations

import argparse
import dataclasses
import faulthandler
import sys

from companion.cli import DONE, FAILED, config_path, load_config, logs, print_json, show


async def run(options: argparse.Namespace) -> int:
    """`companion run`."""
    config = load_config(options)
    # Where the whole process stands still the watchdog's SIGABRT is the only witness: let it say where that was.
    faulthandler.enable()
    logs.set_up("debug" if options.verbose else config.log.level)
    from companion.daemon import process

    await process.run(config, config_path(options))
    return DONE


async def ports(options: argparse.Namespace) -> int:
    """`companion ports`."""
    from companion.links.ports import list_ports

    found = list_ports()
    if getattr(options, "json", False):
        print_json({"ports": [dataclasses.asdict(port) for port in found]})
        return DONE
    for line in show.port_lines(found):
        print(line)
    return DONE


async def lua(options: argparse.Namespace) -> int:
    """`companion lua`: the script on stdout, the steps on stderr."""
    from companion.lua import ARMING_SCRIPT, INSTALLATION

    script = ARMING_SCRIPT.read_text(encoding="utf-8")
    if getattr(options, "json", False):
        print_json({"name": ARMING_SCRIPT.name, "script": script, "installation": list(INSTALLATION)})
        return DONE
    print(script, end="")
    for number, step in enumerate(INSTALLATION, 1):
        print(f"{number}. {step}", file=sys.stderr)
    return DONE


async def check(options: argparse.Namespace) -> int:
    """`companion check`."""
    from companion.daemon.check import run_check

    config = load_config(options)
    findings = await run_check(config, options.seconds)
    good = all(finding.good for finding in findings)
    reason = "; ".join(f"{finding.name}: {finding.words}" for finding in findings if not finding.good)
    if getattr(options, "json", False):
        print_json(
            {
                "state": "good" if good else "failed",
                "reason": reason,
                "findings": [dataclasses.asdict(finding) for finding in findings],
            }
        )
    else:
        width = max(len(finding.name) for finding in findings)
        for finding in findings:
            print(f"{'ok ' if finding.good else 'BAD'}  {finding.name:{width}}  {finding.words}")
    return DONE if good else FAILED

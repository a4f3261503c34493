"""The commands that need no daemon: run it, check what it would find, list ports, install it, make a report."""

from __future__ import annotations

import argparse
import dataclasses
import datetime
import faulthandler
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

from companion.cli import show
from companion.cli.terminal import (
    DONE,
    FAILED,
    USAGE,
    AddCommand,
    Parser,
    conclude,
    config_path,
    load_config,
    print_address,
    print_json,
    print_lines,
    storage_path,
)
from companion.errors import CompanionError, StorageError
from companion.links.system import logs

if TYPE_CHECKING:
    from companion.installation.install import Step, Target
    from companion.links.serial.listening import Heard
    from companion.links.serial.ports import SerialPort


def add_command(add: AddCommand) -> None:
    """Add `companion setup`, which comes first."""
    parser = add("setup", setup, "find autopilot and sensors, ask what cannot be found out, write the configuration")
    parser.add_argument(
        "ports", nargs="*", metavar="PORT", help="serial ports to listen to (default: all that nobody holds)"
    )
    parser.add_argument(
        "--page", metavar="ADDRESS:PORT", help="ask on a page there, for a phone (0.0.0.0:8191) or the board itself"
    )
    parser.add_argument("--yes", action="store_true", help="ask nothing: take what would stand in brackets")
    parser.add_argument("--mavlink", metavar="URL", help="where the autopilot is; otherwise it is looked for")
    parser.add_argument(
        "--udp", type=_udp_port, action="append", metavar="PORT",
        help="a UDP port to listen to, instead of the usual ones; may be given again",
    )  # fmt: skip
    parser.add_argument("--platform", metavar="WHERE", help="ground or deck")
    parser.add_argument("--law", metavar="LAW", help="of the gradienter: axis, slope or euler")
    parser.add_argument(
        "--mounting", action="append", default=[], metavar="DEVICE=HOW",
        help="of gradienter, compass or imu: degrees clockwise from above, ROLL,PITCH,YAW, or ROTATION_...",
    )  # fmt: skip
    parser.add_argument(
        "--part", action="append", default=[], metavar="IMU=PART",
        help="of an IMU by its name: fc=icm42688p (bmi088, adis16470, adis16405, unknown)",
    )  # fmt: skip
    parser.add_argument("--no-check", action="store_true", help="write the file only")
    parser.add_argument("--no-service", action="store_true", help="do not offer to start it at every boot")


def _udp_port(text: str) -> int:
    if not text.isdigit() or not 1 <= int(text) <= 65535:
        raise argparse.ArgumentTypeError(f"found {text!r}; allowed: a port from 1 to 65535")
    return int(text)


async def setup(options: argparse.Namespace) -> int:
    """`companion setup`: what it needs is nothing to other commands."""
    from companion.cli import setup as session

    return await session.setup(options)


def add_commands(add: AddCommand) -> None:
    """Add those that have options of their own: to install, to uninstall, and to report."""
    for name, command, words in (
        ("install-service", install, "start the companion at every boot: unit, udev rules, configuration"),
        ("uninstall-service", uninstall, "take that away again; configuration and records stay"),
    ):
        service = add(name, command, words)
        service.add_argument("--root", default="/", metavar="DIR", help="below this folder, for packages (default /)")
        service.add_argument(
            "--prefix", type=Path, default=Path("/usr/local"), help="whose lib takes the unit (default /usr/local)"
        )
        if command is install:
            service.add_argument("--executable", metavar="PATH", help="the companion (default: the one that runs this)")
    sub = add("report", report, "make a page (one HTML file) of a calibration: needs no daemon, no network")
    sub.add_argument(
        "record", nargs="?", metavar="RECORD", help="its number, or the beginning of its time (default: the latest)"
    )
    sub.add_argument("-o", "--output", metavar="FILE", help="default: companion-report-….html here; - is stdout")
    sub.add_argument(
        "--storage", type=Path, metavar="DIR", help="the folder with records/ (default: as in the configuration)"
    )


FIRST_RUN: Final = ("--page", "0.0.0.0:8191")
"""How `run` calls `setup` where there is no configuration: whoever reads its output gets the token from it."""


async def run(options: argparse.Namespace) -> int:
    """`companion run`; without a configuration a page asks for it first."""
    if not hasattr(options, "config") and not config_path(options).exists():
        await _first_run(config_path(options))
    config = load_config(options, profiles=True, forgiving=True)
    # Where the whole process stands still the watchdog's SIGABRT is the only witness: let it say where that was.
    faulthandler.enable()
    logs.set_up("debug" if options.verbose else config.log.level)
    from companion.daemon.process import footprint

    footprint.prepare()
    from companion.daemon.process import run as process

    await process.run(config)
    return DONE


async def _first_run(path: Path) -> None:
    """Have it asked for, by whoever may write it; others are told by the daemon's own start that it is missing."""
    from companion.cli import setup as session
    from companion.setup.draft import is_writable

    if is_writable(path):
        asks = Parser()
        add_command(lambda *_: asks)
        await session.setup(asks.parse_args(FIRST_RUN, argparse.Namespace(json=False)), goes_on=True)


async def ports(options: argparse.Namespace) -> int:
    """`companion ports`: listed; listened to only when that is asked for."""
    from companion.links.serial.ports import list_ports

    found = list_ports()
    listened = None if options.listen is None else await _listen(options.listen, found)
    if options.json:
        answer: dict[str, object] = {"ports": [dataclasses.asdict(port) for port in found]}
        if listened is not None:
            answer["heard"] = {port: _heard(heard) for port, heard in listened.items()}
        print_json(answer)
        return DONE
    if not options.listen:
        print_lines(*show.port_lines(found))
    if listened is not None:
        from companion.setup.survey import in_words

        print_lines(*(f"{port}: {in_words(port, heard)}" for port, heard in listened.items()))
        print_lines("companion setup takes them into the configuration", error=True)
    return DONE


async def _listen(wanted: Sequence[str], found: Sequence[SerialPort]) -> dict[str, Heard | str]:
    """Who speaks on each port, or why that is not known."""
    from companion.links.serial.listening import listen_to_all, ports_to_try

    names = list(wanted) or ports_to_try(found)
    if names:
        print_lines(f"listening to {', '.join(names)}: up to half a minute", error=True)
    return await listen_to_all(names)


def _heard(heard: Heard | str) -> dict[str, object]:
    if isinstance(heard, str):
        return {"good": False, "reason": heard}
    candidate = heard.candidate
    return {
        "good": candidate is not None,
        **({"baud": None, "parity": None} if heard.line is None else heard.line._asdict()),
        "protocol": candidate.protocol if candidate is not None else None,
        "kinds": list(candidate.kinds) if candidate is not None else [],
        "frames": candidate.accepted if candidate is not None else 0,
        "stranger": heard.stranger,
        "autopilot": None if heard.heartbeat is None else dataclasses.asdict(heard.heartbeat),
        "bytes": heard.bytes_heard,
    }


async def lua(options: argparse.Namespace) -> int:
    """`companion lua`: the script on stdout, the steps on stderr."""
    from companion.lua import ARMING_SCRIPT, INSTALLATION

    script = ARMING_SCRIPT.read_text(encoding="utf-8")
    if options.json:
        print_json({"name": ARMING_SCRIPT.name, "script": script, "installation": list(INSTALLATION)})
        return DONE
    sys.stdout.write(script)
    for number, step in enumerate(INSTALLATION, 1):
        print_lines(f"{number}. {step}", error=True)
    return DONE


async def web_token(options: argparse.Namespace) -> int:
    """`companion web-token`: an address that brings the token along; made if there is none yet."""
    from companion.web.access import is_loopback, kept_token, page_url, split_address

    config = load_config(options)
    if config.web is None:
        raise CompanionError('there is no page: the configuration needs [web] with bind = "127.0.0.1:8191"')
    host, port = split_address(config.web.bind)
    url = page_url(host, port)
    token = None if is_loopback(host) else kept_token(config.storage.path)
    if options.json:
        print_json({"url": url, "token": token})
    else:
        print_address(url, token)
    return DONE


async def check(options: argparse.Namespace) -> int:
    """`companion check`."""
    from companion.daemon.process.check import run_check

    config = load_config(options, profiles=True)
    findings = await run_check(config, options.seconds, lambda words: print_lines(words, error=True))
    good = all(finding.good for finding in findings)
    reason = "; ".join(f"{finding.name}: {finding.words}" for finding in findings if not finding.good)
    state, found = "good" if good else "failed", [dataclasses.asdict(finding) for finding in findings]
    answer = {"state": state, "reason": reason, "findings": found}
    return conclude(options, answer, show.finding_lines(findings), good=good)


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

    return Target(Path(options.root).absolute(), options.prefix, executable)


def _tell(options: argparse.Namespace, steps: Iterable[Step]) -> int:
    done: list[Step] = []
    for step in steps:
        done.append(step)
        print_lines(step.line(), error=options.json)
    failed = [step for step in done if step.outcome == "failed"]
    if options.json:
        reason = "; ".join(f"{step.what}: {step.words}" for step in failed)
        state = "failed" if failed else "done"
        print_json({"state": state, "reason": reason, "steps": [dataclasses.asdict(step) for step in done]})
    return FAILED if failed else DONE


async def report(options: argparse.Namespace) -> int:
    """`companion report`."""
    if options.output == "-" and options.json:
        print_lines("companion report: -o - and --json both want stdout", error=True)
        return USAGE
    path, damaged = _make(options, options.storage or storage_path(options))
    skipped = f"skipped: {'; '.join(damaged)}" if damaged else ""
    if skipped:
        print_lines(f"companion: {skipped}", error=True)
    if options.json:
        print_json({"state": "done", "reason": skipped, "file": str(path)})
    elif path is not None:
        print_lines(path)
    return DONE


def _make(options: argparse.Namespace, directory: Path) -> tuple[Path | None, list[str]]:
    from companion.report.calibration import calibration_page
    from companion.report.source import material
    from companion.storage.state import write_atomically

    found = material(directory, options.record)
    content, damaged = calibration_page(found, datetime.datetime.now(tz=datetime.UTC)), list(found.damaged)
    name = f"companion-report-{found.number:06d}.html"
    if options.output == "-":
        # As the file says of itself, whatever the terminal speaks.
        sys.stdout.buffer.write(content.encode("utf-8", "replace"))
        sys.stdout.flush()
        return None, damaged
    path = Path(options.output or name).absolute()
    if not path.parent.is_dir():
        raise StorageError(f"{path}: there is no folder {path.parent}")
    if path.is_dir():
        path = path / name
    write_atomically(path, content.encode("utf-8", "replace"), mode=0o644)
    return path, damaged

"""Commands that need no running daemon: they start or install it, check devices, list ports or make a report."""

from __future__ import annotations

import argparse
import dataclasses
import datetime
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

import msgspec

from companion import messages
from companion.cli import show
from companion.cli.terminal import (
    DONE,
    USAGE,
    CommandGroup,
    Parser,
    conclude,
    config_path,
    load_config,
    print_address,
    print_json,
    print_lines,
    storage_path,
    within,
)
from companion.errors import CompanionError, StorageError

if TYPE_CHECKING:
    from companion.installation.install import InstallStep
    from companion.links.serial.listening import Heard
    from companion.links.serial.ports import SerialPort


def _add_setup_options(option: Callable[..., argparse.Action]) -> None:
    option("ports", nargs="*", metavar="PORT", help="serial ports to listen to (default: all free ports)")
    option("--page", metavar="ADDRESS:PORT", help="ask on a page there, such as 0.0.0.0:8191 for a phone")
    option("--yes", action="store_true", help="ask nothing: take what would stand in brackets")
    option("--mavlink", metavar="URL", help="where the autopilot is; otherwise it is looked for")
    words = "a UDP port to listen to, in place of the usual ones; may be given again"
    option("--udp", type=within(1, 65535, int), action="append", metavar="PORT", help=words)
    option("--platform", metavar="WHERE", help="ground or deck")
    option("--law", metavar="LAW", help="of the gradienter: axis, slope or euler")
    words = "of gradienter, compass or imu: degrees clockwise (90 becomes ROTATION_YAW_90), ROLL,PITCH,YAW or ROTATION_"
    option("--mounting", action="append", default=[], metavar="DEVICE=HOW", help=words)
    words = "of an IMU by its name: fc=icm42688p (bmi088, adis16470, adis16405, unknown)"
    option("--part", action="append", default=[], metavar="IMU=PART", help=words)
    option("--no-check", action="store_true", help="write the file only; IMU 2 and 3 are not looked for")
    option("--no-service", action="store_true", help="do not offer to start it at every boot")


async def setup(options: argparse.Namespace) -> int:
    from companion.cli import setup as session

    return await session.setup(options)


def add_commands(commands: CommandGroup, autopilot: CommandGroup) -> None:
    add = commands.add
    words = "find autopilot and sensors, ask for the rest, write the file"
    _add_setup_options(add("setup", setup, words).add_argument)
    option = add("run", run, "run the daemon in the foreground").add_argument
    option("-v", "--verbose", action="store_true", help="log what happens in detail")
    option = add("check", check, "check configuration, ports, sensors and autopilot").add_argument
    option(
        "--seconds", type=within(3.0, 600.0), default=3.0, metavar="S", help="how long to listen (3 to 600; default 3)"
    )
    option = add("ports", ports, "list the serial ports, and name what is connected (--listen)").add_argument
    words = "listen on these ports and name the devices (default: all free ports), for up to half a minute; sends"
    option("--listen", nargs="*", metavar="PORT", help=f"{words} nothing, but opening a port restarts an Arduino")
    words = "print the arming script for ArduPilot (> APM/scripts/companion_arming.lua), and how to install it"
    autopilot.add("script", script, words)
    service = commands.group("service", "start the companion at every boot, or no longer")
    installer = service.add("install", install, "install the systemd unit, udev rules and a first configuration")
    installer.add_argument("--executable", metavar="PATH", help="the companion (default: the one that runs this)")
    remover = service.add("remove", install, "remove unit and rules; configuration and records stay")
    for command in (installer, remover):
        command.set_defaults(installs=command is installer)
        option = command.add_argument
        option("--root", type=_absolute, default=Path("/"), metavar="DIR", help="for packages (default /)")
        option("--prefix", type=Path, default=Path("/usr/local"), help="whose lib takes the unit (default /usr/local)")
    words = "make a page (one HTML file) of a calibration"
    option = add("report", report, words).add_argument
    option("record", nargs="?", type=within(1, 1e9, int), metavar="NUMBER", help="default: the latest")
    option("-o", "--output", metavar="FILE", help="default: companion-report-….html here; - is stdout")
    option("--storage", type=Path, metavar="DIR", help="folder with records/ (default: as in the configuration)")
    words = "explain a message: its cause, and what to do"
    option = add("explain", explain, words).add_argument
    option("words", nargs="+", metavar="WORDS", help="the message or a part of it, its identifier, or what it is about")
    add("page", page, "address of the page, and the token for its buttons")


def _absolute(text: str) -> Path:
    return Path(text).absolute()


FIRST_RUN: Final = ("--page", "0.0.0.0:8191")
"""Options of `companion setup` if `companion run` starts it for lack of a configuration; it prints the page's token."""


async def run(options: argparse.Namespace) -> int:
    """Run the daemon; if there is no configuration, create one on a web page first."""
    if not config_path(options).exists():
        await _first_run(config_path(options))
    load_config(options, profiles=True, forgiving=True)
    # Replace this process: the daemon then needs no memory for the command line and the page.
    daemon = [sys.executable, "-m", "companion.daemon", str(config_path(options)), *(["-v"] if options.verbose else [])]
    os.execv(sys.executable, daemon)  # noqa: S606


async def _first_run(path: Path) -> None:
    """Ask for the configuration on a web page, unless its file is not writable: the daemon then reports its absence."""
    from companion.cli import setup as session
    from companion.setup.draft import is_writable

    if is_writable(path):
        print_lines(f"{path}: no such file; the set-up makes it, on a page for the phone:")
        asks = Parser()
        _add_setup_options(asks.add_argument)
        await session.setup(asks.parse_args(FIRST_RUN, argparse.Namespace(json=False, config=path)), goes_on=True)


async def ports(options: argparse.Namespace) -> int:
    from companion.links.serial.ports import list_ports

    found = list_ports()
    listened = None if options.listen is None else await _listen(options.listen, found)
    answer: dict[str, object] = {"ports": [dataclasses.asdict(port) for port in found]}
    lines = [] if options.listen else show.port_lines(found)
    if listened is not None:
        from companion.setup.survey import in_words

        answer["heard"] = {port: _heard(heard) for port, heard in listened.items()}
        lines += [f"{port}: {in_words(port, heard)}" for port, heard in listened.items()]
        print_lines("companion setup takes them into the configuration", error=True)
    return conclude(options, answer, lines, good=True)


async def _listen(wanted: Sequence[str], found: Sequence[SerialPort]) -> dict[str, Heard | str]:
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


async def script(options: argparse.Namespace) -> int:
    from companion.lua import ARMING_SCRIPT, INSTALLATION

    text = ARMING_SCRIPT.read_text(encoding="utf-8")
    if options.json:
        print_json({"name": ARMING_SCRIPT.name, "script": text, "installation": list(INSTALLATION)})
        return DONE
    sys.stdout.write(text)
    for number, step in enumerate(INSTALLATION, 1):
        print_lines(f"{number}. {step}", error=True)
    return DONE


async def explain(options: argparse.Namespace) -> int:
    found = messages.search(" ".join(options.words))
    lines = show.explained_lines(found)
    reason = "" if found else messages.NO_MATCH
    entries = [{"id": name, **msgspec.to_builtins(entry)} for name, entry in found]
    answer = {"state": "done" if found else "failed", "reason": reason, "messages": entries}
    return conclude(options, answer, lines or [reason], good=bool(found))


async def page(options: argparse.Namespace) -> int:
    from companion.web.access import is_loopback, page_url, split_address, stored_token

    config = load_config(options)
    if config.web is None:
        raise CompanionError('there is no page: the configuration needs [web] with bind = "127.0.0.1:8191"')
    host, port = split_address(config.web.bind)
    url = page_url(host, port)
    token = None if is_loopback(host) else stored_token(config.storage.path)
    if options.json:
        print_json({"url": url, "token": token})
    else:
        print_address(url, token)
    return DONE


async def check(options: argparse.Namespace) -> int:
    from companion.daemon.process.check import run_check

    config = load_config(options, profiles=True)
    findings = await run_check(config, options.seconds, lambda words: print_lines(words, error=True))
    reason = show.problems(findings)
    found = [dataclasses.asdict(finding) for finding in findings]
    answer = {"state": "failed" if reason else "good", "reason": reason, "findings": found}
    return conclude(options, answer, show.finding_lines(findings), good=not reason)


async def install(options: argparse.Namespace) -> int:
    from companion.installation import install as installing

    executable = getattr(options, "executable", None) or installing.own_executable()
    target = installing.Installation(options.root, options.prefix, executable)
    done: list[InstallStep] = []
    for step in (installing.install if options.installs else installing.uninstall)(target):
        done.append(step)
        print_lines(step.line(), error=options.json)
    reason = show.failures(done)
    steps = [dataclasses.asdict(step) for step in done]
    answer = {"state": "failed" if reason else "done", "reason": reason, "steps": steps}
    return conclude(options, answer, (), good=not reason)


async def report(options: argparse.Namespace) -> int:
    from companion.report.calibration import calibration_page, read_material

    if options.output == "-" and options.json:
        print_lines("companion report: -o - and --json both want stdout", error=True)
        return USAGE
    records, armings, damaged = read_material(options.storage or storage_path(options), options.record)
    made = calibration_page(records, armings, damaged, datetime.datetime.now(tz=datetime.UTC))
    content = made.encode("utf-8", "replace")
    skipped = f"skipped: {'; '.join(damaged)}" if damaged else ""
    path: Path | None = None
    if options.output == "-":
        # Write bytes: the encoding of the file may differ from that of the terminal.
        sys.stdout.buffer.write(content)
        sys.stdout.flush()
    else:
        path = _save(options.output or "", f"companion-report-{records[-1][0]:06d}.html", content)
    if skipped:
        print_lines(f"companion: {skipped}", error=True)
    answer = {"state": "done", "reason": skipped, "file": str(path)}
    return conclude(options, answer, [path] if path is not None else (), good=True)


def _save(output: str, name: str, content: bytes) -> Path:
    from companion.storage.state import write_atomically

    path = _absolute(output or name)
    if not path.parent.is_dir():
        raise StorageError(f"{path}: there is no folder {path.parent}")
    if path.is_dir():
        path /= name
    write_atomically(path, content, mode=0o644)
    return path

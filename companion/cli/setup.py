"""Command `setup`: writes a working configuration from the detected devices and a few answers of the operator."""

from __future__ import annotations

import argparse
import asyncio
import dataclasses
import functools
import logging
import math
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final, get_args

import msgspec

from companion import config
from companion.cli.asking import Interview, PageInterview
from companion.cli.show import failures, finding_lines, problems
from companion.cli.terminal import DONE, FAILED, config_path, load_config, own_name, print_json
from companion.config.rules import bind_problem
from companion.config.sections import Config, Imu, Law, Platform, Storage
from companion.config.words import shown
from companion.errors import CompanionError, ConfigError, DaemonDeniedError, DaemonUnreachableError
from companion.formats import Object
from companion.installation import install as installing
from companion.links.serial.listening import ports_to_try
from companion.links.serial.ports import list_ports
from companion.protocols.registry import Kind
from companion.setup import draft as drafting
from companion.setup.draft import LAW_KEY, PLATFORMS, Draft, Question, mounting_of, one_of, part_key, storage_beside
from companion.setup.survey import USUAL_PORTS, Survey, same_port, same_url, survey

KINDS: Final[tuple[Kind, ...]] = ("gradienter", "compass", "imu")
WITHOUT: Final = {
    "gradienter": "no gradienter: gyros only, accelerometers by hand (connected later: companion setup again)",
    "compass": "no compass: the gyros' sigmas are a little wider",
}
CHECK_S: Final = 10.0
SEARCH: Final = "search again"
USUAL_URLS: Final = ("serial:/dev/ttyACM0:115200", "serial:/dev/serial0:921600", "udpin:0.0.0.0:14550")
PLACES: Final = f"USB {USUAL_URLS[0]}, UART {USUAL_URLS[1]}, UDP {USUAL_URLS[2]}, or tcp:HOST:PORT."
COARSE: Final = "It sends whole steps of 206 deg/h and 1 mg: a gyro bias below one step may stay unknown."
"""Warning about the autopilot's IMUs 2 and 3: SCALED_IMU2 and SCALED_IMU3 have a resolution of 1 mrad/s and 1 mg."""
_OTHERS: Final = (
    "An autopilot that loses an IMU flies on with another, by its offsets. no: only the first is calibrated."
)


async def setup(options: argparse.Namespace, *, goes_on: bool = False) -> int:
    if options.page is None:
        session = _Session(options, Interview(yes=options.yes, error=options.json))
        await session.run()
    else:
        async with PageInterview(_bind(options), _storage(options)) as asking:
            session = _Session(options, asking, goes_on=goes_on)
            await session.run()
            await asking.finish(session.then)
    if options.json:
        print_json(session.answer)
    return DONE if session.answer["state"] != "failed" else FAILED


def _bind(options: argparse.Namespace) -> str:
    if options.yes or options.json:
        raise ConfigError("--page asks a person: it goes neither with --yes nor with --json")
    if (wrong := bind_problem(options.page, "--page")) is not None:
        raise ConfigError(wrong)
    return str(options.page)


def _storage(options: argparse.Namespace) -> Path:
    path = config_path(options)
    try:
        return config.load(path).storage.path
    except ConfigError:
        return Storage().path if path == config.DEFAULT_PATH else storage_beside(path)


class _Session:
    def __init__(self, options: argparse.Namespace, asking: Interview, *, goes_on: bool = False) -> None:
        self.asking, self._goes_on = asking, goes_on
        self.then = ""  # Next action after the page has closed
        self._so_far = "nothing was written"
        self._measured: set[str] = set()  # Keys that the guided test has answered
        self._options = options
        self._path = config_path(options)
        self.answer: dict[str, Any] = {
            "state": "done", "reason": "", "file": str(self._path), "kept": None, "heard": {}, "guessed": [],
            "configuration": {}, "findings": None, "steps": None, "next": [],
        }  # fmt: skip

    async def run(self) -> None:
        """Ask the questions, write and check the configuration; after a failure report what was written so far."""
        try:
            await self._run()
        except asyncio.CancelledError:
            self.asking.say("", f"ended: {self._so_far}")
            raise
        except CompanionError as error:
            kind = ConfigError if isinstance(error, ConfigError) else CompanionError
            raise kind(f"{error}; {self._so_far}") from None

    async def _run(self) -> None:
        say = self.asking.say
        if not drafting.is_writable(self._path):
            raise CompanionError(
                f"{self._path} is not yours to write: sudo companion setup, or companion -c FILE setup for a file of"
                " your own"
            )
        draft = await self._begin()
        is_new = draft.is_new
        if is_new and self._path != config.DEFAULT_PATH:
            draft.keep_beside(self._path)
        if self._options.page is not None:
            draft.show_page(self._options.page)
        mountings = _named_values("--mounting", self._options.mounting, "gradienter=..., compass=... or imu=...", KINDS)
        parts = _named_values("--part", self._options.part, "IMU=PART, such as fc=icm42688p")
        asked = {
            "vehicle.platform": self._options.platform,
            "gradienter.law": self._options.law,
            **{f"{device}.mounting": how for device, how in mountings.items()},
        }
        given = {key: words for key, words in asked.items() if words is not None}
        _refuse_wrong(given)
        if self._options.mavlink is not None:
            Draft(drafting.sample(), is_new=True).take_url(self._options.mavlink)
        found = await self._listen(draft)
        while not await self._take_autopilot(draft, found):
            found = await self._listen(draft)
        for kind in KINDS:
            await self._take_device(draft, found, kind)
        await self._ask(draft, draft.questions(), given)
        daemon = await _daemon_status(draft.parsed())
        told: dict[str, str | None] = {}
        if daemon is not None:
            told = {one["imu"]: one["name"] for one in daemon.get("profiles", ()) if one["by_device_id"]}
        elif self._options.no_check:
            say("--no-check: the autopilot is not asked for IMU 2 and 3; companion setup without it finds them")
        else:
            told = await _ask_autopilot(self.asking, draft, by_default=is_new)
        names = [imu["name"] for imu in draft.wanted["imu"]]
        to_ask = [name for name in names if told.get(name) is None or name in parts]
        given = {part_key(name): part for name, part in parts.items()}
        await self._ask(draft, draft.part_questions(to_ask), given)
        draft.parsed()
        text = draft.result()
        self.answer |= {"guessed": sorted(draft.guessed), "configuration": draft.wanted}
        if not drafting.holds(self._path, text):
            say("", f"{self._path} will say (and, as comments, all defaults):", "")
            lines = [line for line in text.splitlines() if line and not line.startswith("#")]
            followed = zip(lines, [*lines[1:], "["], strict=True)
            say(*(f"    {line}" for line, after in followed if not (line.startswith("[") and after.startswith("["))))
            if not await self.asking.agrees(
                "Write it?", more=f"yes writes the lines above to {self._path}; no changes nothing."
            ):
                raise CompanionError("not wanted")
            self._write(text)
        else:
            say("", f"{self._path} says all this already.")
            self.answer["state"] = "unchanged"
            self._so_far = f"{self._path} is as it was"
        await self._finish(runs=daemon is not None)

    async def _begin(self) -> Draft:
        try:
            draft = drafting.begin(self._path)
        except ConfigError as error:
            if self.asking.yes:
                raise
            self.asking.say(str(error))
            if not await self.asking.agrees("Begin anew? The old file is kept beside it.", by_default=False):
                raise CompanionError("that file has to be mended first") from None
            return Draft(drafting.sample(), is_new=True)
        if not draft.is_new:
            self.asking.say(f"{self._path} is there: what it says holds where you answer nothing else.")
        return draft

    async def _listen(self, draft: Draft) -> Survey:
        """Listen for devices on serial and UDP ports; send nothing."""
        options = self._options
        ports = [*map(os.path.abspath, options.ports)] or ports_to_try(list_ports())
        udp = tuple(options.udp or USUAL_PORTS)
        self.asking.say(
            f"Listening to {len(ports)} serial port{'' if len(ports) == 1 else 's'} and UDP"
            f" {', '.join(map(str, udp))}: up to half a minute.",
            "Nothing is sent. (Opening a port restarts an Arduino.)",
            "",
        )

        def tell(place: str, words: str) -> None:
            self.answer["heard"][place] = words
            self.asking.say(f"  {place}: {words}")

        found = await survey(ports, udp, tell, draft.lines)
        if not self.asking.yes and options.page is None:
            self.asking.say("", "Enter takes the answer in [brackets], ? explains, Ctrl-C ends and writes nothing.")
        return found

    async def _take_autopilot(self, draft: Draft, found: Survey) -> bool:
        """Set the autopilot's url: the configured one if detected or in use, else a detected one, else a typed one.

        Returns False if the operator asks for another search.
        """
        say, was = self.asking.say, draft.url
        heard = found.autopilots
        if self._options.mavlink is not None:
            draft.take_url(self._options.mavlink)
        elif was is not None and (not heard or any(same_url(url, was) for url in heard) or not found.checked_url(was)):
            say(f"Autopilot: {was}, as it was")
        elif was is not None:
            say(f"The autopilot is not heard at {was}.")
            draft.take_url(await self._choose("Autopilot", [*heard, was]))
        elif heard:
            draft.take_url(await self._choose("Autopilot", heard))
        elif self.asking.yes:
            raise CompanionError(
                "no autopilot was heard (its port's protocol MAVLink 2? TX to RX? --mavlink URL names its place)"
            )
        else:
            return await self._ask_for_autopilot(draft)
        return True

    async def _ask_for_autopilot(self, draft: Draft) -> bool:
        """Ask where the autopilot is; return False for a further search."""

        def put(words: str) -> bool:
            if is_found := words.strip().lower() not in ("", SEARCH):
                draft.take_url(words)
            return is_found

        self.asking.say("No autopilot was heard. Has it power? Is its port set to MAVLink 2? TX to RX, RX to TX?")
        places = (SEARCH, *USUAL_URLS)
        return bool(await self.asking.ask(Question("Where is the autopilot?", SEARCH, put, PLACES, places, PLACES)))

    async def _take_device(self, draft: Draft, found: Survey, kind: Kind) -> None:
        """Choose one of the detected devices of a kind; keep the configured one if its port is in use."""
        section, heard = draft.section(kind), found.devices(kind)
        if section is not None:
            port = section["port"]
            again = [one for one in heard if same_port(one[0], port)]
            if again or not heard or not found.checked(port):
                for _, protocol, line in again:
                    draft.take(kind, port, protocol, line)
                self.asking.say(f"{kind.capitalize()}: {section['protocol']} at {port}, as it was")
                return
            self.asking.say(f"The {kind} is not heard at {port}.")
        if not heard:
            if kind in WITHOUT:
                self.asking.say(WITHOUT[kind].capitalize())
            return
        named = {f"{protocol}: {port}, {line}": (port, protocol, line) for port, protocol, line in heard}
        names = [*named, *([section["port"]] if section is not None else [])]
        chosen = await self._choose(kind.capitalize() if kind != "imu" else "Own IMU", names)
        if chosen in named:
            draft.take(kind, *named[chosen])
            if kind == "imu":
                self.asking.say("  Its biases are shown only, not written to the autopilot (see autopilot_instance).")

    async def _choose(self, what: str, names: Sequence[str]) -> str:
        if len(names) == 1:
            self.asking.say(f"{what}: {names[0]}")
            return names[0]
        self.asking.say(*(f"  {number}. {name}" for number, name in enumerate(names, 1)))
        numbers = [str(number) for number in range(1, len(names) + 1)]
        put = functools.partial(one_of, allowed=numbers)
        return names[int(await self.asking.ask(Question(f"{what}: which?", "1", put, choices=numbers))) - 1]

    async def _ask(self, draft: Draft, questions: Iterator[Question], given: dict[str, str]) -> None:
        left = dict(given)
        for question in questions:
            left.pop(question.key, None)
            if question.key in self._measured:
                continue
            if question.key in given:
                try:
                    question.put(given[question.key])
                except ConfigError as error:
                    raise ConfigError(f"{question.key}: {error}") from None
                self.asking.say(f"{question.key}: {given[question.key]}")
            elif not self.asking.yes:
                await self._ask_one(draft, question)
            elif question.key == LAW_KEY and not question.now:
                protocol = draft.wanted["gradienter"]["protocol"]
                raise ConfigError(f"{LAW_KEY}: {protocol} does not tell; name it by --law, or test it (without --yes)")
            else:
                guess = " (a guess)" if question.key in draft.guessed else ""
                self.asking.say(f"{question.key}: {question.now}{guess}")
        if left:
            raise ConfigError(f"{', '.join(sorted(left))}: there is no such device to say it of")

    async def _ask_one(self, draft: Draft, question: Question) -> None:
        """Ask a question; for the law of the gradienter's readings, offer the guided test too."""

        def put(words: str) -> bool:
            # With no answer, and with a wrong one, name "test" among the allowed ones.
            is_test = question.key == LAW_KEY and one_of(words, question.choices) == "test"
            if not is_test:
                question.put(words)
            return is_test

        while await self.asking.ask(dataclasses.replace(question, put=put)):
            from companion.daemon.process.check import find_law  # takes seconds on a small board

            try:
                law, yaw_deg = await find_law(draft.parsed(), self.asking.say)
            except CompanionError as error:
                self.asking.say(f"  The test has no result: {error}.")
                continue
            self._measured = {LAW_KEY, "gradienter.mounting"}
            draft.put_law(law)
            draft.put_mounting("gradienter", str(yaw_deg))
            self.asking.say(f"  The gradienter reads {law}, and is turned by {yaw_deg} deg. Put it back level.")
            return

    def _write(self, text: str) -> None:
        kept = drafting.put(self._path, text)
        self._so_far = f"{self._path} is written"
        self.asking.say(f"Written: {self._path}" + (f" (the old one: {kept.name})" if kept is not None else ""))
        self.answer["kept"] = None if kept is None else str(kept)

    async def _finish(self, *, runs: bool) -> None:
        parsed = load_config(self._options, profiles=True)
        good, checks = True, not runs and not self._options.no_check
        if checks:
            good = await self._check(parsed)
        elif runs:
            self.asking.say("", "Not checked: a companion runs, and has the ports.")
        started = self._goes_on or await self._service(runs=runs)
        is_old = runs and not started and self.answer["state"] != "unchanged"
        command, runs, on_page = own_name(self._options), runs or started, self._options.page is not None
        steps = [*next_steps(parsed, command, is_old=is_old, runs=runs, good=good, checks=checks, page=on_page)]
        self.answer["next"] = steps
        if parsed.web is not None and on_page:
            from companion.web.access import page_url, split_address

            url = page_url(*split_address(parsed.web.bind))
            page = "this page shows the companion" if parsed.web.bind == self._options.page else f"open {url}"
            first = f", on the board: {steps[0].partition('   ')[0]}. Then"
            self.then = f"Next{':' if runs and good and not is_old else first} {page}."
        self.asking.say("", "Next:", *(f"  {number}. {step}" for number, step in enumerate(steps, 1)))

    async def _check(self, parsed: Config) -> bool:
        from companion.daemon.process.check import run_check

        self.asking.say("", "Checking (it speaks with all of them now, and changes nothing):")
        findings = await run_check(parsed, CHECK_S)
        self.asking.say(*finding_lines(findings))
        self.answer["findings"] = [dataclasses.asdict(finding) for finding in findings]
        return self._note_failure(problems(findings))

    async def _service(self, *, runs: bool) -> bool:
        if self._path != config.DEFAULT_PATH or self._options.no_service or not installing.systemd_runs():
            return False
        what = "Restart the companion with it?" if runs else "Start the companion now, and at every boot?"
        if not await self.asking.agrees(what):
            return False
        steps = []
        try:
            for step in installing.start_service():
                steps.append(step)
                self.asking.say(step.line())
        except CompanionError as error:
            steps.append(installing.InstallStep("service", "failed", str(error)))
            self.asking.say(str(error))
        self.answer["steps"] = [dataclasses.asdict(step) for step in steps]
        return self._note_failure(failures(steps))

    def _note_failure(self, reason: str) -> bool:
        if reason:
            self.answer |= {"state": "failed", "reason": reason}
        return not reason


def next_steps(
    parsed: Config, command: str, *, is_old: bool, runs: bool, good: bool, checks: bool, page: bool = False
) -> Iterator[str]:
    """List the operator's next steps; `is_old`: the running daemon still uses the previous configuration.

    `page`: name the page's buttons instead of commands.
    """
    is_service, align = command == "companion", f"{command} align"
    zero, faces, calibrate = f"{align} zero", f"{align} faces --write", f"{command} calibrate"
    if page:
        zero, faces, calibrate = "hold ZERO, below ALIGN", "hold FACES, below ALIGN", "hold CALIBRATE"
    if not good:
        yield f"mend what is wrong above, then: {command} check"
    if is_old:
        how = "sudo systemctl restart companion" if is_service else "end it, and start it again"
        yield f"{how}   (it still runs with the old configuration)"
    elif not runs and is_service and installing.systemd_runs():
        yield f"{installing.how_to_start()}   (starts it now, and at every boot)"
    elif not runs:
        yield f"{command} run   (leave it running, and go on {'here' if page else 'in another terminal'})"
    if not checks:
        yield f"{command} check"
    if parsed.gradienter is not None and not _zero_is_known(parsed):
        from companion.configured.models import tilt_sigma_deg  # takes a second on a small board

        sigma_deg = parsed.gradienter.sigma_deg or tilt_sigma_deg(parsed.gradienter.protocol)
        until = f"until then accelerometers to {math.radians(sigma_deg) * 1e3:.1f} mg"
        yield f"{zero}   (once: the gradienter's zero; {until})"
    ashore = parsed.vehicle.platform == "ground"
    if ashore and parsed.gradienter is None and any(imu.source == "autopilot" for imu in parsed.imu):
        yield f"{faces}   (once: accelerometers, in about 11 poses, propped up, hands off, 5 min)"
    yield f"{calibrate}   (disarmed, standing still, hands off)"


def _zero_is_known(parsed: Config) -> bool:
    from companion.daemon.poses.alignment import ActiveAlignment  # takes a second on a small board

    alignment = ActiveAlignment(parsed, offload=asyncio.to_thread)
    alignment.load()
    return alignment.used is not None


def _refuse_wrong(given: dict[str, str]) -> None:
    """Refuse wrong options before the search for devices, which takes half a minute."""
    for key, words in given.items():
        try:
            if key.endswith("mounting"):
                mounting_of(words)
            elif key == LAW_KEY:
                one_of(words, get_args(Law))
            else:
                one_of(PLATFORMS.get(words, words), get_args(Platform))
        except ConfigError as error:
            raise ConfigError(f"{key}: {error}") from None


def _named_values(option: str, given: Sequence[str], allowed: str, names: Sequence[str] = ()) -> dict[str, str]:
    found = {}
    for words in given:
        name, _, value = words.partition("=")
        if not value or (names and name not in names):
            raise ConfigError(f"{option}: found {shown(words)}; allowed: {allowed}")
        found[name] = value
    return found


async def _daemon_status(config: Config) -> Object | None:
    """Return the status of the daemon; None: no daemon runs; empty: the daemon denies this user access."""
    from companion.links.system.connection import ask

    found: Object = {}
    try:
        async for reply in ask(config.control.path, {"command": "status"}):
            found = reply.get("status", found)
    except DaemonUnreachableError as error:
        return {} if isinstance(error, DaemonDeniedError) else None
    return found


async def _ask_autopilot(asking: Interview, draft: Draft, *, by_default: bool) -> dict[str, str | None]:
    """Ask the autopilot for its IMUs, and offer to configure missing ones; return the type of each IMU by its name.

    Nothing is written to the autopilot. `by_default`: default answer to the offer.
    """
    asking.say("", "Asking the autopilot which IMUs it has: up to half a minute. Nothing is changed.")
    from companion.daemon.process.check import answering_imus  # takes seconds on a small board

    config = draft.parsed()
    mine = [msgspec.structs.replace(imu, profile=None) for imu in config.imu if imu.source == "autopilot"]
    others = {one["name"]: one for one in draft.other_imus()}
    asked = [*mine, *(Imu(**one) for one in others.values())]
    logging.disable(logging.WARNING)  # requests to IMUs that do not exist fail, as expected
    try:
        parts = await answering_imus(config, asked)
    finally:
        logging.disable(logging.NOTSET)
    for imu in asked:
        if imu.name in parts:
            part = parts[imu.name]
            words = f"{part}, by its device id" if part else "its device id tells no part of the catalogue"
            asking.say(f"  IMU {imu.instance or 1}: {words}")
    if not parts:
        asking.say("  no answer")
    found = [one for name, one in others.items() if name in parts]
    if found:
        numbers = " and ".join(str(one["instance"]) for one in found)
        question = f"It has IMU {numbers} too; calibrate that as well?"
        if await asking.agrees(question, by_default=by_default, hint=COARSE, more=_OTHERS):
            draft.wanted["imu"] += found
    return parts

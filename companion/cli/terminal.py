"""Common parts of all commands: exit codes, printing, loading of the configuration, and parsing of arguments."""

from __future__ import annotations

import argparse
import difflib
import io
import json
import math
import shlex
import shutil
import sys
from collections.abc import Callable, Collection, Coroutine, Iterable
from contextvars import ContextVar
from pathlib import Path
from typing import Any, Final, NoReturn, Self
from urllib.parse import quote

from companion import commands, config
from companion.config.sections import Config, NoiseProfile, Storage
from companion.config.words import COMMAND_LINE, refusal_of_words
from companion.errors import CompanionError, ConfigError
from companion.formats import Object, printable

DONE: Final = 0
FAILED: Final = 1
USAGE: Final = 2
NO_DAEMON: Final = 3

Command = Callable[[argparse.Namespace], Coroutine[Any, Any, int]]


as_typed: Final[ContextVar[Callable[[str], str]]] = ContextVar("as_typed", default=str)
"""Function that completes the commands in a line: `companion status` needs `-c FILE` if the operator typed that."""


class DaemonRefusedError(CompanionError):
    """The daemon has refused a request; the text is the reason."""


def print_lines(*lines: object, error: bool = False, end: str = "\n") -> None:
    """Print lines with control characters escaped: lines can contain text received from elsewhere."""
    stream = sys.stderr if error else sys.stdout
    for line in lines:
        stream.write(printable(as_typed.get()(str(line))) + end)
    stream.flush()


def print_address(url: str, token: str | None) -> None:
    if token is None:
        print_lines(f"{url} needs no token: only this board can reach it")
        return
    whole = f"{url}#token={quote(token)}"
    print_lines(f"token: {token}")
    print_lines(f"open once on the phone: {whole}")
    if ".local:" in url:
        print_lines("(a phone that does not find that name: the board's number, which hostname -I says, in its place)")
    if sys.stdout.isatty() and (sys.stdout.encoding or "").lower().startswith("utf"):
        drawn = _code(whole)
        if (wide := len(drawn[0])) > shutil.get_terminal_size().columns:
            print_lines(f"or make this window {wide} columns wide, and its camera reads a code here")
            return
        print_lines("or let its camera read this:")
        # Black on white, whatever the terminal's colours.
        sys.stdout.write("".join(f"\x1b[97;40m{line}\x1b[0m\n" for line in drawn))
        sys.stdout.flush()


def _code(text: str) -> list[str]:
    import segno

    drawn = io.StringIO()
    segno.make(text, error="l", micro=False).terminal(drawn, border=2, compact=True)
    return drawn.getvalue().splitlines()


def load_config(options: argparse.Namespace, *, profiles: bool = False, forgiving: bool = False) -> Config:
    """Load the configuration, and the saved noise profiles that it names if `profiles` is True.

    A client of the daemon may lack the right to read profiles. `forgiving`: replace a damaged profile by a default.
    """

    def saved(directory: Path, name: str) -> NoiseProfile | str:
        from companion.storage.profiles import saved_profile

        return saved_profile(directory, name, forgiving=forgiving) if profiles else name

    return config.load(config_path(options), saved)


def storage_path(options: argparse.Namespace) -> Path:
    """Return the configured storage folder, or the default one if there is no configuration."""
    try:
        return load_config(options).storage.path
    except ConfigError:
        if hasattr(options, "config"):
            raise
        return Storage().path


def config_path(options: argparse.Namespace) -> Path:
    path: Path = getattr(options, "config", config.DEFAULT_PATH)
    return path


def own_name(options: argparse.Namespace) -> str:
    path = config_path(options)
    in_path = shutil.which("companion") or Path(sys.argv[0]).name != "companion"
    program = "companion" if in_path else shlex.quote(sys.argv[0])
    return program if path == config.DEFAULT_PATH else f"{program} -c {shlex.quote(str(path))}"


def how_to_start(options: argparse.Namespace) -> str:
    from companion.installation.install import is_service

    is_served = is_service() and config_path(options) == config.DEFAULT_PATH
    return f"; start it with: {'sudo systemctl start companion' if is_served else f'{own_name(options)} run'}"


class _Removed(argparse.Action):
    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        parser.error(str(refusal_of_words(parser.prog, self.option_strings[0])))


MEANT: Final = {
    "monitor": "status --watch",
    "web-token": "page",
    "install-service": "service install",
    "uninstall-service": "service remove",
    "lua": "autopilot script",
    "autopilot-setup": "autopilot params",
    "temperature": "autopilot temperature",
    "record": "log record",
    "replay": "log replay",
    "flight": "log flight",
    "profile": "log profile",
    "start": "service install (starts at every boot), or companion run (here and now)",
    "stop": "cancel (the calibration); sudo systemctl stop companion (the service)",
    "doctor": "check",
    "test": "check",
    "restore": "undo",
}
"""Commands by their names before 0.3, and by names that people try."""
_NEAR: Final = 0.75  # Least ratio of `difflib` at which a word counts as misspelt


def _misspelt(word: str, known: Iterable[str]) -> str | None:
    return next(iter(difflib.get_close_matches(word, list(known), 1, _NEAR)), None)


class Parser(argparse.ArgumentParser):
    """Argument parser that reports a usage error in one line, with a suggestion for a misspelt word."""

    def __init__(self, *arguments: Any, **keywords: Any) -> None:
        super().__init__(*arguments, **{"allow_abbrev": False, **keywords})
        for command, _, option in (words.partition(" --") for words in COMMAND_LINE):
            if option and command == self.prog:
                self.add_argument(f"--{option}", action=_Removed, nargs="?", help=argparse.SUPPRESS)

    def error(self, message: str) -> NoReturn:
        print_lines(f"{self.prog}: {message} (see {self.prog} --help)", error=True)
        self.exit(USAGE)

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> tuple[Any, list[str]]:
        options, unknown = super().parse_known_args(args, namespace)
        if word := next((word.partition("=")[0] for word in unknown if word.startswith("-")), None):
            near = _misspelt(word, self._option_string_actions)
            self.error(f"unknown option {word}{f'; did you mean {near}?' if near else ''}")
        return options, unknown

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        if action.choices is None or value in action.choices or value is argparse.SUPPRESS:
            return
        if (refusal := refusal_of_words(self.prog, str(value))) is not None:
            self.error(refusal)
        choices = list(map(str, action.choices))
        if self.prog == "companion" and (meant := MEANT.get(str(value))):
            self.error(f"no command {value!r}; type companion {meant}")
        near = _misspelt(str(value), choices)
        if action.metavar == "COMMAND":
            self.error(f"no command {str(value)!r}{f'; did you mean {near}?' if near else ''}")
        hint = f"did you mean {near}?" if near else f"allowed: {', '.join(choices)}"
        raise argparse.ArgumentError(action, f"found {str(value)!r}; {hint}")


class CommandGroup:
    """Commands of one parser, and the options that all of them have."""

    def __init__(self, parser: Parser, *parents: Parser, listed: bool = True) -> None:
        shown = None if listed else argparse.SUPPRESS
        self._to = parser.add_subparsers(
            title="commands", metavar="COMMAND", required=True, prog=parser.prog, help=shown, parser_class=Parser
        )
        self._parents = parents

    def __getitem__(self, name: str) -> Parser:
        return self._to.choices[name]

    def add(self, name: str, command: Command, words: str) -> Parser:
        sub = self._to.add_parser(name, parents=self._parents, help=words, description=words)
        sub.set_defaults(command=command)
        return sub

    def group(self, name: str, words: str, *parents: Parser) -> Self:
        """Add a command that has commands of its own, with further common options."""
        sub = self._to.add_parser(name, help=words, description=words)
        return type(self)(sub, *self._parents, *parents)


def within(least: float, most: float, kind: type[float] = float, unit: str = "") -> Callable[[str], float]:
    """Return a type for argparse that accepts a number within limits; if `kind` is int, only a whole number."""

    def parsed(text: str) -> float:
        try:
            value = kind(text)
        except ValueError:
            value = math.nan
        if not least <= value <= most:
            raise argparse.ArgumentTypeError(f"found {text!r}; allowed: a number from {least:g} to {most:g}{unit}")
        return value

    return parsed


seconds: Final = within(1e-3, 1e6, unit=" s")  # Type of an argument for a time in seconds
_ARGUMENTS: Final = {float: seconds, int: within(1, 1e6, int)}


def add_fields(
    parser: argparse.ArgumentParser,
    kind: type[commands.Command],
    by: commands.Interface,
    only: Collection[str] | None = None,
) -> None:
    """Add an option for each field of a command that the interface may set, or for those named in `only`."""
    groups: dict[str, argparse._ActionsContainer] = {}
    for name, field in kind.fields(by).items():
        if only is not None and name not in only:
            continue
        to: argparse._ActionsContainer = parser
        if group := field.group or (name if field.flags else ""):
            to = groups.get(group) or parser.add_mutually_exclusive_group(required=field.positional)
            groups[group] = to
        values = [value for value in field.values if value not in field.flags]
        if field.positional:
            shape: dict[str, Any] = {"metavar": field.metavar or "|".join(values), "choices": values or None}
            # Without SUPPRESS, the default of a positional argument would overwrite the value of a flag.
            to.add_argument(name, nargs="?", default=argparse.SUPPRESS, help=field.help, **shape)
        for value, words in field.flags.items():
            to.add_argument(f"--{value}", dest=name, action="store_const", const=value, help=words)
        if field.positional or field.flags:
            continue
        if field.kind is bool:
            to.add_argument(f"--{name}", action="store_true", help=field.help)
        else:
            names = [each for each in (field.short, f"--{name.removesuffix('_s')}") if each]
            shape = {"type": _ARGUMENTS[field.kind], "choices": values or None, "metavar": field.metavar}
            to.add_argument(*names, dest=name, default=field.default, help=field.help, **shape)


def request_of(options: argparse.Namespace, kind: type[commands.Command]) -> Object:
    given = {name: getattr(options, name, None) for name in kind.fields()}
    return {"command": kind.name(), **{name: value for name, value in given.items() if value is not None}}


def conclude(options: argparse.Namespace, answer: Any, lines: Iterable[object], *, good: bool) -> int:
    if options.json:
        print_json(answer)
    else:
        print_lines(*lines)
    return DONE if good else FAILED


def print_json(value: Any) -> None:
    sys.stdout.write(json.dumps(value) + "\n")
    sys.stdout.flush()

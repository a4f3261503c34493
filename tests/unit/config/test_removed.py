"""Removed configuration keys, commands and options are refused in one line with the version and the remedy."""

from __future__ import annotations

import argparse
import re
import typing

import msgspec
import pytest

from companion import cli
from companion.config import parse
from companion.config.sections import Config
from companion.config.words import COMMAND_LINE, KEYS
from companion.errors import ConfigError

SMALLEST = """
[mavlink]
url = "udpout:127.0.0.1:14550"
[[imu]]
name = "fc"
source = "autopilot"
"""


@pytest.mark.parametrize(
    ("key", "text", "shown"),
    [
        ("push.shake", "[push]\nshake = true", "push.shake"),
        ("imu.shake", "shake = 1", "imu[0].shake"),
        ("shaker", "[shaker]\nport = 1", "shaker"),
    ],
)
def test_a_removed_key_is_refused_with_its_remedy(
    key: str, text: str, shown: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(KEYS, key, "0.2: delete the line")
    with pytest.raises(ConfigError) as refused:
        parse(SMALLEST + text, "x.toml")
    assert str(refused.value) == f"x.toml: {shown} was removed in 0.2: delete the line; see CHANGELOG"


@pytest.mark.parametrize(
    "words", [["status", "--shake"], ["status", "--shake", "3"], ["--json", "status", "--shake=3"]]
)
def test_a_removed_option_is_refused_with_its_remedy(
    words: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(COMMAND_LINE, "companion status --shake", "0.2: shake it by hand")
    with pytest.raises(SystemExit) as ended:
        cli.main(words)
    assert ended.value.code == 2
    line = "companion status: --shake was removed in 0.2: shake it by hand (see companion status --help)\n"
    assert capsys.readouterr() == ("", line)


def test_a_removed_command_is_refused_with_its_remedy(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(COMMAND_LINE, "companion shake", "0.2: shake it by hand")
    with pytest.raises(SystemExit) as ended:
        cli.main(["shake", "--hard"])
    assert ended.value.code == 2
    line = "companion: shake was removed in 0.2: shake it by hand (see companion --help)\n"
    assert capsys.readouterr() == ("", line)


def test_every_row_is_gone_and_says_since_when_and_what_to_do() -> None:
    for remedy in (*KEYS.values(), *COMMAND_LINE.values()):
        assert re.fullmatch(r"\d+\.\d+: [^;\n]+", remedy)
    for path in KEYS:
        section: object = Config
        *sections, key = path.split(".")
        for name in sections:
            assert isinstance(section, type)
            section = next(each for each in _structs(typing.get_type_hints(section)[name]))
        assert isinstance(section, type)
        assert key not in typing.get_type_hints(section)
    commands = {words.partition(" --")[0] for words in COMMAND_LINE if " --" in words}
    removed = {words for words in COMMAND_LINE if " --" not in words}
    known = {parser.prog: parser for parser in _parsers(cli._parser())}
    assert commands <= set(known)
    assert not removed & set(known)


def _structs(annotation: object) -> list[type]:
    """List the section types inside an annotation such as `list[Section]`."""
    if isinstance(annotation, type) and issubclass(annotation, msgspec.Struct):
        return [annotation]
    return [found for inner in typing.get_args(annotation) for found in _structs(inner)]


def _parsers(parser: argparse.ArgumentParser) -> list[argparse.ArgumentParser]:
    """List a parser and all parsers of its commands."""
    inner = [
        each
        for action in parser._actions
        if isinstance(action, argparse._SubParsersAction)
        for each in action.choices.values()
    ]
    return [parser, *(found for each in inner for found in _parsers(each))]

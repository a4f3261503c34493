"""README.md and docs/*.md: links lead somewhere, configurations are taken, commands are understood.

The conventions: docs/maintaining.md.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import re
import shlex
import typing
from pathlib import Path
from typing import Any

import msgspec
import pytest

from companion import cli
from companion.config import parse
from companion.config.sections import Config
from tests.support.documents import DOCUMENTS, README, ROOT, Block, blocks, commands_in, headings, prose

MINIMAL = {"mavlink": '[mavlink]\nurl = "tcp:h:1"\n', "imu": '[[imu]]\nname = "a"\nsource = "autopilot"\n'}


def identity(path: Path) -> str:
    return path.name


# --- links


@pytest.mark.parametrize("path", DOCUMENTS, ids=identity)
def test_links_lead_somewhere(path: Path) -> None:
    wrong = []
    for target in re.findall(r"\]\(([^)\s]+)\)", prose(path)):
        if re.match(r"[a-z]+:", target):
            continue
        name, _, anchor = target.partition("#")
        there = (path.parent / name).resolve() if name else path
        if not there.is_relative_to(ROOT) or not there.exists():
            wrong.append(f"{target}: no such file")
        elif anchor and anchor not in headings(there):
            wrong.append(f"{target}: no such heading")
    assert wrong == []


def test_every_document_is_named_in_the_readme() -> None:
    linked = {(ROOT / target.partition("#")[0]).resolve() for target in re.findall(r"\]\(([^)\s]+)\)", prose(README))}
    assert set(DOCUMENTS) - linked == {README}


# --- configuration


def configurations() -> list[Block]:
    return [block for path in DOCUMENTS for block in blocks(path) if block.language == "toml"]


@pytest.mark.parametrize("block", configurations(), ids=lambda block: f"{block.path.name}:{block.line}")
def test_configurations_are_taken(block: Block) -> None:
    missing = [
        text for section, text in MINIMAL.items() if not re.search(rf"^\[+{section}\]", block.text, re.MULTILINE)
    ]
    parse("\n".join([block.text, *missing]), f"{block.path.name}:{block.line}")


def keys() -> set[str]:
    """section.key of everything that can be configured."""

    def inner(annotation: Any) -> type[msgspec.Struct] | None:
        if isinstance(annotation, type) and issubclass(annotation, msgspec.Struct):
            return annotation
        return next((found for each in typing.get_args(annotation) if (found := inner(each))), None)

    sections = {name: inner(annotation) for name, annotation in typing.get_type_hints(Config).items()}
    return {f"{name}.{key}" for name, section in sections.items() if section for key in section.__struct_fields__}


@pytest.mark.parametrize("path", DOCUMENTS, ids=identity)
def test_keys_in_the_text_exist(path: Path) -> None:
    sections = "|".join(sorted({key.partition(".")[0] for key in keys()}))
    named = re.findall(rf"`((?:{sections})\.[a-z_]+)(?: = [^`]*)?`", prose(path))
    files = {name for name in named if name.endswith((".py", ".toml")) or name == "mqtt.password"}
    assert set(named) - keys() - files == set()


# --- commands


def understood(command: str) -> str:
    """Nothing when the real parser takes the command; else what it says."""
    words = shlex.split(command, comments=True)
    said = io.StringIO()
    with contextlib.redirect_stderr(said), contextlib.redirect_stdout(said):
        try:
            if words[0] == "companion":
                cli._parser().parse_args(words[1:])
            else:
                sim_parser(words[3:]).parse_args(words[3:])
        except SystemExit as end:
            return said.getvalue() if end.code else ""
    return ""


def sim_parser(words: list[str]) -> argparse.ArgumentParser:
    """Parser of `python -m sim`, chosen as in sim/__main__.py."""
    from sim import rest, serve
    from sim.accuracy import recordings
    from sim.flying import cli as flying
    from sim.sitl import cli as firmware

    for name, own in (("rest", rest.parser), ("fly", flying.parser), ("recordings", recordings.parser)):
        if words[:1] == [name]:
            made = argparse.ArgumentParser()
            made.add_subparsers().add_parser(name, parents=[own()], add_help=False)
            return made
    return firmware.parser() if words[:1] and words[0] in serve.FIRMWARE_COMMANDS else serve.parser()


@pytest.mark.parametrize("path", DOCUMENTS, ids=identity)
def test_commands_are_understood(path: Path) -> None:
    said = {command: understood(command) for command in commands_in(path)}
    assert {command: words for command, words in said.items() if words} == {}


def test_named_make_targets_exist() -> None:
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    named = {
        name for path in DOCUMENTS for name in re.findall(r"(?:^ {4}|`|PX4_SITL=\S+ )make ([a-z-]+)", path.read_text())
    }
    assert named
    assert named <= targets


def test_named_modules_exist() -> None:
    """Documents name a module by its path, or by the end of its path, and what it defines behind a colon."""
    span = r"`((?:[a-z0-9_]+/)*[a-z0-9_]+\.py)(?::(\w+))?`"
    named = {found for path in DOCUMENTS for found in re.findall(span, path.read_text())}
    assert len(named) > 25
    here = {
        str(path): path.read_text()
        for folder in ("companion", "tests", "sim")
        for path in (ROOT / folder).rglob("*.py")
    }
    wrong = []
    for name, defined in sorted(named):
        texts = [text for path, text in here.items() if path.endswith(f"/{name}")]
        what = rf"^\s*(?:async )?(?:def|class) {defined}\b|^{defined}\b[^\n]* =" if defined else ""
        if not any(re.search(what, text, flags=re.MULTILINE) for text in texts):
            wrong.append(f"{name}:{defined}")
    assert wrong == []
    for module in re.findall(r"python -m (tests\.[a-z_.]+)", "".join(path.read_text() for path in DOCUMENTS)):
        path = ROOT / module.rstrip(".").replace(".", "/")
        assert path.with_suffix(".py").exists() or (path / "__main__.py").exists(), module

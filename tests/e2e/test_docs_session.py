"""The console sessions in the documents happen as they are shown.

Real are the command line's parser, commands and words, and the whole daemon behind them, on virtual time; only the
socket between the two is left out (tests/e2e/test_commands.py has it).
"""

from __future__ import annotations

import argparse
import asyncio
import json
import re
import shlex
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import msgspec
import pytest

from companion import cli
from companion.cli import client, local
from companion.cli.terminal import DONE
from companion.daemon.process import check
from companion.links.serial.bytestream import ByteLink
from tests.support.documents import DOCUMENTS, session
from tests.support.rig import Rig
from tests.support.virtual_time import run_virtual

NEXT_COMMAND_S = 5.0
"""A person reads what was said before typing on."""
WITH_SESSIONS = [path for path in DOCUMENTS if session(path)]


def in_short(line: str) -> str:
    """A line without what differs from one time to the next: numbers, and the width of gaps."""
    return " ".join(re.sub(r"[+-]?\d+(?:\.\d+)*(?:-dev)?", "N", line).split())


def shown(expected: list[str], said: str) -> bool:
    """Whether the expected lines come in this order; each may be the beginning of one."""
    lines = iter([in_short(line) for line in said.splitlines()])
    return all(any(line.startswith(in_short(wanted)) for line in lines) for wanted in expected if wanted != "...")


@pytest.mark.parametrize("path", WITH_SESSIONS, ids=lambda path: str(path.name))
def test_the_session_happens_as_shown(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    async def main() -> None:
        async with Rig(tmp_path, at_arm="warn").running() as rig:

            async def ask(_path: Path, request: dict[str, Any]) -> AsyncIterator[dict[str, Any]]:
                async for reply in rig.service.faces.answer(request):
                    yield json.loads(msgspec.json.encode(reply))

            for module in (client, check):
                monkeypatch.setattr(module, "ask", ask)
            for module in (client, local):
                monkeypatch.setattr(module, "load_config", lambda _options, **_more: rig.config)
            # The rig hands the devices' bytes over without opening a port.
            monkeypatch.setattr(ByteLink, "connected", property(lambda _link: True))
            await rig.ready()
            for command, expected in session(path):
                words = shlex.split(command)
                assert words[0] == "companion", f"{path.name}: {command}: only the companion's commands can be run"
                options = cli._parser().parse_args(words[1:], argparse.Namespace(json=False))
                code = await cli._run(options)
                output = capsys.readouterr()
                said = output.err + output.out
                assert code == DONE, f"{command}: {said}"
                assert shown(expected, said), f"{command}: {expected} is not in\n{said}"
                happened.append(f"$ {command}\n{said}")
                await asyncio.sleep(NEXT_COMMAND_S)

    happened: list[str] = []
    run_virtual(main())
    print("\n".join(happened))  # for whoever writes the document: pytest -s

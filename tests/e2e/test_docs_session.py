"""The console sessions in the documents happen as they are shown: real processes, ptys and sockets, in real time."""

from __future__ import annotations

import asyncio
import re
import shlex
from pathlib import Path

import pytest

from sim.companion_process import CompanionProcess
from tests.support.documents import DOCUMENTS, session
from tests.support.live_aircraft import QUICK, live_aircraft

WITH_SESSIONS = [path for path in DOCUMENTS if session(path)]
WITHIN_S = 60.0


def in_short(line: str) -> str:
    """A line without what differs from one time to the next: numbers, and the width of gaps."""
    return " ".join(re.sub(r"[+-]?\d+(?:\.\d+)*(?:-dev)?", "N", line).split())


def shown(expected: list[str], said: str) -> bool:
    """Whether the expected lines come in this order; each may be the beginning of one."""
    lines = iter([in_short(line) for line in said.splitlines()])
    return all(any(line.startswith(in_short(wanted)) for line in lines) for wanted in expected if wanted != "...")


def test_some_document_has_a_session() -> None:
    assert WITH_SESSIONS


def test_a_line_that_does_not_come_is_noticed() -> None:
    assert shown(["state: done", "in force: 3 min"], "state:  done, and well\nat arming\nin force: 14 min ago")
    assert not shown(["in force:", "state: done"], "state: done\nin force: 14 min ago")
    assert not shown(["state: done"], "state: failed")


@pytest.mark.parametrize("path", WITH_SESSIONS, ids=lambda path: str(path.name))
def test_the_session_happens_as_shown(path: Path, tmp_path: Path) -> None:
    async def main() -> None:
        async with (
            live_aircraft(tmp_path, QUICK.replace("max_s = 4", "max_s = 2")),
            CompanionProcess(tmp_path) as daemon,
        ):
            await daemon.ready()
            for command, expected in session(path):
                words = shlex.split(command)
                assert words[0] == "companion", f"{path.name}: {command}: only the companion's commands can be run"
                process = await asyncio.create_subprocess_exec(
                    *daemon.command(*words[1:]), stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.STDOUT
                )
                async with asyncio.timeout(WITHIN_S):
                    said = (await process.communicate())[0].decode()
                assert process.returncode == 0, f"{command}: {said}"
                assert shown(expected, said), f"{command}: {expected} is not in\n{said}"
                print(f"$ {command}\n{said}")

    asyncio.run(main())

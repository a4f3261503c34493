"""Child processes of the daemon: each end of one is noticed, said, and followed by another start."""

from __future__ import annotations

import asyncio
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import msgspec
import pytest

from companion.config import parse
from companion.daemon.interfaces import child as daemon_side
from companion.daemon.interfaces.child import Child
from companion.links.system.process import ChildSettings

MODULE = "tests.support.child_process"
CONFIG = """
[mavlink]
url = "udpin:127.0.0.1:14550"
[[imu]]
name = "fc"
source = "autopilot"
[storage]
directory = "{}"
"""

pytestmark = pytest.mark.real_clock


def _settings(folder: Path) -> ChildSettings:
    return ChildSettings(parse(CONFIG.format(folder), "test.toml"))


def _log(folder: Path) -> list[str]:
    path = folder / "log"
    return path.read_text(encoding="utf-8").splitlines() if path.exists() else []


def _starts(folder: Path) -> int:
    return sum(line.startswith("started") for line in _log(folder))


async def _until(condition: Callable[[], bool]) -> None:
    while not condition():
        await asyncio.sleep(0.02)


async def _runs(folder: Path, then: Callable[[Child], bool]) -> Child:
    """Run a child until the condition holds, then stop it, and ask again while it is being ended."""
    child = Child("test", MODULE, _settings(folder))
    task = asyncio.create_task(child.run())
    await _until(lambda: then(child))
    task.cancel()
    await asyncio.sleep(0.05)
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)
    return child


@pytest.fixture(autouse=True)
def _repository(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", os.getcwd())


def test_a_child_reports_and_ends_in_order(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COMPANION_TEST_CHILD", "work")
    child = asyncio.run(_runs(tmp_path, lambda child: child.status()["good"]))
    assert _log(tmp_path)[-1] == "ended"
    assert child.status() == {"good": False, "summary": "starting"}


@pytest.mark.parametrize(
    ("manner", "reason"),
    [
        ("crash", "the process ended with code 1"),
        ("greedy", "the process needed more memory than it may have"),
        ("greedy callback", "the process needed more memory than it may have"),
        ("hang", "the process gave no sign of life for 1 s: ended"),
        ("garbage", "the process sent an unreadable report: "),
    ],
)
def test_a_child_that_fails_is_started_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, manner: str, reason: str
) -> None:
    monkeypatch.setenv("COMPANION_TEST_CHILD", manner)
    for limit in ("SILENT_S", "FIRST_REPORT_S"):
        monkeypatch.setattr(daemon_side, limit, 1.0 if manner == "hang" else 60.0)
    reasons: set[str] = set()

    def started_again(child: Child) -> bool:
        reasons.add(child.status()["summary"])
        return _starts(tmp_path) >= 2

    asyncio.run(_runs(tmp_path, started_again))
    assert any(each.startswith(reason) for each in reasons), reasons


def test_a_child_that_ignores_the_request_to_end_is_killed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COMPANION_TEST_CHILD", "deaf")
    monkeypatch.setattr(daemon_side, "END_WITHIN_S", 0.2)
    asyncio.run(_runs(tmp_path, lambda child: child.status()["good"]))
    (process_id,) = (int(line.split()[1]) for line in _log(tmp_path) if line.startswith("started"))
    assert not Path(f"/proc/{process_id}").exists()


def test_a_child_whose_daemon_was_killed_does_its_last_work_whole(tmp_path: Path) -> None:
    """A report finds nobody who reads it while the child does what it has to do at its end."""
    environment = {**os.environ, "COMPANION_TEST_CHILD": "slow end"}
    with subprocess.Popen(
        [sys.executable, "-m", MODULE], stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment
    ) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        process.stdin.write(msgspec.json.encode(_settings(tmp_path)) + b"\n")
        process.stdin.flush()
        assert msgspec.json.decode(process.stdout.readline())["good"]
        process.stdin.close()
        process.stdout.close()
        assert process.wait() == 0
    assert _log(tmp_path)[-1] == "ended"

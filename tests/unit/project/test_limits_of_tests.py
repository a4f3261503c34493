"""The rules of tests/conftest.py in a run of their own: a test that hangs, and one that leaves something outside."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

PROJECT = Path(__file__).parents[3]
HANGING = """
import asyncio

async def goes_on() -> None:
    while True:  # whatever ends a step of it
        try:
            await asyncio.sleep(0)
        except BaseException:
            pass

def test_hangs() -> None:
    async def main() -> None:
        asyncio.create_task(goes_on())
        await asyncio.Event().wait()

    loop = asyncio.new_event_loop()
    loop.run_until_complete(main())

def test_goes_on() -> None:
    pass
"""
LEAVING = """
import os
from pathlib import Path

def test_leaves() -> None:
    assert Path.home() != Path(os.environ["BEFORE"])
    assert not list(Path.home().iterdir())
    Path({folder!r}, "etc/new").mkdir(parents=True)
"""


def run(folder: Path, text: str, *options: str) -> tuple[int, str]:
    test = folder / "test_one.py"
    test.write_text(text)
    # The folders in place of those of this machine, in which others may write meanwhile.
    (folder / "watched.py").write_text(
        "import tests.conftest as conftest, tests.support.outside as outside\n"
        "conftest.LIMIT_AGAIN_S = 5.0\n"
        f"outside.DEPTHS, outside.HOME_DEPTHS = {{{str(folder / 'watched')!r}: 2}}, {{}}\n"
    )
    command = [sys.executable, "-m", "pytest", "-q", "-c", str(PROJECT / "pyproject.toml"), "--rootdir", str(folder)]
    command += ["-p", "watched", "-p", "tests.conftest", "-p", "no:cacheprovider", *options, str(test)]
    env = {**os.environ, "PYTHONPATH": f"{PROJECT}:{folder}", "BEFORE": str(Path.home())}
    ended = subprocess.run(command, capture_output=True, text=True, timeout=120.0, check=False, env=env, cwd=folder)
    return ended.returncode, ended.stdout + ended.stderr


def test_a_test_that_hangs_fails_with_its_stack_and_the_run_goes_on(tmp_path: Path) -> None:
    code, said = run(tmp_path, HANGING, "-o", "timeout=1")
    assert code == 1, said
    assert "loop.run_until_complete(main())" in said
    assert "Timeout" in said
    assert "1 failed, 1 passed" in said


def test_what_a_test_leaves_outside_fails_the_run(tmp_path: Path) -> None:
    (tmp_path / "watched").mkdir()
    (tmp_path / "watched" / "old").touch()
    for options in ((), ("-n", "1")):
        code, said = run(tmp_path, LEAVING.format(folder=str(tmp_path / "watched")), *options)
        assert code == 1, said
        assert "1 passed" in said
        left = [line.partition(":")[0] for line in said.splitlines() if "new since the start" in line]
        assert left == [str(tmp_path / "watched" / name) for name in ("etc", "etc/new")]
        (tmp_path / "watched/etc/new").rmdir()
        (tmp_path / "watched/etc").rmdir()

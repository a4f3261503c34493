"""One daemon to a storage directory, whatever lies there and however the one before has ended."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from companion.errors import StorageError
from companion.storage.state import only_daemon

pytestmark = pytest.mark.real_clock

HOLDER = """
import sys, time
from pathlib import Path
from companion.storage.state import only_daemon
with only_daemon(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(600.0)
"""


def test_a_second_one_is_refused_until_the_first_has_ended_even_by_kill_9(tmp_path: Path) -> None:
    folder = tmp_path / "state"
    with subprocess.Popen([sys.executable, "-c", HOLDER, str(folder)], stdout=subprocess.PIPE, text=True) as holder:
        try:
            assert holder.stdout is not None
            assert holder.stdout.readline() == "held\n"
            words = r"state: cannot be used: another daemon works with this directory$"
            for _ in range(2):
                with pytest.raises(StorageError, match=words), only_daemon(folder):
                    pass
        finally:
            holder.kill()
    with only_daemon(folder):
        pass


def test_the_command_ends_with_1_and_one_line(tmp_path: Path) -> None:
    config = tmp_path / "companion.toml"
    config.write_text(
        '[mavlink]\nurl = "udpout:127.0.0.1:9"\n[[imu]]\nname = "fc"\nsource = "autopilot"\n'
        f'[control]\nsocket = "{tmp_path}/c"\n[storage]\ndirectory = "{tmp_path}/state"\nrecordings_mb = 0\n',
        encoding="utf-8",
    )
    with only_daemon(tmp_path / "state"):
        command = [sys.executable, "-m", "companion", "-c", str(config), "run"]
        ended = subprocess.run(command, capture_output=True, text=True, timeout=60.0, check=False)
    assert ended.returncode == 1, ended.stderr
    words = f"companion: {tmp_path}/state: cannot be used: another daemon works with this directory"
    assert ended.stderr.splitlines()[-1] == words
    assert "Traceback" not in ended.stderr
    assert not (tmp_path / "c").exists()

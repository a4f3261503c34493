"""Mount namespaces of a test's own, in which an ordinary user may mount too, where the kernel allows that."""

from __future__ import annotations

import functools
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Final

import pytest

OWN_MOUNTS: Final = ("unshare", "--mount") if os.geteuid() == 0 else ("unshare", "--map-root-user", "--mount")
"""Start of a command that runs in such a namespace."""
OWN_SHARED_MEMORY: Final = (*OWN_MOUNTS, "sh", "-c", 'mount -n -t tmpfs tmpfs /dev/shm && exec "$@"', "sh")
"""Start of a command that runs with an empty, writable /dev/shm."""
_AGAIN: Final = "COMPANION_TEST_RUNS_AGAIN"
"""Environment variable of a test that already runs in a namespace."""


def has_shared_memory() -> bool:
    """Return whether semaphores, of which pools of processes are made, can be had here."""
    return os.access("/dev/shm", os.W_OK)


@functools.cache
def why_no_mounts() -> str | None:
    """Return why nothing can be mounted in a namespace here, or None."""
    command = [*OWN_MOUNTS, "mount", "-n", "-t", "tmpfs", "tmpfs", "/tmp"]
    tried = subprocess.run(command, capture_output=True, text=True, check=False)
    return f"no namespaces for a mount: {tried.stderr.strip()}" if tried.returncode else None


def run_again_with_mounts(test: pytest.Item) -> None:
    """Run a test once more, in a namespace with shared memory in which it may mount; skip it where there is none."""
    why = why_no_mounts()
    if why is not None or _AGAIN in os.environ:
        pytest.skip(why or "no namespaces for a mount: not allowed in them either")
    command = [*OWN_SHARED_MEMORY, sys.executable, "-m", "pytest", "-q", test.nodeid]
    # In there the user is root, and root's own folder of earlier tests may belong to the real one.
    with tempfile.TemporaryDirectory() as folder:
        done = subprocess.run(
            command, cwd=Path(__file__).parents[2], capture_output=True, text=True, check=False,
            env={**os.environ, _AGAIN: "1", "PYTEST_DEBUG_TEMPROOT": folder},
        )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    assert "1 passed" in done.stdout

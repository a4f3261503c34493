"""The companion as pip installs it, for what depends on that: its bytecode is there, or it is not.

A checkout is no measure: whether Python may keep bytecode beside it says the environment, and the difference is half a
second of processor time and twice the memory.
"""

from __future__ import annotations

import compileall
import os
import shutil
from pathlib import Path

import companion


def install(folder: Path, *, bytecode: bool = True) -> dict[str, str]:
    """Put a copy of the package into the folder; the environment in which Python finds it there.

    Args:
        folder: where to; made where there is none.
        bytecode: compile it, as pip does; else none of its bytecode is there, and none is kept.
    """
    package = folder / "companion"
    shutil.copytree(Path(companion.__file__).parent, package, ignore=shutil.ignore_patterns("__pycache__"))
    kept = {name: value for name, value in os.environ.items() if name not in _WOULD_CHANGE_IT}
    kept |= {"PYTHONPATH": str(folder), "PYTHONSAFEPATH": "1"}  # not from where it is started: that may be a checkout
    kept |= {name: value for name, value in unit_environment().items() if name.startswith("MALLOC_")}
    if not bytecode:
        return {**kept, "PYTHONDONTWRITEBYTECODE": "1"}
    if not compileall.compile_dir(package, quiet=1):
        raise RuntimeError(f"{package} cannot be compiled")
    return kept


def unit_environment() -> dict[str, str]:
    """Read what the service's unit puts into the environment."""
    lines = (Path(companion.__file__).parents[1] / "systemd" / "companion.service").read_text().splitlines()
    given = [line.removeprefix("Environment=") for line in lines if line.startswith("Environment=")]
    return dict(word.split("=", 1) for line in given for word in line.split())


_WOULD_CHANGE_IT = frozenset(
    {"PYTHONDONTWRITEBYTECODE", "PYTHONPYCACHEPREFIX", "PYTHONOPTIMIZE", "PYTHONUNBUFFERED", "NOTIFY_SOCKET"}
)

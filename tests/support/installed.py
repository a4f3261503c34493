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
    kept |= {
        "MALLOC_ARENA_MAX": "1",
        "MALLOC_MMAP_THRESHOLD_": "131072",
        "MALLOC_TRIM_THRESHOLD_": "131072",
    }  # the unit's
    if not bytecode:
        return {**kept, "PYTHONDONTWRITEBYTECODE": "1"}
    if not compileall.compile_dir(package, quiet=1):
        raise RuntimeError(f"{package} cannot be compiled")
    return kept


_WOULD_CHANGE_IT = frozenset(
    {"PYTHONDONTWRITEBYTECODE", "PYTHONPYCACHEPREFIX", "PYTHONOPTIMIZE", "PYTHONUNBUFFERED", "NOTIFY_SOCKET"}
)

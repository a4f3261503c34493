"""The daemon's process: `python -m companion.daemon FILE [-v]`. `companion run` replaces itself by this process."""

import gc
import os
import sys


def prepare() -> None:
    """Reduce start time and memory (docs/speed.md); call before asyncio, numpy and the dialect are imported."""
    # The daemon uses no TLS, and asyncio and hashlib work without OpenSSL: leaving it out saves 5 MiB.
    # None in place of a module makes its import raise ImportError.
    sys.modules.update({"ssl": None, "_hashlib": None})  # type: ignore[dict-item]
    # Imports create objects that stay; searching these for garbage takes a tenth of the start time.
    gc.disable()
    # OpenBLAS would start a thread with buffers for every processor; 6-by-6 matrices need one.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


if __name__ == "__main__":
    prepare()
    from companion.daemon.process.service import main

    sys.exit(main(*sys.argv[1:]))

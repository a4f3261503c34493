"""The daemon's process: `python -m companion.daemon FILE [-v]`. `companion run` turns into it."""

import gc
import os
import sys


def prepare() -> None:
    """Make start and memory small (docs/speed.md); call it before asyncio, numpy and the dialect are imported."""
    # The daemon speaks no TLS, and asyncio and hashlib do without OpenSSL where it is not installed: 5 MiB less.
    # None in the place of a module makes its import an ImportError.
    sys.modules.update({"ssl": None, "_hashlib": None})  # type: ignore[dict-item]
    # Garbage collection among classes and modules that stay costs a tenth of the start.
    gc.disable()
    # A thread for every processor, with its own buffers, for matrices of 6 by 6.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


if __name__ == "__main__":
    prepare()
    from companion.daemon.process.service import main

    sys.exit(main(*sys.argv[1:]))

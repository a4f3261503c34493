"""Process settings for a short start and small memory, measured by `python -m tests.bench_start` (docs/speed.md)."""

from __future__ import annotations

import ctypes
import gc
import os
import sys


def prepare() -> None:
    """Call it first: before asyncio, numpy and the dialect are imported, and before there are threads."""
    # The daemon speaks no TLS, and asyncio and hashlib do without OpenSSL where it is not installed: 5 MiB less.
    # None in the place of a module makes its import an ImportError.
    sys.modules.update({"ssl": None, "_hashlib": None})  # type: ignore[dict-item]
    # Garbage collection among classes and modules that stay costs a tenth of the start.
    gc.disable()
    # A thread for every processor, with its own buffers, for matrices of 6 by 6.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def settle() -> None:
    """Call it once when everything is imported: what exists by then is never scanned for garbage again."""
    gc.collect()
    gc.freeze()
    gc.enable()
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)

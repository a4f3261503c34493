"""What makes the daemon's start short and keeps its memory small: settings of the process, once, before anything else.

Measured by `python -m tests.bench_start`; the figures stand in docs/speed.md. None changes what the daemon does.
"""

from __future__ import annotations

import ctypes
import gc
import os
from typing import Final

# glibc's malloc.h.
_M_TRIM_THRESHOLD: Final = -1
_M_MMAP_THRESHOLD: Final = -3
_M_ARENA_MAX: Final = -8
_THRESHOLD_BYTES: Final = 128 * 1024
"""glibc's own beginning; left alone it grows to that of the largest piece ever freed, which stays in the process."""


def prepare() -> None:
    """Call it first: before numpy and the dialect are imported, and before there are threads."""
    # Three hundred classes and two hundred modules are made to stay. Looking among them for garbage, again and again
    # while they are made, costs a tenth of the start.
    gc.disable()
    _allocate_sparingly()
    # A thread for every processor, with its own buffers, for matrices of 6 by 6.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def settle() -> None:
    """Call it once when everything is there; it holds the loop for as long as one collection of everything takes.

    That would come anyway, and again and again: what is there by now stays, and is never looked through again.
    """
    gc.collect()
    gc.freeze()
    gc.enable()
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)


def _allocate_sparingly() -> None:
    """One arena for all threads: they take turns at the interpreter's lock anyway. Not every C library knows these."""
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is None:
        return
    mallopt(_M_ARENA_MAX, 1)
    mallopt(_M_MMAP_THRESHOLD, _THRESHOLD_BYTES)
    mallopt(_M_TRIM_THRESHOLD, _THRESHOLD_BYTES)

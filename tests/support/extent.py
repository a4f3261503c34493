"""Size of a test: a slice in `make test`, the whole in `make long`."""

from __future__ import annotations

import os
from typing import Final, TypeVar

T = TypeVar("T")

LONG: Final = os.environ.get("TESTS") == "long"


def extent(*, whole: T, a_slice: T) -> T:
    """The size of a test that is too long for every day: `make long` sets `TESTS=long`."""
    return whole if LONG else a_slice

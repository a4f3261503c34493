"""Random bytes: no decoder finds a frame in them, nor keeps more of them than its longest frame.

Ten million a decoder in `make long`, a slice of them in `make test`. The seed is fixed: the same bytes every run.
"""

from __future__ import annotations

import random
from collections import deque

import pytest

from companion.protocols.decoding.base import Decoder
from companion.protocols.registry import PROTOCOLS
from tests.support.decoders import make_decoder
from tests.support.extent import extent

RANDOM = extent(whole=10_000_000, a_slice=500_000)
CHUNK = 500
HELD = 1200
"""More than the longest frame of any device, with the times of its pieces and the reasons counted."""
EVERY = [(kind, name) for kind, names in PROTOCOLS.items() for name in names]


def held(decoder: Decoder) -> int:
    """Size of a decoder's memory: bytes, and the items of its containers."""
    return sum(
        len(value) for value in vars(decoder).values() if isinstance(value, bytes | bytearray | deque | dict | list)
    )


@pytest.mark.parametrize("name", sorted({name for _, name in EVERY}))
def test_random_bytes(name: str) -> None:
    decoder = make_decoder(next(kind for kind, each in EVERY if each == name), name)
    noise, longest = random.Random(7), 0
    for _ in range(RANDOM // CHUNK):
        assert decoder.feed(noise.randbytes(CHUNK), 0.0) == []
        longest = max(longest, held(decoder))
    assert longest <= HELD
    assert decoder.accepted == 0

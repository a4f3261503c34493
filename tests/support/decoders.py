"""Decoders by name, and the longest frames that their protocols know."""

from __future__ import annotations

from typing import Final

from companion.protocols.decoding.base import Decoder
from companion.protocols.registry import PROTOCOLS, Kind
from companion.samples import Sample

MIP_BYTES: Final = 4 + 255 + 2
XSENS_BYTES: Final = 6 + 1024 + 1
STIM300_BYTES: Final = 70
VECTORNAV_BYTES: Final = 6 + 198 + 112 + 2
"""Header, all fields of groups 1 and 3 (UM001), CRC."""


def make_decoder(kind: Kind, name: str, seconds_per_byte: float = 0.0) -> Decoder:
    return PROTOCOLS[kind][name].decoder(seconds_per_byte)


def feed(kind: type[Decoder], data: bytes) -> tuple[list[Sample], dict[str, int]]:
    """Samples of a new decoder that is fed at 1.0 s, and the number of its rejections by reason."""
    decoder = kind()
    return decoder.feed(data, 1.0), dict(decoder.rejected)

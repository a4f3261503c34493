"""MAVLink frames of a recording, thousands at once: which messages there are, and the fields of the wanted ones.

Only bytes that are nothing but the common case of `mavlink_frames` are read here: version 2, unsigned, known, checksums
right; the rest is for the link, which knows every case. Fields are the very numbers that `mavlink_frames.read` gives.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Collection
from functools import cache
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from companion.links.mavlink_frames import CHECKSUM_BYTES, HEADER_BYTES, KINDS, MARKER, Kind

_AROUND: Final = HEADER_BYTES + CHECKSUM_BYTES
_POLYNOMIAL: Final = 0x8408


@dataclasses.dataclass(frozen=True, slots=True)
class Frames:
    """The frames of one kind in their order; (n,) of each."""

    ends: NDArray[np.int64]
    """Where each one ends in the bytes."""
    fields: NDArray[Any]
    """One record a message, fields by their names."""


def frames_of(data: bytes, wanted: Collection[Kind]) -> tuple[dict[Kind, Frames], int] | None:
    """The wanted messages in bytes that hold nothing but good frames, the last of which may be cut, and where that is.

    Args:
        data: from the beginning of a frame on.
        wanted: messages without text or arrays.

    Returns:
        None where something among it is for the link.
    """
    starts, at, size = [], 0, len(data)
    found: dict[Kind, Frames] = {}
    while size - at >= _AROUND:
        if data[at] != MARKER or data[at + 2]:
            return None
        end = at + _AROUND + data[at + 1]
        if end > size:
            break
        starts.append(at)
        at = end
    if not starts:
        return found, at
    begins = np.array(starts)
    octets = np.frombuffer(data, np.uint8)
    lengths = octets[begins + 1].astype(np.int64)
    numbers = octets[begins[:, None] + np.arange(7, 10)] @ np.array([1, 1 << 8, 1 << 16])
    for number in set(numbers.tolist()):
        kind = KINDS.get(number)
        if kind is None:
            return None
        own = np.flatnonzero(numbers == number)
        record = _record(kind.unpacker.format, tuple(kind.ordered_fieldnames)) if kind in wanted else np.dtype([])
        payloads = np.zeros((len(own), record.itemsize), dtype=np.uint8)
        for length in set(lengths[own].tolist()):
            chosen = np.flatnonzero(lengths[own] == length)
            frames = octets[begins[own[chosen], None] + np.arange(_AROUND + length)]
            if not _sound(frames, kind.crc_extra):
                return None
            # What a payload lacks at its end is zero; what is behind what we know of it is not for us.
            kept = min(length, record.itemsize)
            payloads[chosen, :kept] = frames[:, HEADER_BYTES : HEADER_BYTES + kept]
        if kind in wanted:
            ends = begins[own] + _AROUND + lengths[own]
            found[kind] = Frames(ends, payloads.view(record).reshape(-1))
    return found, at


def _sound(frames: NDArray[np.uint8], extra: int) -> bool:
    """Whether all frames, of one length, end with their checksum."""
    count = len(frames)
    covered = np.column_stack((frames[:, 1:-CHECKSUM_BYTES], np.full(count, extra, dtype=np.uint8)))
    sent = frames[:, -2].astype(np.uint16) | frames[:, -1].astype(np.uint16) << 8
    return bool((crc16_mcrf4xx(covered) == sent).all())


def crc16_mcrf4xx(table: NDArray[np.uint8]) -> NDArray[np.uint16]:
    """(n,) CRC-16/MCRF4XX of every row (MAVLink developer guide, "Checksum")."""
    count, size = table.shape
    of_byte, of_word = _crc_tables()
    crc = np.full(count, 0xFFFF, dtype=np.uint16)
    odd = size % 2
    if odd:
        crc = crc >> 8 ^ of_byte[(crc ^ table[:, 0]) & 0xFF]
    for column in np.ascontiguousarray(np.ascontiguousarray(table[:, odd:]).view("<u2").T):
        crc = of_word[crc ^ column]
    return crc


@cache
def _crc_tables() -> tuple[NDArray[np.uint16], NDArray[np.uint16]]:
    """What a byte and what two bytes make of a register of zeros."""
    tables = []
    for bits in (8, 16):
        crc: NDArray[Any] = np.arange(1 << bits, dtype=np.uint16)
        for _ in range(bits):
            crc = np.where(crc & 1, crc >> 1 ^ _POLYNOMIAL, crc >> 1).astype(np.uint16)
        tables.append(crc)
    return tables[0], tables[1]


@cache
def _record(form: str, names: tuple[str, ...]) -> np.dtype[Any]:
    """How the payload of a message without text or arrays lies in memory, by the form in which `struct` reads it."""
    return np.dtype([(name, form[0] + code) for name, code in zip(names, form[1:], strict=True)])

"""Keeps signing keys out of recordings: the payload of MAVLink's SETUP_SIGNING is replaced by zeros.

Autopilots forward it to us when it is sent to all components. What is left of it fails its checksum in a replay.
"""

from __future__ import annotations

from typing import Final

_ID: Final = (256).to_bytes(3, "little")
"""SETUP_SIGNING, as it stands in a MAVLink 2 header; MAVLink 1 has no such id."""
_ID_AT: Final = 7
_HEADER: Final = 10
_MARKER: Final = 0xFD


class KeyFilter:
    """For one direction of one link; give it all bytes in their order."""

    def __init__(self) -> None:
        self._before = b""
        self._left = 0
        """Bytes of such a payload that are still to come."""

    def __call__(self, data: bytes) -> bytes:
        """The same bytes, without keys."""
        known = self._before + data
        self._before = known[1 - _HEADER :]
        if not self._left and _ID not in known:
            return data
        return self._blank(known, len(known) - len(data))

    def restart(self) -> None:
        """Some bytes are missing here."""
        self._before, self._left = b"", 0

    def _blank(self, known: bytes, behind: int) -> bytes:
        out = bytearray(known)
        end = behind + self._left
        out[behind:end] = bytes(min(self._left, len(out) - behind))
        place = known.find(_ID)
        while place >= 0:
            start = place - _ID_AT
            if start >= 0 and known[start] == _MARKER:
                payload, end_here = start + _HEADER, start + _HEADER + known[start + 1]
                out[payload:end_here] = bytes(max(0, min(end_here, len(out)) - payload))
                end = max(end, end_here)
            place = known.find(_ID, place + 1)
        self._left = max(0, end - len(known))
        return bytes(out[behind:])

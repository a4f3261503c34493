"""Says to whoever asks for files that there are none: MAVProxy would wait through two time-outs for our parameters.

MAVFTP (FILE_TRANSFER_PROTOCOL, 110), MAVLink developer guide: a request's payload is sequence, session, opcode, size,
opcode answered to, burst, a byte of padding, offset, data; an answer's sequence is the request's and one more.
"""

from __future__ import annotations

import struct
from typing import Final

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.links.mavlink.link import MavlinkLink

_HEADER: Final = struct.Struct("<HBBBBBBI")
_PAYLOAD_BYTES: Final = 251
_NAK: Final = 129
_ANSWERS: Final = 128
"""Opcodes from here on are answers."""
_OPENS: Final = (4, 6, 11)
"""To read, to create, to write."""
_UNKNOWN_COMMAND, _FILE_NOT_FOUND = 7, 10


def refuse_files(link: MavlinkLink) -> None:
    """Answer requests for files that are addressed to us, from now on."""

    def answer(message: mavlink.MAVLink_file_transfer_protocol_message, _t_s: float) -> None:
        sequence, session, opcode, *_ = _HEADER.unpack_from(bytes(message.payload))
        if (message.target_system, message.target_component) != (link.system_id, link.component_id):
            return
        if opcode >= _ANSWERS:
            return
        why = _FILE_NOT_FOUND if opcode in _OPENS else _UNKNOWN_COMMAND
        header = _HEADER.pack((sequence + 1) % 65536, session, _NAK, 1, opcode, 0, 0, 0)
        payload = list((header + bytes([why])).ljust(_PAYLOAD_BYTES, b"\0"))
        sender = message.get_srcSystem(), message.get_srcComponent()
        link.send(mavlink.MAVLink_file_transfer_protocol_message(0, *sender, payload))

    link.subscribe(mavlink.MAVLink_file_transfer_protocol_message, answer)

"""MAVLink FTP (mavlink.io/en/services/ftp.html): the autopilot's files are listed and read, nothing else.

Not LOG_REQUEST_DATA: at each such request ArduPilot ends the log that it writes and begins another one. To ask for
little at a time, as a bounded rate needs, would leave hundreds of logs there and cost the oldest (seen on 4.8-dev: 12
requests, 11 new logs, whatever LOG_DISARMED says).
"""

from __future__ import annotations

import asyncio
import struct
from collections.abc import Sequence
from typing import Final, NamedTuple

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.autopilot.logs.blocks import BLOCK_BYTES
from companion.autopilot.vehicle.vehicle import ArmState, Vehicle
from companion.errors import AutopilotError
from companion.links.mavlink.link import MavlinkLink

_HEADER: Final = struct.Struct("<HBBBBBxI")
"""Sequence number, session, opcode, size, opcode answered, end of a burst, offset."""
_PAYLOAD_BYTES: Final = 251
_LIST_WITH_TIME: Final = 16
"""PX4's; other firmware does not know it."""
_AGAIN_S: Final = 1.0
_LEFT_S: Final = 13.0
"""PX4 closes a session that was left open, such as our own after a crash, when nothing was asked of it for 10 s, not
even to open another; ArduPilot after 3 s."""
_ENTRIES: Final = 10_000
_BUSY: Final = (mavlink.MAV_FTP_ERR_NOSESSIONSAVAILABLE, mavlink.MAV_FTP_ERR_FAIL)
_MISSING: Final = (mavlink.MAV_FTP_ERR_FILENOTFOUND, mavlink.MAV_FTP_ERR_FAILERRNO)


class Answer(NamedTuple):
    """What came for one request."""

    error: int
    """MAV_FTP_ERR_*: 0 is none."""
    session: int
    offset: int
    data: bytes


class Entry(NamedTuple):
    """A file in a folder."""

    name: str
    unix_s: int
    """When it was written last, by the autopilot's clock; 0: not told."""


class FileClient:
    """Reads one file at a time; `close` it. While the aircraft is not known to be disarmed nothing leaves."""

    def __init__(self, link: MavlinkLink, vehicle: Vehicle) -> None:
        self.waits = ""
        """What an answer is waited for, for people."""
        self.patience_s = 5.0
        """How long a request is asked again and again until the autopilot counts as silent."""
        self._link, self._vehicle = link, vehicle
        # PX4 takes the number of its latest answer, be it of before our start, for a request that it has answered.
        self._number = int(asyncio.get_running_loop().time() * 1e3) & 0xFFFF
        self._asked: dict[int, tuple[int, asyncio.Future[Answer]]] = {}
        """By the number that the answer has: opcode, and who waits."""
        self._session = 0
        self._is_open = False
        self._unsubscribe = link.subscribe(mavlink.MAVLink_file_transfer_protocol_message, self._on_message)

    def close(self) -> None:
        """Let go of the file, and hear no answers any more."""
        if self._is_open:
            self._send(self._number + 1, mavlink.MAV_FTP_OPCODE_TERMINATESESSION, 0, b"", 0)
        self._unsubscribe()

    async def open(self, path: str) -> int | None:
        """Open a file in the place of the one before; its size in bytes, None where there is none.

        Raises:
            AutopilotError: no answer, or it is refused.
        """
        if self._is_open:
            self._is_open = False
            await self._exchange(mavlink.MAV_FTP_OPCODE_TERMINATESESSION)
        self._session = 0
        answer = await self._exchange(mavlink.MAV_FTP_OPCODE_OPENFILERO, path.encode())
        if answer.error in _BUSY:
            self.waits = f"a file was left open on the autopilot: waits {_LEFT_S:.0f} s until it is closed"
            await asyncio.sleep(_LEFT_S)
            self.waits = ""
            answer = await self._exchange(mavlink.MAV_FTP_OPCODE_OPENFILERO, path.encode())
        if answer.error in _BUSY:
            raise AutopilotError("another station reads files of the autopilot: try again when it is done")
        if answer.error in _MISSING:
            return None
        if answer.error or len(answer.data) < 4:
            raise AutopilotError(f"the autopilot does not open {path}: MAVLink FTP error {answer.error}")
        self._session, self._is_open = answer.session, True
        return int.from_bytes(answer.data[:4], "little")

    async def read(self, offset: int, length: int) -> bytes:
        """At most `BLOCK_BYTES` of the open file; empty where the autopilot does not give them.

        Raises:
            AutopilotError: no answer.
        """
        return (await self._exchange(mavlink.MAV_FTP_OPCODE_READFILE, offset=offset, size=length)).data

    async def read_all(self, blocks: Sequence[tuple[int, int]], within_s: float) -> list[Answer]:
        """Ask for several blocks, by offset and length, once; what came in time."""
        opcode = mavlink.MAV_FTP_OPCODE_READFILE
        asked = [self._ask(self._next(), opcode, offset, b"", length) for offset, length in blocks]
        done, late = await asyncio.wait(asked, timeout=within_s)
        for each in late:
            each.cancel()
        return [each.result() for each in done]

    async def entries(self, folder: str) -> tuple[list[str], list[Entry]] | None:
        """Folders and files in a folder of PX4's; None where there is none.

        Raises:
            AutopilotError: no answer.
        """
        folders: list[str] = []
        files: list[Entry] = []
        opcode, count = _LIST_WITH_TIME, 0
        while count < _ENTRIES:
            answer = await self._exchange(opcode, folder.encode(), offset=count)
            if answer.error == mavlink.MAV_FTP_ERR_UNKNOWNCOMMAND and opcode == _LIST_WITH_TIME:
                opcode = mavlink.MAV_FTP_OPCODE_LISTDIRECTORY
                continue
            if answer.error or not answer.data:
                return None if answer.error in _MISSING else (folders, files)
            for entry in answer.data.rstrip(b"\0").split(b"\0"):
                kind, (name, *more) = entry[:1], entry[1:].decode("utf-8", "replace").split("\t")
                count += 1
                if kind == b"D":
                    folders.append(name)
                elif kind == b"F":
                    files.append(Entry(name, int(more[1]) if more[1:] and more[1].isdecimal() else 0))
        return folders, files

    async def _exchange(self, opcode: int, data: bytes = b"", *, offset: int = 0, size: int | None = None) -> Answer:
        """One request, under the same number until its answer comes: it is carried out once."""
        number, loop = self._next(), asyncio.get_running_loop()
        deadline_s = loop.time() + self.patience_s
        while loop.time() < deadline_s:
            answer = self._ask(number, opcode, offset, data, len(data) if size is None else size)
            if (await asyncio.wait([answer], timeout=_AGAIN_S))[0]:
                return answer.result()
            answer.cancel()
        raise AutopilotError(f"no answer to MAVLink FTP for {self.patience_s:.0f} s{self._vehicle.why_silent}")

    def _next(self) -> int:
        self._number = (self._number + 1) & 0xFFFF
        return self._number

    def _ask(self, number: int, opcode: int, offset: int, data: bytes, size: int) -> asyncio.Future[Answer]:
        answer: asyncio.Future[Answer] = asyncio.get_running_loop().create_future()
        key = (number + 1) & 0xFFFF
        self._asked[key] = opcode, answer
        # The same request asked again has its place by then.
        answer.add_done_callback(lambda _: self._asked.pop(key) if self._asked.get(key) == (opcode, answer) else None)
        self._send(number, opcode, offset, data, size)
        return answer

    def _send(self, number: int, opcode: int, offset: int, data: bytes, size: int) -> None:
        vehicle = self._vehicle
        if vehicle.arm_state is ArmState.DISARMED and vehicle.system_id is not None:
            payload = _HEADER.pack(number & 0xFFFF, self._session, opcode, size, 0, 0, offset) + data
            target = vehicle.system_id, vehicle.component_id
            filled = [*payload[:_PAYLOAD_BYTES].ljust(_PAYLOAD_BYTES, b"\0")]
            self._link.send(mavlink.MAVLink_file_transfer_protocol_message(0, *target, filled))

    def _on_message(self, message: mavlink.MAVLink_file_transfer_protocol_message, _t_s: float) -> None:
        for_us = (message.target_system, message.target_component) == (self._link.system_id, self._link.component_id)
        if not for_us or not self._vehicle.sent(message):
            return
        payload = bytes(message.payload)
        number, session, kind, size, answered, _, offset = _HEADER.unpack_from(payload)
        opcode, answer = self._asked.get(number, (None, None))
        if answer is None or answer.done() or answered != opcode or size > BLOCK_BYTES:
            return
        data = payload[_HEADER.size : _HEADER.size + size]
        if kind == mavlink.MAV_FTP_OPCODE_ACK:
            answer.set_result(Answer(0, session, offset, data))
        elif kind == mavlink.MAV_FTP_OPCODE_NAK:
            answer.set_result(Answer(data[0] if data and data[0] else mavlink.MAV_FTP_ERR_FAIL, session, offset, b""))

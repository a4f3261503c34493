"""MAVLink FTP as the firmwares serve it: files are listed and read, sessions opened, closed and left alone.

ArduPilot `GCS_FTP.cpp`, PX4 `mavlink_ftp.cpp` (1.18-dev): ArduPilot has five sessions, by who asks, and no open while
it has a file open that was used within 3 s; PX4 has one for everybody, whose size is that of its opening. What is asked
again under the same number gets the latest answer again.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from dataclasses import dataclass

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.firmware.channel import Channel, Message
from sim.firmware.double import AutopilotDouble

Request = mavlink.MAVLink_file_transfer_protocol_message
HEADER = struct.Struct("<HBBBBBBI")
DATA_BYTES = 239
PACKET_BYTES = 263
TERMINATE, RESET, LIST, OPEN, READ, LIST_WITH_TIME, ACK, NAK = 1, 2, 3, 4, 5, 16, 128, 129
FAIL, NO_SESSION, NO_SESSIONS_LEFT, END_OF_FILE, UNKNOWN, NOT_FOUND = 1, 4, 5, 6, 7, 10
ANSWER_S = 0.002


class RefusedError(Exception):
    """Answered by an error."""


@dataclass
class Session:
    """An open file."""

    path: str
    size: int
    used_s: float


class FileServer:
    """Answers on every port of a double by itself.

    `files` are contents by path, and times of writing (unix s) in `times`; both may change while it runs.
    """

    def __init__(self, double: AutopilotDouble, *, px4: bool) -> None:
        self._double, self._px4 = double, px4
        self.files: dict[str, bytes] = {}
        self.times: dict[str, int] = {}
        self.knows_times = True
        """Whether it is a PX4 that lists times too."""
        self.asked = 0
        """Requests that came, also those without an answer."""
        self.asked_while_armed = 0
        self.disturb: Callable[[bytes], list[bytes]] = lambda payload: [payload]
        """What becomes of an answer's 251 bytes on their way out."""
        self._sessions: dict[tuple[int, ...], Session] = {}
        self._latest: tuple[tuple[int, ...], bytes] = (), b""
        """Who was answered last, under which number, and how."""

    def restart(self) -> None:
        """A boot."""
        self._sessions.clear()

    def take(self, channel: Channel, message: Message) -> None:
        """A request, if it is one."""
        if not isinstance(message, Request) or message.target_component not in (0, 1):
            return
        self.asked += 1
        self.asked_while_armed += self._double.armed
        number, session, opcode, size, _, _, _, offset = HEADER.unpack_from(bytes(message.payload))
        data = bytes(message.payload)[HEADER.size : HEADER.size + size]
        sender = (message.get_srcSystem(), message.get_srcComponent())
        key = (0,) if self._px4 else (*sender, id(channel), session)
        who, reply = self._latest
        if who != (*sender, number):
            try:
                kind, answer = ACK, self._carry_out(key, opcode, offset, size, data)
            except RefusedError as refusal:
                kind, answer = NAK, bytes(refusal.args)
            reply = HEADER.pack((number + 1) & 0xFFFF, session, kind, len(answer), opcode, 0, 0, offset) + answer
            if not self._px4 or len(answer) <= 4:
                self._latest = (*sender, number), reply
        for payload in self.disturb(reply.ljust(251, b"\0")):
            self._send(channel, mavlink.MAVLink_file_transfer_protocol_message(0, *sender, [*payload]))

    def _send(self, channel: Channel, message: Request) -> None:
        def send() -> None:
            if channel.has_room(PACKET_BYTES):
                self._double.answer(channel, message)
            else:
                self._double.later(ANSWER_S, send)

        self._double.soon(ANSWER_S, send, lane="files")

    def _carry_out(self, key: tuple[int, ...], opcode: int, offset: int, size: int, data: bytes) -> bytes:
        now_s = self._double.now_s()
        idle_s = 10.0 if self._px4 else 20.0
        self._sessions = {each: found for each, found in self._sessions.items() if now_s - found.used_s < idle_s}
        session = self._sessions.get(key)
        used_s = now_s
        if session is not None:
            used_s, session.used_s = session.used_s, now_s
        path = data.rstrip(b"\0").decode()
        if opcode == TERMINATE:
            if session is None and self._px4:
                raise RefusedError(NO_SESSION)
            self._sessions.pop(key, None)
            return b""
        if opcode == OPEN:
            if session is not None and (self._px4 or now_s - used_s < 3.0):
                raise RefusedError(NO_SESSIONS_LEFT if self._px4 else FAIL)
            content = self.files.get(path)
            if content is None:
                raise RefusedError(NOT_FOUND)
            self._sessions[key] = Session(path, len(content), now_s)
            return len(content).to_bytes(4, "little")
        if opcode == READ:
            if session is None:
                raise RefusedError(NO_SESSION if self._px4 else NOT_FOUND)
            content = self.files.get(session.path, b"")
            end = session.size if self._px4 else math.inf
            found = content[offset : offset + min(size, DATA_BYTES)]
            if not found or offset >= end:
                raise RefusedError(END_OF_FILE)
            return found
        if opcode == LIST or (opcode == LIST_WITH_TIME and self._px4 and self.knows_times):
            return self._list(path.rstrip("/") + "/", offset, times=opcode == LIST_WITH_TIME)
        raise RefusedError(UNKNOWN if self._px4 else FAIL)

    def _list(self, folder: str, offset: int, *, times: bool) -> bytes:
        entries = {}
        for path, content in self.files.items():
            if path.startswith(folder):
                name, _, deeper = path.removeprefix(folder).partition("/")
                when = f"\t{self.times.get(path, 0)}" if times else ""
                entries[name] = f"D{name}" if deeper else f"F{name}\t{len(content)}{when}"
        if not entries:
            raise RefusedError(NOT_FOUND)
        told = b""
        # PX4 lists "." and ".." too, as what is to be skipped.
        for entry in [*(["S", "S"] if self._px4 else []), *entries.values()][offset:]:
            if len(told) + len(entry) + 1 > DATA_BYTES:
                break
            told += entry.encode() + b"\0"
        if not told:
            raise RefusedError(END_OF_FILE)
        return told

    def keep_open(self) -> None:
        """What is open was used just now."""
        for session in self._sessions.values():
            session.used_s = self._double.now_s()

    def open_as_another_station(self, path: str) -> None:
        """On PX4: another station closes what is open, and opens this."""
        self._sessions[0,] = Session(path, len(self.files[path]), self._double.now_s())

"""Two more sockets on a UDP port: to one the kernel gives the autopilot's streams of telemetry, to one all else.

Half of what an asyncio program spends on 200 small datagrams a second is waking up for each. Telemetry may wait for the
next turn that has something to do anyway, a question may not; so the kernel tells them apart, before anybody wakes up:
several sockets are bound to the port (SO_REUSEPORT), and a classic BPF program chooses one of them for each datagram
(SO_ATTACH_REUSEPORT_CBPF, Linux 4.5; socket(7)). Each datagram has the kernel's time of its arrival (SO_TIMESTAMPNS),
so that it loses nothing by waiting, and so that both sockets together are read in the order in which all came: who sees
an autopilot's clock go back thinks that it has restarted.

The program says "telemetry" of a datagram that holds one to `MOST_FRAMES` whole unsigned frames of MAVLink 2, all of
them streams by their message id: the same as `mavlink_frames.may_wait`.
"""

from __future__ import annotations

import array
import errno
import heapq
import logging
import os
import socket
import struct
import time
from collections.abc import Iterable, Iterator
from operator import itemgetter
from typing import Any, Final, Protocol

from companion.links.mavlink_frames import CHECKSUM_BYTES, HEADER_BYTES, MARKER, STREAMS, goes_ahead

logger = logging.getLogger(__name__)

MOST_FRAMES: Final = 4
MOST_BYTES: Final = 65536
"""UDP carries no more."""
TELEMETRY_BYTES: Final = 2048
"""`MOST_FRAMES` of 280 bytes at most have room in it; less is got from the kernel, and given back, for each."""
MOST_AT_ONCE: Final = 2048
"""Datagrams that are taken in one turn: several times what a socket has room for."""
OLDEST_S: Final = 0.1
"""What seems to have waited longer, or not yet to have come, was stamped by a clock that has been set meanwhile."""

# <asm-generic/socket.h>, of all architectures that Python's wheels are made for; the module `socket` has no names.
_SO_TIMESTAMPNS: Final = 35
_SO_ATTACH_REUSEPORT_CBPF: Final = 51
_TIMESTAMP: Final = {16: struct.Struct("qq"), 8: struct.Struct("ii")}
"""struct timespec by its length."""
_EXTRA_BYTES: Final = 64

# <linux/bpf_common.h>
_LOAD_BYTE: Final = 0x50  # BPF_LD | BPF_B | BPF_IND: A = payload[X + k]
_LOAD_HALF: Final = 0x48  # BPF_LD | BPF_H | BPF_IND, most significant byte first
_LOAD_LENGTH: Final = 0x80  # BPF_LD | BPF_W | BPF_LEN: A = bytes of the datagram
_LOAD_X: Final = 0x01  # BPF_LDX | BPF_IMM: X = k
_EQUAL: Final = 0x15  # BPF_JMP | BPF_JEQ | BPF_K
_EQUAL_X: Final = 0x1D  # BPF_JMP | BPF_JEQ | BPF_X
_ADD: Final = 0x04  # BPF_ALU | BPF_ADD | BPF_K
_ADD_X: Final = 0x0C  # BPF_ALU | BPF_ADD | BPF_X
_TO_X: Final = 0x07  # BPF_MISC | BPF_TAX: X = A
_RETURN: Final = 0x06  # BPF_RET | BPF_K
CUT_SHORT, QUESTIONS, TELEMETRY = 0, 1, 2
"""Which socket of the port, in the order in which they were bound. Reading beyond a datagram's end returns 0."""

Address = tuple[Any, ...]
_Datagram = tuple[float, bytes, Address]
"""With the time at which it came, by the wall clock."""
Instruction = tuple[int, int, int, int]
"""Code, jump if true, jump if false, k (struct sock_filter)."""


class Endpoint(Protocol):
    """A socket, or asyncio's stand-in for one."""

    @property
    def family(self) -> int:
        """Of its addresses."""

    def fileno(self) -> int:
        """Its descriptor."""

    def getsockname(self) -> Any:
        """Its own address."""

    def setsockopt(self, level: int, option: int, value: int | bytes, /) -> None:
        """Set an option."""


def program(streams: Iterable[int] = STREAMS, frames: int = MOST_FRAMES) -> list[Instruction]:
    """Classic BPF that says which socket gets a datagram; the first gets only what is cut short in a header."""
    # The two low bytes of the id, as they stand in the frame; the third must be 0.
    ids = sorted(struct.unpack(">H", struct.pack("<H", number))[0] for number in streams if number < 1 << 16)
    made: list[Instruction] = [(_LOAD_X, 0, 0, 0)]
    for _ in range(frames):
        known = [(_EQUAL, len(ids) - place, 0, number) for place, number in enumerate(ids)]
        refuse = len(known)
        made += [
            (_LOAD_BYTE, 0, 0, 0),
            (_EQUAL, 0, refuse + 5, MARKER),
            (_LOAD_BYTE, 0, 0, 2),  # incompatibility flags
            (_EQUAL, 0, refuse + 3, 0),
            (_LOAD_BYTE, 0, 0, 9),
            (_EQUAL, 0, refuse + 1, 0),
            (_LOAD_HALF, 0, 0, 7),
            *known,
            (_RETURN, 0, 0, QUESTIONS),
            (_LOAD_BYTE, 0, 0, 1),
            (_ADD, 0, 0, HEADER_BYTES + CHECKSUM_BYTES),
            (_ADD_X, 0, 0, 0),
            (_TO_X, 0, 0, 0),
            (_LOAD_LENGTH, 0, 0, 0),
            (_EQUAL_X, 0, 1, 0),
            (_RETURN, 0, 0, TELEMETRY),
        ]
    return [*made, (_RETURN, 0, 0, QUESTIONS)]


def beside(endpoint: Endpoint) -> Pair | None:
    """Open the two sockets beside a bound one; None where the kernel cannot.

    The first has been bound without SO_REUSEPORT, so nobody else has the port: two daemons do not share one unawares.
    """
    code = array.array("B", b"".join(struct.pack("HBBI", *each) for each in program()))
    address, _ = code.buffer_info()
    option = struct.pack("HP", len(code) // 8, address)
    made: list[socket.socket] = []
    try:
        endpoint.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEPORT, 1)
        for _ in (QUESTIONS, TELEMETRY):
            made.append(socket.socket(endpoint.family, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC))
            made[-1].settimeout(0.0)
            made[-1].setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
            made[-1].setsockopt(socket.SOL_SOCKET, socket.SO_REUSEPORT, 1)
            made[-1].bind(endpoint.getsockname())
        made[-1].setsockopt(socket.SOL_SOCKET, _SO_ATTACH_REUSEPORT_CBPF, option)
    except (OSError, AttributeError) as error:
        logger.debug("mavlink: telemetry and questions share one socket: %s", error)
        for each in made:
            each.close()
        return None
    return Pair(*made)


def left_in(endpoint: Endpoint) -> list[tuple[bytes, Address]]:
    """What had come to a socket before there were others: a busy loop must not get to it behind what they bring."""
    found: list[tuple[bytes, Address]] = []
    with socket.socket(fileno=os.dup(endpoint.fileno())) as same:
        try:
            while len(found) < MOST_AT_ONCE:
                found.append(same.recvfrom(MOST_BYTES))
        except BlockingIOError:
            pass
        except OSError as error:
            logger.debug("mavlink: %s", errno.errorcode.get(error.errno or 0, error))
    return found


class Pair:
    """The two sockets, read in the order in which all their datagrams came."""

    def __init__(self, questions: socket.socket, telemetry: socket.socket) -> None:
        self.questions, self.telemetry = questions, telemetry
        self._asked: list[_Datagram] = []
        """Questions that have been read and wait for what came before them."""

    def ahead(self, now_s: float) -> list[tuple[bytes, Address, float]]:
        """The questions that have come, where each of them may be answered ahead of telemetry; else nothing.

        Those that may not come by `drain`.
        """
        unix_s = time.time()
        self._asked += _waiting(self.questions, MOST_BYTES, unix_s)
        if not all(goes_ahead(data) for _, data, _ in self._asked):
            return []
        asked, self._asked = self._asked, []
        return [_dated(each, unix_s, now_s) for each in asked]

    def drain(self, now_s: float) -> Iterator[tuple[bytes, Address, float]]:
        """What has come: datagrams, who sent each, and when it came by the clock of `now_s`."""
        unix_s = time.time()
        # Telemetry last: what came before a question that is found is found as well.
        questions = self._asked + _waiting(self.questions, MOST_BYTES, unix_s)
        self._asked = []
        telemetry = _waiting(self.telemetry, TELEMETRY_BYTES, unix_s)
        for each in heapq.merge(questions, telemetry, key=itemgetter(0)):
            yield _dated(each, unix_s, now_s)

    def close(self) -> None:
        """Close both."""
        self.questions.close()
        self.telemetry.close()


def _dated(datagram: _Datagram, unix_s: float, now_s: float) -> tuple[bytes, Address, float]:
    came_s, data, peer = datagram
    age_s = unix_s - came_s
    return data, peer, now_s - age_s if 0.0 <= age_s <= OLDEST_S else now_s


def _waiting(endpoint: socket.socket, room: int, unix_s: float) -> list[_Datagram]:
    """Datagrams with the kernel's time of their arrival; `unix_s` where it has none."""
    found: list[_Datagram] = []
    try:
        while len(found) < MOST_AT_ONCE:
            data, extra, _, peer = endpoint.recvmsg(room, _EXTRA_BYTES)
            found.append((_stamp_s(extra, unix_s), data, peer))
    except BlockingIOError:
        pass
    except OSError as error:
        logger.debug("mavlink: %s", errno.errorcode.get(error.errno or 0, error))
    return found


def _stamp_s(extra: list[tuple[int, int, bytes]], otherwise_s: float) -> float:
    for level, kind, data in extra:
        if level == socket.SOL_SOCKET and kind == _SO_TIMESTAMPNS and len(data) in _TIMESTAMP:
            seconds, nanoseconds = _TIMESTAMP[len(data)].unpack(data)
            stamp_s: float = seconds + nanoseconds * 1e-9
            return stamp_s
    return otherwise_s

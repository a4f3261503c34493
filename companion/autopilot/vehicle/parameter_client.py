"""Single parameters over MAVLink: read by name, write, and listeners to every value that the autopilot sends.

Every write is guarded: immediately before each PARAM_SET is sent, also a repeated one, the aircraft must be surely
disarmed (`vehicle.disarmed`). No other guard exists, as neither autopilot refuses a PARAM_SET while armed
(docs/reference/autopilots 1.3, 4.4). MAVLink has no transaction: between a PARAM_SET and its answer the aircraft may
arm, so `parameter_writer` checks again at the end.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
import struct
from collections import deque
from collections.abc import Iterable, Iterator
from typing import Final

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.autopilot.parameters.change import FirmwareName, Parameters, float32, reads_otherwise, same_float32
from companion.autopilot.vehicle.vehicle import Vehicle, VehicleEvent
from companion.errors import (
    AutopilotRebootedError,
    NotDisarmedError,
    ParameterMismatchError,
    ParameterRefusedError,
    ParameterTimeoutError,
)
from companion.links.mavlink.link import MavlinkLink
from companion.links.system.events import Listeners, comes
from companion.messages import message

_NO_ERROR: Final = 0
_DOES_NOT_EXIST: Final = 1
_REMEMBERED_TYPES: Final = 4096  # more than the parameters of any firmware; the type of others is read before a write

_TIMEOUT_S: Final = 1.0
_TRIES: Final = 4
_TRIES_MORE: Final = 8
"""Most tries of one request while heartbeats arrive, or on a line known to lose packets. With a fifth of packets lost
each way, four tries fail once in sixty requests, which is once a calibration; eight fail once in 3500."""
_LOSSY: Final = 0.05  # fraction of repeated requests above which silence is weak evidence of a missing name
_LOSS_MEMORY: Final = 0.1

_AT_ONCE: Final = 6  # requests in flight: ArduPilot queues some twenty and answers one every few milliseconds


_ERROR_WORDS: Final = {
    1: "it does not exist",
    2: "the value is out of range",
    3: "no permission",
    4: "no such component",
    5: "it is read-only",
    6: "its type is not supported",
    7: "its type does not match",
    8: "it could not be read",
}
"""Texts for MAV_PARAM_ERROR; the generated dialect has only the first five values."""

_Answer = float | str  # Value of a PARAM_VALUE, or PARAM_ERROR as text


class _Inbox:
    """Queue of answers about one parameter during one request; PARAM_ERROR is text. A full queue drops the oldest."""

    def __init__(self, name: str) -> None:
        self.name = name
        self._items: deque[_Answer | AutopilotRebootedError] = deque(maxlen=64)
        self._arrived = asyncio.Event()

    def put(self, item: _Answer | AutopilotRebootedError) -> None:
        self._items.append(item)
        self._arrived.set()

    async def get(self, deadline_s: float) -> _Answer | None:
        """Return the next answer, or None at the deadline; raise AutopilotRebootedError after a restart."""
        if not self._items:
            self._arrived.clear()
            await comes(self._arrived, deadline_s - asyncio.get_running_loop().time())
        answer = self._items.popleft() if self._items else None
        if isinstance(answer, AutopilotRebootedError):
            raise answer
        return answer


class ParameterClient(Parameters):
    def __init__(self, link: MavlinkLink, vehicle: Vehicle) -> None:
        self.vehicle = vehicle
        self.writes = 0  # PARAM_SET messages sent, repetitions included
        self._link = link
        self._repeated = 0.0  # fraction of recent requests that were answered only after a repetition
        self._inboxes: list[_Inbox] = []
        self.on_value: Listeners[[str, float]] = Listeners()  # notified of all values sent, whoever asked
        self._answering: str | None = None
        self._absent: set[str] = set()  # names missing in this boot; silence takes seconds to show that
        self._types: dict[str, int] = {}  # types by name, seen since the restart, so these parameters exist
        vehicle.hear(mavlink.MAVLink_param_value_message, self._on_value)
        vehicle.hear(mavlink.MAVLink_param_error_message, self._on_error)
        vehicle.on_event.add(self._on_event)

    @property
    def firmware(self) -> FirmwareName | None:
        return self.vehicle.firmware

    @property
    def boots(self) -> int:
        return self.vehicle.boots

    async def ensure_same_boot(self, boots: int, doing: str) -> None:
        await self.vehicle.hear_boot_time()
        self.require_same_boot(boots, doing)

    def require_same_boot(self, boots: int, doing: str) -> None:
        """Raise AutopilotRebootedError if the autopilot has restarted since the count was `boots`."""
        if self.boots != boots:
            raise self._rebooted(doing)

    def _rebooted(self, doing: str) -> AutopilotRebootedError:
        words = message("autopilot_restarted_meanwhile", autopilot=self.vehicle.name, doing=doing)
        return AutopilotRebootedError(words)

    def _refused(self, request: str, reason: str) -> ParameterRefusedError:
        words = message("parameter_refused", autopilot=self.vehicle.name, request=request, reason=reason)
        return ParameterRefusedError(words)

    def _unanswered(self, request: str, tries: int) -> ParameterTimeoutError:
        if not self.vehicle.alive and (age_s := self.vehicle.heartbeat_age_s) is not None:
            return ParameterTimeoutError(message("no_heartbeat_for", seconds=f"{age_s:.0f}", remedy="power? cable?"))
        name, hint = self.vehicle.name, self.vehicle.why_silent
        words = message("parameter_not_answered", autopilot=name, request=request, tries=tries, hint=hint)
        return ParameterTimeoutError(words)

    async def read(self, name: str) -> float:
        """Read a parameter that must exist.

        Raises:
            ParameterTimeoutError: no answer within all retries.
            ParameterRefusedError: PARAM_ERROR, for instance because it does not exist.
            AutopilotRebootedError: the autopilot restarted meanwhile.
        """
        answer, tries = await self._ask_repeatedly(name, self._required_tries())
        if isinstance(answer, float):
            return answer
        if answer is not None:
            raise self._refused(f"read {name}", answer)
        raise self._unanswered(name, tries)

    async def read_optional(self, name: str) -> float | None:
        """Read a parameter like `read`; return None if the autopilot has no such parameter.

        ArduPilot from 4.7 and PX4 from 1.17 answer an absent name with PARAM_ERROR. Older firmware is silent, and often
        ArduPilot 4.8 too, as its PARAM_ERROR may go to another link. Silence means absence only while heartbeats arrive
        and the autopilot answers for another parameter right after. An absent name is remembered until the autopilot
        restarts or announces it.
        """
        if name in self._absent:
            return None
        boots = self.vehicle.boots
        most = _TRIES_MORE if self._repeated > _LOSSY or name in self._types else _TRIES
        answer, tries = await self._ask_repeatedly(name, range(1, most + 1))
        if isinstance(answer, float):
            return answer
        if answer is not None:
            if answer == _ERROR_WORDS[_DOES_NOT_EXIST]:
                self._absent.add(name)
                return None
            raise self._refused(f"read {name}", answer)
        if not self.vehicle.alive or not await self._answers_at_all():
            raise self._unanswered(f"{name} and other parameters", tries)
        # Try once more: the autopilot may only now have begun to answer again, so its silence was no absence.
        answer, _ = await self._ask_repeatedly(name, [1])
        if isinstance(answer, float):
            return answer
        if name in self._types:
            raise self._unanswered(f"{name} any more", tries + 1)
        if self.vehicle.boots == boots:
            self._absent.add(name)
        return None

    async def read_many(self, names: Iterable[str], *, optional: bool = False) -> dict[str, float]:
        wanted = list(names)
        read = self.read_optional if optional else self.read
        found: dict[str, float] = {}
        for start in range(0, len(wanted), _AT_ONCE):
            some = wanted[start : start + _AT_ONCE]
            answers = await asyncio.gather(*map(read, some), return_exceptions=True)
            for name, answer in zip(some, answers, strict=True):
                if isinstance(answer, BaseException):
                    raise answer
                if answer is not None:
                    found[name] = answer
        return found

    async def write(self, name: str, value: float) -> float:
        """Set a parameter and wait for the autopilot to confirm that value, within 1 ulp.

        The value is sent as the type that the autopilot has announced; a REAL32 is rounded to float32. A different
        value may answer another sender's write, so the wait goes on; if nothing follows, this value is the answer.

        Raises:
            NotDisarmedError: armed or arm state unknown just before a PARAM_SET. If that PARAM_SET was a
                repetition, the first one may have taken effect.
            ParameterTimeoutError: no answer within all retries; the write may have taken effect.
            ParameterMismatchError: the answer has another value.
            ParameterRefusedError: PARAM_ERROR, or the value is not a finite number.
            AutopilotRebootedError: the autopilot restarted meanwhile; the write may have taken effect.
        """
        kind = await self._type_of(name)
        whole = kind in _INTEGER_FORMATS
        wanted = value if whole else float32(value)
        carried = _encode(wanted, kind, bytewise=self.integers_bytewise)
        if not math.isfinite(wanted) or carried is None:
            reason = "not a whole number" if whole else "not a number"
            raise ParameterRefusedError(message("not_written", what=f"{name} = {value}", reason=reason))
        other: float | None = None
        tries = 0
        await self._ensure_disarmed(name)
        with self._exchange(name) as inbox:
            for tries in self._required_tries():
                if other is not None and tries > _TRIES:
                    break
                request = mavlink.MAVLink_param_set_message(*self._target(), _wire_name(name), carried, kind)
                # No await is allowed between the guard and this line.
                self.writes += self._link.send(request, self.vehicle.disarmed.proven)
                deadline_s = asyncio.get_running_loop().time() + _TIMEOUT_S
                while (answer := await inbox.get(deadline_s)) is not None:
                    if isinstance(answer, str):
                        raise self._refused(f"set {name} = {wanted:.9g}", answer)
                    if answer == wanted if whole else same_float32(answer, wanted):
                        self._learn_loss(tries)
                        return answer
                    other = answer
                await self._ensure_disarmed(name)
        if other is not None:
            raise ParameterMismatchError(reads_otherwise(name, other, wanted))
        raise self._unanswered(f"{name} = {wanted:.9g}", tries)

    @property
    def answering(self) -> bool:
        return self._answering is not None

    @property
    def integers_bytewise(self) -> bool:
        """Check that integers are sent as bytes. For unknown firmware AUTOPILOT_VERSION, perhaps forged, decides."""
        if (known := self.vehicle.kind.integers_bytewise) is not None:
            return known
        return bool((self.vehicle.capabilities or 0) & mavlink.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE)

    async def _ensure_disarmed(self, name: str) -> None:
        try:
            await self.vehicle.disarmed.ensure()
        except NotDisarmedError as error:
            raise NotDisarmedError(message("not_written", what=name, reason=error)) from error

    @contextlib.contextmanager
    def _exchange(self, name: str) -> Iterator[_Inbox]:
        inbox = _Inbox(name)
        self._inboxes.append(inbox)
        try:
            yield inbox
        finally:
            self._inboxes.remove(inbox)

    def _required_tries(self) -> Iterator[int]:
        """Number the tries of a request that must be answered: 1 to 4, and up to 8 while heartbeats arrive."""
        for tries in range(1, _TRIES_MORE + 1):
            if tries > _TRIES and not self.vehicle.alive:
                return
            yield tries

    def _learn_loss(self, tries: int) -> None:
        self._repeated += _LOSS_MEMORY * (float(tries > 1) - self._repeated)

    async def _ask(self, inbox: _Inbox, name: str, index: int) -> _Answer | None:
        message = mavlink.MAVLink_param_request_read_message(*self._target(), _wire_name(name), index)
        self._link.send(message)
        answer = await inbox.get(asyncio.get_running_loop().time() + _TIMEOUT_S)
        if isinstance(answer, float):
            self._answering = inbox.name if index < 0 else self._answering
        return answer

    async def _ask_repeatedly(self, name: str, tries: Iterable[int]) -> tuple[_Answer | None, int]:
        count = 0
        with self._exchange(name) as inbox:
            for count in tries:
                if (answer := await self._ask(inbox, name, -1)) is not None:
                    self._learn_loss(count)
                    return answer, count
        return None, count

    async def _answers_at_all(self) -> bool:
        """Request a parameter that surely exists: the one last answered, otherwise the first in the parameter list."""
        name, index = (self._answering, -1) if self._answering is not None else ("", 0)
        with self._exchange(name) as inbox:
            for _ in self._required_tries():
                if await self._ask(inbox, name, index) is not None:
                    return True
        return False

    async def _type_of(self, name: str) -> int:
        """Return a parameter's MAVLink type; it matters only to firmware that sends integers as bytes."""
        if not self.integers_bytewise:
            return _REAL32
        if name not in self._types:
            await self.read(name)
        return self._types.get(name, _REAL32)

    def _target(self) -> tuple[int, int]:
        if self.vehicle.system_id is None:
            raise ParameterTimeoutError(message("no_heartbeat_of_the_autopilot"))
        return self.vehicle.system_id, self.vehicle.component_id

    def _on_value(self, message: mavlink.MAVLink_param_value_message, _t_s: float) -> None:
        name, value = message.param_id, _decode(message, bytewise=self.integers_bytewise)
        self._absent.discard(name)
        if len(self._types) < _REMEMBERED_TYPES or name in self._types:
            self._types[name] = message.param_type
        for inbox in self._inboxes:
            if inbox.name == name or (inbox.name == "" and message.param_index == 0):
                inbox.put(value)
        self.on_value.tell(name, value)

    def _on_error(self, message: mavlink.MAVLink_param_error_message, _t_s: float) -> None:
        if message.error == _NO_ERROR or not self._link.is_for_us(message):
            return
        for inbox in self._inboxes:
            if inbox.name == message.param_id:
                inbox.put(_ERROR_WORDS.get(message.error, f"error {message.error}"))

    def _on_event(self, event: VehicleEvent) -> None:
        if event == "rebooted":
            self._answering = None
            self._absent.clear()
            self._types.clear()
            for inbox in self._inboxes:
                inbox.put(self._rebooted(f"{inbox.name} was read or written"))


def _wire_name(name: str) -> bytes:
    data = name.encode("ascii")
    if len(data) > 16:  # the codec would truncate it, maybe to another parameter's name
        raise ValueError(f"{name!r} is longer than the 16 characters of a MAVLink parameter name")
    return data


# ArduPilot sends every value as a number and ignores the type of a PARAM_SET. PX4 puts the bytes of an integer into the
# float field, and refuses a PARAM_SET of another type than the parameter's (docs/reference/autopilots 7.5).

_INTEGER_FORMATS: Final[dict[int, str]] = {
    mavlink.MAV_PARAM_TYPE_UINT8: "<B",
    mavlink.MAV_PARAM_TYPE_INT8: "<b",
    mavlink.MAV_PARAM_TYPE_UINT16: "<H",
    mavlink.MAV_PARAM_TYPE_INT16: "<h",
    mavlink.MAV_PARAM_TYPE_UINT32: "<I",
    mavlink.MAV_PARAM_TYPE_INT32: "<i",
}
_HEADER_BYTES: Final = {0xFE: 6, 0xFD: 10}  # header lengths of MAVLink 1 and 2, by the first byte of a packet

_REAL32: Final[int] = mavlink.MAV_PARAM_TYPE_REAL32


def _decode(message: mavlink.MAVLink_param_value_message, *, bytewise: bool) -> float:
    """Decode the value of a PARAM_VALUE; a Python float holds 32 bit integers exactly."""
    if not bytewise or message.param_type not in _INTEGER_FORMATS:
        return float(message.param_value)
    # Use the received bytes: an integer whose bytes are a NaN would lose bits as a float. The value is the first field
    # of the payload (param_value float, count, index, id, type).
    packet = bytes(message.get_msgbuf() or b"")
    start = _HEADER_BYTES.get(packet[0], len(packet)) if packet else 0
    carried = packet[start : start + 4] or struct.pack("<f", message.param_value)
    return float(struct.unpack_from(_INTEGER_FORMATS[message.param_type], carried.ljust(4, b"\0"))[0])


def _encode(value: float, kind: int, *, bytewise: bool) -> float | None:
    """Encode a value as the float of a PARAM_SET; None: impossible (a fraction, out of range, not a number)."""
    if not bytewise or kind not in _INTEGER_FORMATS:
        return value
    form = _INTEGER_FORMATS[kind]
    try:
        if value != int(value):
            return None
        carried = struct.pack(form, int(value)).ljust(4, b"\0")
    except (struct.error, OverflowError, ValueError):
        return None
    number: float = struct.unpack("<f", carried)[0]
    # A bit pattern of a signalling NaN changes in a float.
    return number if struct.pack("<f", number) == carried else None

"""Writes of several parameters as one: all are written, or all restored, or the error names the exceptions.

MAVLink has no transactions, so this is an approximation (docs/reference/autopilots 8): read each old value, write one
parameter after another, read all back, and check the arm state again. After any failure restore in reverse order. Each
single write requires proof that the aircraft is disarmed.
"""

from __future__ import annotations

import asyncio
import dataclasses
import logging
from collections.abc import Sequence
from typing import Final

from msgspec import structs
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.autopilot.parameters.change import (
    POLL_S,
    Change,
    FailureKind,
    FarProbe,
    NothingWrittenError,
    PendingChange,
    PendingVector,
    WriteFailedError,
    by_vector,
    reads_otherwise,
    same_float32,
    shown,
    with_restore,
)
from companion.autopilot.vehicle.parameter_client import ParameterClient
from companion.autopilot.vehicle.vehicle import ArmState, Vehicle, VehicleTimer
from companion.errors import (
    AutopilotError,
    AutopilotRebootedError,
    CompanionError,
    NotDisarmedError,
    ParameterMismatchError,
    ParameterRefusedError,
    StorageError,
)
from companion.estimation.records.record import WrittenParameter
from companion.messages import message

logger = logging.getLogger(__name__)

TAKEN_S: Final = 1.3  # time until PX4 uses the last value; until then it uses the intermediate one

_LATE_ECHO_S: Final = 0.3
"""Wait for late answers to earlier writes before reading back: ArduPilot also sends old Y and Z after a write of X."""

_RECOVERY_S: Final = 30.0  # longest wait for a restarted or silent autopilot before a restore is given up

_PUT_BACK_S: Final = 60.0  # longest duration of a restore if heartbeats arrive but answers fail

_TELL_REBOOT_S: Final = 2.0  # longest wait for the time since boot after heartbeats have come back

_ROUNDS: Final = 2  # attempts of a restore, as a late answer may be mistaken for a confirmation in the first


class _Failure(Exception):  # noqa: N818 - never leaves this module
    def __init__(self, kind: FailureKind, reason: str) -> None:
        super().__init__(reason)
        self.kind: FailureKind = kind


class ParameterWriter:
    """Writes sets of parameters to one autopilot, one set at a time."""

    def __init__(self, parameters: ParameterClient, vehicle: Vehicle) -> None:
        self.written: dict[str, WrittenParameter] = {}  # outcome of the last operation, whatever its end
        self.left_changed: tuple[str, ...] = ()
        self.left_far: tuple[str, ...] = ()  # parameters of `left_changed` that still have their intermediate value
        self._parameters = parameters
        self._vehicle = vehicle
        self._lock = asyncio.Lock()
        self._boots = 0
        self._give_up_s = 0.0  # end of the wait for a known arm state
        self._deadline_s = 0.0  # deadline of a restore

    async def apply(self, changes: Sequence[Change], probe: FarProbe | None = None) -> dict[str, WrittenParameter]:
        """Write all changes or none; a parameter that already has its new value is not written again.

        Vectors with an intermediate value (`Change.via`) are written last, one at a time, each verified by `probe`.
        Return each parameter as "stored": read back, effect not verified. A cancel first restores the old values.

        Raises:
            NothingWrittenError: not disarmed at the start, or the autopilot is calibrating itself.
            WriteFailedError: the old values are restored, except those in `left_changed`.
        """
        async with self._lock:
            items = self._begin(changes)
            try:
                await self._check_before(items)
                plain, vectors = by_vector(items)
                for item in plain:
                    await self._write_new(item)
                await self._write_by_far(vectors, probe)
                await self._read_back(items)
                await self._check_end()
            except (_Failure, AutopilotError) as failure:
                await self._fail(items, failure)
            except asyncio.CancelledError:
                # Restore in another task: before Python 3.11.4, asyncio.timeout raises CancelledError in a cancelled
                # task when it expires, and the rest would not be restored. Debian 12 has 3.11.2.
                await asyncio.create_task(self._put_back(items, leave_foreign=False))
                logger.warning("%s", with_restore("write cancelled", self.left_changed, restored=True))
                raise
            for item in items:
                item.outcome = "stored"
            return self._publish(items)

    async def restore(self, changes: Sequence[Change]) -> dict[str, WrittenParameter]:
        """Restore `before` of every change, last first, as far as possible; return them as "rolled_back".

        A value that is neither `before` nor from us was written by somebody else and stays.

        Raises:
            NothingWrittenError: not disarmed at the start, or the autopilot is calibrating itself.
            WriteFailedError: `left_changed` names the parameters that could not be restored.
        """
        async with self._lock:
            items = self._begin(changes)
            for item in items:
                item.sent = True
            await self._put_back(items, leave_foreign=True)
            if self.left_changed:
                foreign = {item.change.parameter: item.read_back for item in items if item.left}
                reason = ", ".join(f"{name} is {shown(value)}" for name, value in foreign.items())
                raise WriteFailedError(self._kind_now(items), reason, self.written, self.left_changed)
            return self.written

    async def undo(self, changes: Sequence[Change]) -> dict[str, WrittenParameter]:
        """Restore `before` of every change, or of none; refuse if somebody has changed a parameter since.

        Raises the errors of `apply`; in them "rolled_back" means that the value from before the undo is restored.
        """
        swapped = [dataclasses.replace(c, before=c.after, after=c.before) for c in reversed(changes)]
        done = await self.apply(swapped)
        self.written = {
            c.parameter: structs.replace(done[c.parameter], before=c.before, after=c.after, outcome="rolled_back")
            for c in changes
        }
        return self.written

    # --- writing

    def _begin(self, changes: Sequence[Change]) -> list[PendingChange]:
        names = [change.parameter for change in changes]
        if len(set(names)) != len(names):
            raise ValueError("a parameter is named twice")
        items = [PendingChange(change) for change in changes]
        self._publish(items)
        if (why := self._vehicle.arm_state.why_not_written) is not None:
            raise NothingWrittenError(message("not_written", what="parameters", reason=why))
        if self._vehicle.system_status == mavlink.MAV_STATE_CALIBRATING:
            why = f"{self._vehicle.name} is calibrating its own sensors"
            raise NothingWrittenError(message("not_written", what="parameters", reason=why))
        self._boots = self._vehicle.boots
        return items

    async def _check_before(self, items: list[PendingChange]) -> None:
        for item in items:
            name, before = item.change.parameter, item.change.before
            now = await self._read(name)
            if not same_float32(now, before):
                raise _Failure("changed by someone else", reads_otherwise(name, now, before))

    async def _write_by_far(self, vectors: Sequence[PendingVector], probe: FarProbe | None) -> None:
        """Write each vector: first an intermediate value on one axis, later the other axes, and that axis last.

        The new values follow once the autopilot uses the intermediate value. If anything ends the write, that axis
        differs from its old value as long as any other axis does.
        """
        wrong: list[str] = []
        for far, others in vectors:
            await VehicleTimer(self._vehicle).let_pass(2.0 * POLL_S)
            words = await self._write_far(far, probe)
            if words is None:
                for item in others:
                    await self._write_new(item)
                await self._write(far, far.change.after)
            else:
                # Continue with the other vectors: each shows the IMU on which its slot acts.
                wrong.append(words)
                await self._write(far, far.change.before)
            far.is_far = False
        if vectors:
            # Wait until PX4 uses the values: the pilot may arm as soon as the write is reported as done.
            await VehicleTimer(self._vehicle).let_pass(POLL_S)
        if wrong:
            raise _Failure("wrong slot, orientation or scale", "; ".join(wrong))

    async def _write_far(self, item: PendingChange, probe: FarProbe | None) -> str | None:
        """Write the intermediate value and wait until the autopilot uses it; return the reason if a check fails."""
        verify = None if probe is None else probe(item.change.parameter)
        await self._write(item, item.change.far)
        item.is_far = True
        if verify is not None:
            return await verify()
        await VehicleTimer(self._vehicle).let_pass(POLL_S)
        return None

    async def _write_new(self, item: PendingChange) -> None:
        if item.change.before != item.change.after or item.sent:
            await self._write(item, item.change.after)

    async def _write(self, item: PendingChange, value: float) -> None:
        name = item.change.parameter
        sent_before = self._parameters.writes
        try:
            await self._parameters.write(name, value)
            item.confirmed = True
        finally:
            item.sent |= self._parameters.writes > sent_before
        self._parameters.require_same_boot(self._boots, f"{name} was written")

    async def _read_back(self, items: list[PendingChange]) -> None:
        await asyncio.sleep(_LATE_ECHO_S)
        for item in items:
            name, wanted = item.change.parameter, item.change.after
            item.read_back = await self._read(name)
            if not same_float32(item.read_back, wanted):
                await asyncio.sleep(_LATE_ECHO_S)
                item.read_back = await self._read(name)
            if not same_float32(item.read_back, wanted):
                kind: FailureKind = "changed by someone else" if item.confirmed else "answered another value"
                raise _Failure(kind, reads_otherwise(name, item.read_back, wanted))

    async def _check_end(self) -> None:
        await self._vehicle.hear_boot_time()
        self._parameters.require_same_boot(self._boots, "its parameters were read back")
        try:
            await self._vehicle.disarmed.ensure()
        except NotDisarmedError as error:
            raise _Failure(kind_of(error, self._vehicle, self._boots), str(error)) from error

    async def _read(self, name: str) -> float:
        value = await self._parameters.read(name)
        self._parameters.require_same_boot(self._boots, f"{name} was read")
        return value

    # --- restoring

    async def _fail(self, items: list[PendingChange], failure: _Failure | AutopilotError) -> None:
        """Find the cause of a failure, restore the old values, and raise WriteFailedError."""
        reason = str(failure)
        kind = failure.kind if isinstance(failure, _Failure) else kind_of(failure, self._vehicle, self._boots)
        if not self._vehicle.alive and any(item.sent for item in items):
            # The autopilot is silent: if it comes back, find out first whether it restarted.
            self._give_up_s = asyncio.get_running_loop().time() + _RECOVERY_S
            if await self._wait_disarmed():
                await self._vehicle.hear_boot_time(_TELL_REBOOT_S)
        elif kind in ("answered another value", "changed by someone else", "no answer") and any(
            item.sent for item in items
        ):
            # Check for a restart: a different value may be that of a start-up calibration, which must stay.
            await self._vehicle.hear_boot_time()
        if self._vehicle.boots != self._boots and kind != "rebooted in the middle":
            kind, name, doing = "rebooted in the middle", self._vehicle.name, f"its parameters were written ({reason})"
            reason = message("autopilot_restarted_meanwhile", autopilot=name, doing=doing)
        await self._put_back(items, leave_foreign=kind == "rebooted in the middle")
        raise WriteFailedError(kind, reason, self.written, self.left_changed) from failure

    async def _put_back(self, items: list[PendingChange], *, leave_foreign: bool) -> None:
        """Restore old values, last first, until the deadline; a vector with an intermediate value gets it first."""
        touched = [item for item in reversed(items) if item.sent]
        for item in touched:
            item.outcome, item.left, item.read_back = "failed", True, None  # until read back
        now_s = asyncio.get_running_loop().time()
        self._give_up_s, self._deadline_s = now_s + _RECOVERY_S, now_s + _PUT_BACK_S
        try:
            for _ in range(_ROUNDS):
                remaining = [item for item in touched if item.left]
                if not remaining:
                    break
                foreign = leave_foreign or self._vehicle.boots != self._boots
                plain, vectors = by_vector(remaining)
                for item in plain:
                    await self._put_back_one(item, item.change.before, leave_foreign=foreign)
                for far, others in vectors:
                    if not far.is_far:
                        await self._put_back_one(far, far.change.far, leave_foreign=foreign)
                    if self._vehicle.alive and not self._late():
                        await VehicleTimer(self._vehicle).let_pass(2.0 * POLL_S)
                    for item in (*others, far):
                        await self._put_back_one(item, item.change.before, leave_foreign=foreign)
                await asyncio.sleep(TAKEN_S if vectors and self._vehicle.alive else _LATE_ECHO_S)
                for item in touched:
                    item.read_back = await self._read_in_force(item.change.parameter)
                    item.left = not _same(item.read_back, item.change.before)
                    item.is_far &= item.left
                    item.outcome = "failed" if item.left else "rolled_back"
        finally:
            self._publish(items)

    async def _put_back_one(self, item: PendingChange, value: float, *, leave_foreign: bool) -> None:
        change = item.change
        if not await self._wait_disarmed() or self._late():
            return
        if leave_foreign or item.confirmed:
            # A value that is neither ours nor the old one came from a start-up calibration or another ground station.
            # But if ours was never confirmed, it may also be the autopilot's version of ours.
            now = await self._read_in_force(change.parameter)
            known = (change.before, *change.ours)
            if not any(_same(now, value) for value in known) and (leave_foreign or now is not None):
                return
        try:
            await self._parameters.write(change.parameter, value)
        except AutopilotError as error:
            logger.warning("%s", message("restore_not_confirmed", parameter=change.parameter, reason=error))

    async def _read_in_force(self, name: str) -> float | None:
        if not self._vehicle.alive or self._late():
            return None
        for _ in range(2):
            try:
                return await self._parameters.read(name)
            except AutopilotRebootedError:
                continue
            except AutopilotError as error:
                logger.warning("%s", message("restore_not_confirmed", parameter=name, reason=error))
                return None
        return None

    async def _wait_disarmed(self) -> bool:
        """Wait until the arm state is known, at most until `_give_up_s`; return whether it is disarmed."""
        loop = asyncio.get_running_loop()
        # Poll, as the state may become known without an event.
        while self._vehicle.arm_state is ArmState.UNKNOWN and loop.time() < self._give_up_s:
            await asyncio.sleep(0.1)
        return self._vehicle.arm_state is ArmState.DISARMED

    def _late(self) -> bool:
        return asyncio.get_running_loop().time() > self._deadline_s

    def _kind_now(self, items: list[PendingChange]) -> FailureKind:
        if self._vehicle.arm_state is ArmState.ARMED:
            return "armed in the middle"
        if self._vehicle.arm_state is ArmState.UNKNOWN:
            return "arm state unknown"
        if any(item.left and item.read_back is None for item in items):
            return "no answer"
        foreign = any(item.left and not any(_same(item.read_back, own) for own in item.change.ours) for item in items)
        return "changed by someone else" if foreign else "answered another value"

    def _publish(self, items: list[PendingChange]) -> dict[str, WrittenParameter]:
        self.written = {
            (c := item.change).parameter: WrittenParameter(
                before=c.before, after=c.after, read_back=item.read_back, outcome=item.outcome
            )
            for item in items
        }
        self.left_changed = tuple(item.change.parameter for item in items if item.left)
        self.left_far = tuple(item.change.parameter for item in items if item.left and item.is_far)
        return self.written


def kind_of(error: CompanionError, vehicle: Vehicle, boots: int) -> FailureKind:
    """Return the kind of failure that ended a write; `boots`: count of restarts when the write began."""
    if vehicle.boots != boots or isinstance(error, AutopilotRebootedError):
        return "rebooted in the middle"
    if isinstance(error, WriteFailedError):
        return error.kind
    if isinstance(error, NotDisarmedError):
        return "armed in the middle" if vehicle.arm_state is ArmState.ARMED else "arm state unknown"
    if isinstance(error, ParameterMismatchError):
        return "answered another value"
    if isinstance(error, StorageError):
        return "not kept"
    return "refused" if isinstance(error, ParameterRefusedError) else "no answer"


def _same(one: float | None, other: float) -> bool:
    return one is not None and same_float32(one, other)

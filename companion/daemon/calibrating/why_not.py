"""Why nothing can be started at this moment: one ladder for all who ask, each of whom minds some of its rungs."""

from __future__ import annotations

import enum
from collections.abc import Collection, Iterator
from typing import Final, Literal, NamedTuple

from companion.autopilot.vehicle.vehicle import ArmState, Vehicle
from companion.component.service import Refusal
from companion.daemon.job import Job
from companion.daemon.offsets.recovery import Recovery


class Rung(enum.Enum):
    """What may stand in the way, in the order in which it is told."""

    FAULT = "fault"
    """Nothing can be kept, so that nothing is written."""
    CONFLICT = "conflict"
    """Two autopilots."""
    BUSY = "busy"
    ARMED = "armed"
    UNKNOWN = "unknown"
    """Whether it is armed."""
    PENDING = "pending"
    """An interrupted write is being put back."""


_KINDS: Final[dict[Rung, Literal["armed", "unknown", "busy", "other"]]] = {
    Rung.FAULT: "other",
    Rung.CONFLICT: "unknown",
    Rung.BUSY: "busy",
    Rung.ARMED: "armed",
    Rung.UNKNOWN: "unknown",
    Rung.PENDING: "busy",
}


class Obstacle(NamedTuple):
    """What stands in the way, for people."""

    rung: Rung
    words: str

    @property
    def refusal(self) -> Refusal:
        """The answer to a request."""
        return Refusal(_KINDS[self.rung], self.words)


def obstacle(
    vehicle: Vehicle, recovery: Recovery, job: Job | None, rungs: Collection[Rung] = tuple(Rung)
) -> Obstacle | None:
    """The first of these that stands in the way; None where nothing does."""
    return next((found for found in _obstacles(vehicle, recovery, job) if found.rung in rungs), None)


def _obstacles(vehicle: Vehicle, recovery: Recovery, job: Job | None) -> Iterator[Obstacle]:
    if recovery.fault is not None:
        yield Obstacle(Rung.FAULT, recovery.fault)
    if vehicle.conflict is not None:
        yield Obstacle(Rung.CONFLICT, vehicle.conflict)
    if job is not None and job.is_running:
        yield Obstacle(Rung.BUSY, f"a {job.kind} is running ({job.words or 'waiting'})")
    if vehicle.arm_state is ArmState.ARMED:
        yield Obstacle(Rung.ARMED, "armed: disarm first")
    if vehicle.arm_state is ArmState.UNKNOWN:
        age_s = vehicle.heartbeat_age_s
        words = "no autopilot heard yet" if age_s is None else f"no heartbeat for {age_s:.0f} s: armed?"
        yield Obstacle(Rung.UNKNOWN, words)
    if recovery.pending:
        yield Obstacle(Rung.PENDING, "putting old values back first")

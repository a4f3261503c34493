"""Obstacles to starting a calibration, in the order in which they are reported."""

from __future__ import annotations

import enum
from collections.abc import Collection, Iterator
from typing import Final, Literal, NamedTuple

from companion.autopilot.vehicle.vehicle import ArmState, Vehicle
from companion.component.service import Refusal
from companion.daemon.job import Job
from companion.daemon.offsets.ledger import Ledger


class Rung(enum.Enum):
    """Kinds of obstacles."""

    FAULT = "fault"
    """Old values cannot be kept, so nothing is written."""
    CONFLICT = "conflict"
    """Two autopilots."""
    BUSY = "busy"
    ARMED = "armed"
    UNKNOWN = "unknown"
    """Arm state unknown."""
    SECOND = "second"
    """Another companion writes to this autopilot."""
    PENDING = "pending"
    """The restore of an interrupted write is pending."""


_KINDS: Final[dict[Rung, Literal["armed", "unknown", "busy", "other"]]] = {
    Rung.CONFLICT: "unknown",
    Rung.BUSY: "busy",
    Rung.ARMED: "armed",
    Rung.UNKNOWN: "unknown",
    Rung.PENDING: "busy",
}


class Obstacle(NamedTuple):
    """One obstacle, in words for people."""

    rung: Rung
    words: str

    @property
    def refusal(self) -> Refusal:
        """Answer to a request."""
        return Refusal(_KINDS.get(self.rung, "other"), self.words)


def obstacle(vehicle: Vehicle, ledger: Ledger, job: Job | None, rungs: Collection[Rung]) -> Obstacle | None:
    """Return the first obstacle of these kinds."""
    return next((found for found in _obstacles(vehicle, ledger, job) if found.rung in rungs), None)


def _obstacles(vehicle: Vehicle, ledger: Ledger, job: Job | None) -> Iterator[Obstacle]:
    if ledger.fault is not None:
        yield Obstacle(Rung.FAULT, ledger.fault)
    if vehicle.conflict is not None:
        yield Obstacle(Rung.CONFLICT, vehicle.conflict)
    if job is not None and job.is_running:
        yield Obstacle(Rung.BUSY, f"a {job.kind} is running ({job.words or 'waiting'})")
    if vehicle.arm_state is ArmState.ARMED:
        yield Obstacle(Rung.ARMED, "armed: disarm first")
    if vehicle.arm_state is ArmState.UNKNOWN:
        age_s = vehicle.heartbeat_age_s
        words = "no autopilot heard yet" if age_s is None else f"no heartbeat for {age_s:.0f} s: power? cable?"
        yield Obstacle(Rung.UNKNOWN, words)
    if (why := ledger.why_yield()) is not None:
        yield Obstacle(Rung.SECOND, why)
    if ledger.pending:
        yield Obstacle(Rung.PENDING, "putting old values back first")

"""Obstacles to starting a calibration, in the order in which they are told; and the limit on repeated requests.

A person who asks is never held up by the limit; a script that starts and cancels is.
"""

from __future__ import annotations

import asyncio
import enum
import math
from collections.abc import Collection, Iterator
from typing import Final, Literal, NamedTuple

from companion.autopilot.vehicle.vehicle import ArmState, Vehicle
from companion.component.service import Refusal
from companion.daemon.job import Job
from companion.daemon.offsets.ledger import Ledger
from companion.links.system.connection import Budget

STARTS_PER_S: Final = 1.0
"""Requests a second that one sender may make for long: nobody presses faster."""
BURST: Final = 10.0
MOST_REQUESTERS: Final = 16
"""Senders with a budget of their own, more than an aircraft has; newcomers beyond share one, as ids can be made up."""


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


class StartLimit:
    """Budget of starts for each requester."""

    def __init__(self) -> None:
        self._budgets: dict[str, Budget] = {}
        self._newcomers = Budget(STARTS_PER_S, BURST)

    def refuses(self, requester: str) -> Refusal | None:
        """Count one start; returns a refusal where the budget is spent."""
        now_s = asyncio.get_running_loop().time()
        budget = self._budget(requester, now_s)
        left = budget.left(now_s)
        if left < 1.0:
            wait_s = math.ceil((1.0 - left) / STARTS_PER_S)
            return Refusal("busy", f"too many requests, wait {wait_s} s")
        budget.spend(1, now_s)
        return None

    def _budget(self, requester: str, now_s: float) -> Budget:
        if requester not in self._budgets:
            # A full budget need not be remembered.
            self._budgets = {name: each for name, each in self._budgets.items() if each.left(now_s) < BURST}
            if len(self._budgets) >= MOST_REQUESTERS:
                return self._newcomers
            self._budgets[requester] = Budget(STARTS_PER_S, BURST)
        return self._budgets[requester]

"""Why nothing can be started at this moment: one ladder for all who ask, each of whom minds some of its rungs.

A person who asks is never held up by how often; a script that starts and cancels is.
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
    """What may stand in the way, in the order in which it is told."""

    FAULT = "fault"
    """Nothing can be kept, so that nothing is written."""
    CONFLICT = "conflict"
    """Two autopilots."""
    BUSY = "busy"
    ARMED = "armed"
    UNKNOWN = "unknown"
    """Whether it is armed."""
    SECOND = "second"
    """Another companion writes to this autopilot."""
    PENDING = "pending"
    """An interrupted write is being put back."""


_KINDS: Final[dict[Rung, Literal["armed", "unknown", "busy", "other"]]] = {
    Rung.FAULT: "other",
    Rung.CONFLICT: "unknown",
    Rung.BUSY: "busy",
    Rung.ARMED: "armed",
    Rung.UNKNOWN: "unknown",
    Rung.SECOND: "other",
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


def obstacle(vehicle: Vehicle, ledger: Ledger, job: Job | None, rungs: Collection[Rung]) -> Obstacle | None:
    """The first of these that stands in the way; None where nothing does."""
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
    """A budget of starts for each requester."""

    def __init__(self) -> None:
        self._budgets: dict[str, Budget] = {}
        self._newcomers = Budget(STARTS_PER_S, BURST)

    def refuses(self, requester: str) -> Refusal | None:
        """Take one start; or, when the requester has none left, why not."""
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
            # Of who has asked for nothing lately there is nothing to be remembered.
            self._budgets = {name: each for name, each in self._budgets.items() if each.left(now_s) < BURST}
            if len(self._budgets) >= MOST_REQUESTERS:
                return self._newcomers
            self._budgets[requester] = Budget(STARTS_PER_S, BURST)
        return self._budgets[requester]

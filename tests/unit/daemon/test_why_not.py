"""The ladder of why nothing can be started now: what is told first, and what each asker minds."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from companion.autopilot.vehicle.vehicle import ArmState
from companion.daemon.calibrating.why_not import Rung, obstacle


def found(rungs: Any = tuple(Rung), **what: Any) -> tuple[Rung, str] | None:
    vehicle: Any = SimpleNamespace(
        conflict=what.get("conflict"),
        arm_state=what.get("arm_state", ArmState.DISARMED),
        heartbeat_age_s=what.get("age_s", 0.2),
    )
    ledger: Any = SimpleNamespace(
        fault=what.get("fault"), pending=what.get("pending", False), why_yield=lambda: what.get("second")
    )
    job: Any = what.get("job")
    return obstacle(vehicle, ledger, job, rungs)


RUNNING = SimpleNamespace(kind="calibration", words="hold still 3 s more", is_running=True)
ENDED = SimpleNamespace(kind="calibration", words="", is_running=False)
EVERYTHING: dict[str, Any] = {
    "fault": "the disk is full",
    "conflict": "two autopilots",
    "job": RUNNING,
    "arm_state": ArmState.UNKNOWN,
    "age_s": 7.0,
    "second": "second companion",
    "pending": True,
}


@pytest.mark.parametrize(
    ("without", "rung", "words", "kind"),
    [
        ((), Rung.FAULT, "the disk is full", "other"),
        (("fault",), Rung.CONFLICT, "two autopilots", "unknown"),
        (("fault", "conflict"), Rung.BUSY, "a calibration is running (hold still 3 s more)", "busy"),
        (("fault", "conflict", "job"), Rung.UNKNOWN, "no heartbeat for 7 s: power? cable?", "unknown"),
        (("fault", "conflict", "job", "arm_state"), Rung.SECOND, "second companion", "other"),
        (("fault", "conflict", "job", "arm_state", "second"), Rung.PENDING, "putting old values back first", "busy"),
    ],
)
def test_what_nobody_can_wait_for_is_told_first(without: tuple[str, ...], rung: Rung, words: str, kind: str) -> None:
    first: Any = found(**{key: value for key, value in EVERYTHING.items() if key not in without})
    assert (first.rung, first.words) == (rung, words)
    assert (first.refusal.kind, first.refusal.reason) == (kind, words)


def test_an_armed_aircraft_stands_in_the_way_and_a_job_that_has_ended_does_not() -> None:
    assert found(job=ENDED) is None
    first: Any = found(job=ENDED, arm_state=ArmState.ARMED, pending=True)
    assert (first.rung, first.refusal.kind) == (Rung.ARMED, "armed")

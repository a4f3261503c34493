"""Preconditions of a calibration: the order in which they are reported, and the kinds of refusal."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from companion.autopilot.vehicle.vehicle import ArmState
from companion.daemon.calibrating.manager import REFUSAL_KINDS, Precondition, blocked


def found(**what: Any) -> tuple[Precondition, str] | None:
    vehicle: Any = SimpleNamespace(
        conflict=what.get("conflict"),
        arm_state=what.get("arm_state", ArmState.DISARMED),
        heartbeat_age_s=what.get("age_s", 0.2),
    )
    journal: Any = SimpleNamespace(
        fault=what.get("fault"), pending=what.get("pending", False), why_yield=lambda: what.get("second")
    )
    job: Any = what.get("job")
    return next(blocked(vehicle, journal, job), None)


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
    ("without", "unmet", "words", "kind"),
    [
        ((), Precondition.STORAGE, "the disk is full", "other"),
        (("fault",), Precondition.ONE_AUTOPILOT, "two autopilots", "unknown"),
        (("fault", "conflict"), Precondition.IDLE, "a calibration is running (hold still 3 s more)", "busy"),
        (("fault", "conflict", "job"), Precondition.ARM_STATE_KNOWN, "no heartbeat for 7 s: power? cable?", "unknown"),
        (("fault", "conflict", "job", "arm_state"), Precondition.ONE_COMPANION, "second companion", "other"),
        (
            ("fault", "conflict", "job", "arm_state", "second"),
            Precondition.RESTORED,
            "restoring old values first",
            "busy",
        ),
    ],
)
def test_the_first_unmet_condition_is_reported(
    without: tuple[str, ...], unmet: Precondition, words: str, kind: str
) -> None:
    first: Any = found(**{key: value for key, value in EVERYTHING.items() if key not in without})
    assert first == (unmet, words)
    assert REFUSAL_KINDS.get(unmet, "other") == kind


def test_an_armed_aircraft_blocks_and_a_finished_job_does_not() -> None:
    assert found(job=ENDED) is None
    assert found(job=ENDED, arm_state=ArmState.ARMED, pending=True) == (Precondition.DISARMED, "armed: disarm first")
    assert REFUSAL_KINDS[Precondition.DISARMED] == "armed"

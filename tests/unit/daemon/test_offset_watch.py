"""Changes of the autopilot's offsets by others: values are compared, whatever the parameters' names."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, Literal, cast

import pytest

from companion.component.service import JobResult
from companion.daemon.devices.autopilot_imu import OffsetWatch
from companion.estimation.records.validity import Why


@pytest.mark.parametrize(
    ("outcome", "reboots", "asked", "changes", "why"),
    [
        ("failed", False, False, True, Why.CHANGED),
        ("failed", True, False, True, Why.FAILED),
        ("failed", True, False, False, Why.REBOOTED),
        ("done", False, False, True, Why.CHANGED),
        ("done", True, False, True, Why.REPLACED),
        ("done", True, True, True, Why.CHANGED),
        ("done", True, False, False, Why.REBOOTED),
        ("done", True, True, False, None),
    ],
)
def test_offsets_are_compared_with_those_that_a_job_has_left(
    outcome: Literal["done", "failed"], reboots: bool, asked: bool, changes: bool, why: Why | None
) -> None:
    written = {"INS_GYROFFS_X": SimpleNamespace(after=0.002)}
    left = written if outcome == "done" else {}
    before, after = 0.001, 0.002 if outcome == "done" else 0.001
    imu, vehicle = made_imu(before), SimpleNamespace(boots=0)
    record = SimpleNamespace(imus=[SimpleNamespace(name="fc", written=left)])
    job: Any = SimpleNamespace(kind="calibration", automatic=False, record=record, reboot=asked)
    lost: list[Why] = []
    watch = OffsetWatch(cast("Any", vehicle), {"fc": imu}, lambda _, why: lost.append(why))
    watch.poll()
    vehicle.boots += reboots
    imu.calibration = made_imu(0.005 if changes else after).calibration
    watch.on_ended(job, JobResult(outcome))
    watch.poll()
    assert lost == ([] if why is None else [why])


def made_imu(offset: float) -> Any:
    def contradicts(written: dict[str, float]) -> bool:
        return any(value != offset for value in written.values())

    return SimpleNamespace(calibration=SimpleNamespace(offsets={"INS_GYROFFS_X": offset}, contradicts=contradicts))

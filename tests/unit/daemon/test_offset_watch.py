"""Who has changed the autopilot's offsets: values are compared, whatever the parameters are called."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

from companion.component.service import JobResult
from companion.daemon.arming.offset_watch import OffsetWatch
from companion.estimation.records.validity import Why


def test_another_slot_of_px4_with_the_same_values_is_nobody_elses_doing() -> None:
    imu: Any = SimpleNamespace(calibration=SimpleNamespace(offsets={"CAL_GYRO0_XOFF": 0.0, "CAL_ACC0_XOFF": 0.0}))
    vehicle: Any = SimpleNamespace(boots=0)
    job: Any = SimpleNamespace(kind="calibration", automatic=False, record=None)
    lost: list[tuple[str, Why]] = []
    watch = OffsetWatch(vehicle, {"fc": imu}, lambda name, why: lost.append((name, why)))
    watch.poll()
    watch.on_ended(job, JobResult("failed", "not as believed"))
    imu.calibration = SimpleNamespace(offsets={"CAL_GYRO1_XOFF": 0.0, "CAL_ACC1_XOFF": 0.0})
    watch.poll()
    assert (watch.foreign, lost) == (None, [])
    imu.calibration = SimpleNamespace(offsets={"CAL_GYRO1_XOFF": 0.01, "CAL_ACC1_XOFF": 0.0})
    watch.poll()
    assert lost == [("fc", Why.CHANGED)]

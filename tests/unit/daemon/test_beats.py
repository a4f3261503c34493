"""Watched tasks: one is overdue when it has been silent too long, and not when the whole loop stood still."""

from __future__ import annotations

from types import SimpleNamespace

from companion.daemon.process.service import WatchedTask


def test_a_silent_task_is_overdue_until_it_goes_on() -> None:
    who = SimpleNamespace(turns=0)
    imu = WatchedTask("imu", "imu", 3.0, who)
    assert [imu.overdue(1.0) for _ in range(4)] == [False, False, False, True]
    assert imu.age_s == 4.0
    who.turns += 1
    assert not imu.overdue(1.0)
    assert imu.age_s == 0.0

"""Beats: a task is missed when it has been silent too long, and not when the whole loop stood still."""

from __future__ import annotations

from companion.daemon.process.supervisor import Beats, Watched


class Task:
    turns = 0


def test_who_is_silent_is_missed_and_who_comes_back_is_not() -> None:
    imu, compass = Task(), Task()
    beats = Beats([Watched("imu", "imu", 3.0, imu), Watched("compass", "compass", 5.0, compass)])
    for _ in range(4):
        compass.turns += 1
        overdue = beats.update(1.0)
    assert overdue == {"imu": 4.0}
    imu.turns += 1
    assert beats.update(1.0) == {}


def test_a_task_that_never_began_is_missed_too() -> None:
    beats = Beats([Watched("imu", "imu", 1.0, Task())])
    assert beats.update(1.0) == {}
    assert beats.update(0.5) == {"imu": 1.5}

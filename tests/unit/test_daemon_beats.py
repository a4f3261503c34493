"""Beats: a task is missed when it has been silent too long, and not when the whole loop stood still."""

from __future__ import annotations

import pytest

from companion.daemon.process.beats import Beats


def test_who_is_silent_is_missed_and_who_comes_back_is_not() -> None:
    beats = Beats()
    imu = beats.expect("imu", 3.0)
    compass = beats.expect("compass", 5.0)
    for _ in range(4):
        compass()
        overdue = beats.look(1.0)
    assert overdue == {"imu": 4.0}
    imu()
    assert beats.look(1.0) == {}


def test_a_task_that_never_began_is_missed_too() -> None:
    beats = Beats()
    beats.expect("imu", 1.0)
    assert beats.look(1.0) == {}
    assert beats.look(0.5) == {"imu": 1.5}


def test_two_tasks_of_one_name_are_a_mistake() -> None:
    beats = Beats()
    beats.expect("imu", 1.0)
    with pytest.raises(ValueError, match="two tasks are called imu"):
        beats.expect("imu", 1.0)

"""The state table: what must be possible from everywhere."""

from __future__ import annotations

import pytest

from companion.estimation.machine import RESTING, TRANSITIONS, Event, IllegalEventError, Machine, State


@pytest.mark.parametrize("state", [state for state in State if state not in RESTING])
def test_every_busy_state_can_fail_and_be_cancelled(state: State) -> None:
    assert TRANSITIONS[state, Event.FAULT] is State.FAILED
    assert TRANSITIONS[state, Event.CANCEL] is State.CANCELLED


def test_every_state_can_be_reached_and_left() -> None:
    assert set(TRANSITIONS.values()) | {State.IDLE} == set(State)
    assert {old for old, _ in TRANSITIONS} == set(State)


def test_nothing_is_written_without_having_been_solved() -> None:
    into_writing = {(old, event) for (old, event), new in TRANSITIONS.items() if new is State.WRITING}
    assert into_writing == {(State.SOLVING, Event.WRITE)}
    assert {old for (old, event), new in TRANSITIONS.items() if new is State.UNDOING} == set(RESTING)


def test_users_see_the_words_that_other_programs_rely_on() -> None:
    assert {state.shown for state in State} == {
        "idle", "waiting", "collecting", "solving", "writing", "verifying", "done", "failed", "cancelled"
    }  # fmt: skip


def test_nothing_counts_as_right_from_the_first_write_until_it_is_concluded() -> None:
    into_rest = {State.WAITING, State.DONE, State.FAILED, State.CANCELLED}
    for old in (State.WRITING, State.VERIFYING, State.RESTARTING, State.SETTLING, State.UNDOING):
        assert old.is_writing
        assert all(new.is_writing or new in into_rest for (state, _), new in TRANSITIONS.items() if state is old)
    assert not any(state.is_writing for state in (*RESTING, State.WAITING, State.COLLECTING, State.SOLVING))


def test_an_event_out_of_place_is_a_programs_fault() -> None:
    with pytest.raises(IllegalEventError, match="VERIFIED cannot happen while idle"):
        Machine().on(Event.VERIFIED)

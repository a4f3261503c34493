"""Limit of a port's rate: the bucket, on made-up times."""

from __future__ import annotations

from companion.links.system.connection import Budget


def test_a_steady_stream_within_the_budget_is_never_stopped() -> None:
    budget = Budget(bytes_per_s=1000.0, burst_bytes=500.0)
    assert all(budget.spend(100, 0.1 * tick) for tick in range(1, 1000))
    assert budget.exceeded_s is None


def test_a_burst_after_a_pause_is_taken_and_what_comes_on_top_is_not() -> None:
    budget = Budget(bytes_per_s=1000.0, burst_bytes=500.0)
    assert budget.spend(500, 10.0)
    assert not budget.spend(1, 10.0)
    assert budget.exceeded_s == 10.0
    assert budget.spend(90, 10.1)


def test_with_a_pause_after_each_refusal_the_budget_and_a_read_a_pause_is_all_that_is_taken() -> None:
    budget = Budget(bytes_per_s=1000.0, burst_bytes=500.0)
    now_s, taken = 0.0, 0
    while now_s < 100.0:
        taken += 50
        now_s += 0.001 if budget.spend(50, now_s) else 0.2
    assert 0.9 * 100_000 <= taken <= 100_000 + 500 + 50 * 100.0 / 0.2


def test_a_clock_that_stands_or_goes_back_gives_nothing() -> None:
    budget = Budget(bytes_per_s=1000.0, burst_bytes=100.0)
    assert budget.spend(100, 5.0)
    assert not budget.spend(1, 4.0)

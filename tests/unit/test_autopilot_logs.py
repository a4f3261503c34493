"""What is asked for next of a file that comes in blocks, and how much of the line it takes."""

from __future__ import annotations

import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.autopilot.logs.blocks import BLOCK_BYTES, LEAST_PAUSE_S, MOST_AT_ONCE, Blocks


@given(
    size=st.integers(1, 20_000),
    front=st.integers(0, 20_000),
    seed=st.integers(0, 1 << 30),
    loss=st.floats(0.0, 0.6),
    short=st.floats(0.0, 0.3),
)
@settings(max_examples=150, deadline=None)
def test_any_order_loss_copies_and_short_answers_give_the_file(
    size: int, front: int, seed: int, loss: float, short: float
) -> None:
    dice = random.Random(seed)
    file, front = dice.randbytes(size), min(front, size)
    blocks, got = Blocks(front, size), file[:front]
    for _ in range(20_000):
        if blocks.front == size:
            break
        wanted = blocks.wanted()
        assert 0 < len(wanted) <= MOST_AT_ONCE
        came = [each for each in wanted if dice.random() >= loss]
        for offset, length in dice.sample(came + came[:1], len(came + came[:1])):
            assert offset + length <= size
            length = dice.randint(1, length) if dice.random() < short else length
            got += blocks.take(offset, file[offset : offset + length])
        blocks.pause_s(dice.choice([0.001, 0.06, 0.5]), all_came=len(came) == len(wanted))
    assert got == file


def test_what_was_not_asked_for_is_not_taken() -> None:
    blocks = Blocks(1000, 2000)
    for offset, data in ((0, b"x" * 1000), (999, b"x"), (1990, b"x" * 11), (5000, b"x"), (1000, b"")):
        assert blocks.take(offset, data) == b""
    assert blocks.wanted() == [(1000, BLOCK_BYTES)]


@pytest.mark.parametrize("baud", [57_600, 115_200, 921_600])
def test_a_line_is_used_to_half_at_most_and_telemetry_waits_a_tenth_of_a_second(baud: int) -> None:
    """A block is a packet of 266 bytes; the autopilot answers within 3 ms."""
    blocks, took_all_s, paused_s, sent = Blocks(0, 1_000_000), 0.0, 0.0, 0
    for _ in range(300):
        wanted = blocks.wanted()
        took_s = 0.003 + len(wanted) * 2660 / baud
        sent += len(wanted)
        for offset, length in wanted:
            blocks.take(offset, bytes(length))
        assert took_s <= 0.15
        took_all_s += took_s
        paused_s += blocks.pause_s(took_s, all_came=True)
    used = sent * 2660 / baud / (took_all_s + paused_s)
    assert 0.25 < used <= 0.5


def test_without_answers_it_asks_for_less_and_waits_longer() -> None:
    blocks = Blocks(0, 100_000)
    for _ in range(10):
        blocks.pause_s(0.01, all_came=True)
    assert len(blocks.wanted()) == MOST_AT_ONCE
    before_s = blocks.within_s
    assert [blocks.pause_s(before_s, all_came=False) for _ in range(5)] == [LEAST_PAUSE_S] * 5
    assert len(blocks.wanted()) == 1
    assert blocks.within_s == 4.0 > before_s

"""The log: what floods it is counted, what does not is written as it comes."""

from __future__ import annotations

import io
import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from companion.cli.logs import LimitedHandler

Log = Callable[[str], None]


class Clock:
    now_s = 5000.0

    def __call__(self) -> float:
        return self.now_s


@contextmanager
def log_on(clock: Clock) -> Iterator[tuple[logging.Logger, io.StringIO]]:
    stream = io.StringIO()
    logger = logging.getLogger(f"tests.logs.{id(stream)}")
    logger.propagate = False
    logger.setLevel(logging.DEBUG)
    handler = LimitedHandler(stream, clock)
    logger.addHandler(handler)
    yield logger, stream
    handler.close()


def test_a_flood_is_counted_and_said_and_every_line_is_accounted_for() -> None:
    clock = Clock()
    with log_on(clock) as (logger, stream):
        for k in range(6000):  # 100 a second for a minute
            logger.info("armed %d", k)
            clock.now_s += 0.01
    lines = stream.getvalue().splitlines()
    assert lines[:10] == [f"armed {k}" for k in range(10)]
    assert len(lines) == 10 + 6 or len(lines) == 10 + 7  # six a minute, and the rest at the end
    assert lines[10].startswith("armed ")
    counts = [int(line.partition("(and ")[2].partition(" more")[0]) for line in lines[10:]]
    assert sum(counts) + len(lines) == 6000
    assert lines[-1].startswith("armed 5999 (and ")


def test_one_flood_hides_nothing_else() -> None:
    clock = Clock()
    with log_on(clock) as (logger, stream):
        for k in range(100):
            logger.log(logging.WARNING if k == 70 else logging.INFO, "vehicle: %s", "lost" if k == 70 else "armed")
            if k == 50:
                logger.error("two autopilots")
    text = stream.getvalue()
    assert "two autopilots\n" in text
    assert "vehicle: lost\n" in text
    assert text.count("armed") == 11


def test_what_comes_now_and_then_is_written_as_it_comes() -> None:
    clock = Clock()
    with log_on(clock) as (logger, stream):
        for k in range(1000):
            logger.info("calibration %d done", k)
            clock.now_s += 10.1
    assert stream.getvalue() == "".join(f"calibration {k} done\n" for k in range(1000))


def test_the_count_of_a_flood_that_is_over_is_said_with_the_next_line_of_whatever_place() -> None:
    clock = Clock()
    with log_on(clock) as (logger, stream):
        for _ in range(313):
            logger.info("disarmed")
            clock.now_s += 0.001
        clock.now_s += 61.0
        logger.info("calibration done")
        assert stream.getvalue().splitlines()[10:] == [
            "disarmed (and 302 more like this in the last 61 s)",
            "calibration done",
        ]

"""The log: what floods it is counted, what does not is written as it comes."""

from __future__ import annotations

import io
import logging
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from companion.links.system.process import LimitedHandler


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


def test_a_flood_is_counted_and_the_next_line_of_its_place_says_so() -> None:
    clock = Clock()
    with log_on(clock) as (logger, stream):
        for k in range(6001):  # 100 a second for a minute, and one when it is over
            clock.now_s += 60.0 if k == 6000 else 0.01
            logger.info("armed %d", k)
    lines = stream.getvalue().splitlines()
    assert lines[:10] == [f"armed {k}" for k in range(10)]
    assert 16 <= len(lines) <= 17  # six a minute after the first ten
    assert lines[-1].startswith("armed 6000 (after ")
    counts = [int(line.partition("(after ")[2].partition(" more")[0]) for line in lines[10:]]
    assert sum(counts) + len(lines) == 6001


WITHOUT_DESCRIPTORS = """
import logging, os, resource
from companion.links.system.process import set_up_logs

set_up_logs("info")
resource.setrlimit(resource.RLIMIT_NOFILE, (20, 20))
try:
    while True:
        os.dup(2)
except OSError:
    logging.getLogger("companion").exception("heard %s", "\\x1b[2J")
"""


@pytest.mark.real_clock
def test_the_log_is_written_when_no_descriptor_is_free() -> None:
    """Run in a process of its own: another test may have loaded what is missing here."""
    ended = subprocess.run(
        [sys.executable, "-c", WITHOUT_DESCRIPTORS], capture_output=True, text=True, timeout=60.0, check=True
    )
    first, *others = ended.stderr.splitlines()
    assert first.endswith(r"ERROR heard \x1b[2J")
    assert others[-1].startswith("OSError: [Errno 24]")
    assert "Logging error" not in ended.stderr

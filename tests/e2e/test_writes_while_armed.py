"""A companion process that gets 3 % of the processor writes nothing once the autopilot has armed."""

from __future__ import annotations

import asyncio

import pytest

from tests.support.armed_writes import run

pytestmark = pytest.mark.real_clock


def test_a_starved_process_writes_nothing_while_armed() -> None:
    """Real processes and a real socket, judged by the kernel's time stamps: a slow machine only writes less."""
    stage = asyncio.run(run(seed=4))
    assert stage.sets, "it must have been in the middle of its writes"
    assert stage.beyond_s == []

"""Whoever asks for a window does not work out estimates on the event loop."""

from __future__ import annotations

import asyncio
from types import SimpleNamespace
from typing import Any

from companion.daemon.core import Core


def test_what_becomes_due_while_an_estimate_is_worked_out_is_worked_out_elsewhere_too() -> None:
    due, elsewhere, accepted = ["ten seconds", "twenty seconds"], [], []

    async def offload(function: Any) -> Any:
        await asyncio.sleep(0)
        elsewhere.append(function())
        return elsewhere[-1]

    def pending(_: float, *, since_s: float | None) -> Any:
        assert since_s == 5.0
        return SimpleNamespace(run=lambda: due.pop(0)) if due else None

    collector = SimpleNamespace(pending=pending, accept=lambda _, found: accepted.append(found))
    core: Any = SimpleNamespace(collector=collector, offload=offload)
    asyncio.run(Core.catch_up(core, since_s=5.0))
    assert elsewhere == accepted == ["ten seconds", "twenty seconds"]

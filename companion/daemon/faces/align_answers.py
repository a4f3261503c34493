"""What the control socket answers to `companion align`."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from typing import Final

import msgspec

from companion.calibration.request import is_time_limit
from companion.component.service import Refusal
from companion.daemon.calibrating.align_steps import HEADINGS, Plan
from companion.daemon.calibrating.alignment import AlignmentInForce
from companion.daemon.calibrating.conductor import Conductor
from companion.daemon.calibrating.why_not import Rung
from companion.daemon.job import ALIGNMENT
from companion.errors import CalibrationRefusedError
from companion.links.system.request import Object

PROGRESS_EVERY_S: Final = 0.2
TIMEOUT_S: Final = 900.0
"""An alignment that nobody ends must not keep calibrations from starting for ever."""


async def answer_align(
    conductor: Conductor, alignment: AlignmentInForce, request: Object, face: str
) -> AsyncIterator[Object]:
    """Show, forget or measure the alignment.

    Raises:
        CompanionError: refused, and why, or the file cannot be written.
    """
    action = request.get("action")
    if action == "show":
        yield {"kind": "result", **_shown(alignment)}
    elif action == "forget":
        if (busy := conductor.why_not((Rung.BUSY,))) is not None:
            raise CalibrationRefusedError(busy.words)
        was = await alignment.forget()
        words = "the configuration's zero and sigma are in force" if was else "there was no alignment to forget"
        yield {"kind": "result", "state": "done", "reason": words}
    else:
        async for reply in _measure(conductor, request, face):
            yield reply


def _shown(alignment: AlignmentInForce) -> Object:
    record = alignment.record
    if alignment.used is not None:
        state, reason = "in force", ""
    elif alignment.unused is not None:
        state, reason = "not used", alignment.unused
    else:
        state, reason = "none", "no alignment is kept: companion align zero measures one"
    return {"state": state, "reason": reason, "alignment": msgspec.to_builtins(record)}


async def _measure(conductor: Conductor, request: Object, face: str) -> AsyncIterator[Object]:
    action, headings = request.get("action"), request.get("headings", 2)
    timeout_s = request.get("timeout_s")
    timeout_s = TIMEOUT_S if timeout_s is None else timeout_s
    if action not in ("zero", "tilts") or headings not in (2, HEADINGS) or not is_time_limit(timeout_s):
        raise CalibrationRefusedError(f"align: {request} is not understood")
    plan = Plan(action, headings, quick=request.get("quick") is True)
    job = conductor.start_alignment(plan, f"{face} align", float(timeout_s))
    if isinstance(job, Refusal):
        raise CalibrationRefusedError(job.reason)
    while job.is_running:
        yield {
            "kind": "progress",
            "state": conductor.state.shown,
            "percent": job.progress_percent,
            "text": job.words,
            "job": ALIGNMENT,
        }
        await asyncio.wait([job.finished], timeout=PROGRESS_EVERY_S)
    result = job.finished.result()
    yield {
        "kind": "result",
        "state": result.outcome,
        "reason": result.reason,
        "alignment": msgspec.to_builtins(job.alignment),
    }

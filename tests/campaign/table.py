"""The outcomes as a table, for the terminal and for docs/faults.md."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from tests.campaign.catalogue import FAULTS
from tests.campaign.cell import Outcome
from tests.campaign.fault import PHASES

BEGIN: Final = "<!-- the table begins: python -m tests.campaign --markdown docs/faults.md -->"
END: Final = "<!-- the table ends -->"
_DESCRIBED: Final = ("autopilot", "intruder")
"""Rooms whose faults have names that do not say what happens."""


def as_text(outcomes: Sequence[Outcome], seed: int) -> str:
    by = {(outcome.fault, outcome.phase): outcome for outcome in outcomes}
    phases = [phase for phase in PHASES if any(outcome.phase == phase for outcome in outcomes)]
    width = max(len(name) for name, _ in by)
    lines = [" " * width + "".join(f"{phase:>12}" for phase in phases)]
    for name in FAULTS:
        row = [by.get((name, phase)) for phase in phases]
        if any(row):
            lines.append(f"{name:{width}}" + "".join(f"{one.verdict if one else '':>12}" for one in row))
    reasons = {f"n.a. {one.fault} in {one.phase}: {one.not_applicable}" for one in outcomes if one.not_applicable}
    return "\n".join([*lines, *sorted(reasons), summary(outcomes, seed)])


def summary(outcomes: Sequence[Outcome], seed: int) -> str:
    verdicts = [outcome.verdict for outcome in outcomes]
    faults = len({outcome.fault for outcome in outcomes})
    return (
        f"{faults} faults, {verdicts.count('ok')} cells ok, {verdicts.count('n.a.')} not applicable,"
        f" {verdicts.count('FAIL')} failed; seed {seed}"
    )


def as_json(outcomes: Sequence[Outcome]) -> list[dict[str, Any]]:
    return [{**dataclasses.asdict(outcome), "verdict": outcome.verdict} for outcome in outcomes]


def as_markdown(outcomes: Sequence[Outcome], seed: int, path: Path) -> None:
    """Write the faults by room into a document, between its marks, with the phases in which one is not ok."""
    by = {(outcome.fault, outcome.phase): outcome for outcome in outcomes}
    rooms: dict[str, list[str]] = {}
    for name, fault in FAULTS.items():
        cells = {phase: by.get((name, phase)) for phase in PHASES}
        verdicts = {phase: one.verdict if one else "not played" for phase, one in cells.items()}
        if any(cells.values()):
            words = [fault.does] if fault.room in _DESCRIBED else []
            words += [f"{phase} {verdict}" for phase, verdict in verdicts.items() if verdict not in ("ok", "n.a.")]
            rooms.setdefault(fault.room, []).append(name + (f" ({'; '.join(words)})" if words else ""))
    lines = [BEGIN, "", summary(outcomes, seed) + ".", ""]
    lines += [f"- **{room}**: {', '.join(faults)}" for room, faults in rooms.items()]
    reasons: dict[str, list[str]] = {}
    for one in outcomes:
        if one.not_applicable:
            reasons.setdefault(one.not_applicable, []).append(f"{one.fault} in *{one.phase}*")
    lines += ["", *(f"Not applicable, {reason}: {', '.join(cells)}." for reason, cells in sorted(reasons.items()))]
    lines += ["", END]
    text = path.read_text(encoding="utf-8")
    head, _, rest = text.partition(BEGIN)
    _, _, tail = rest.partition(END)
    path.write_text(head + "\n".join(lines) + tail, encoding="utf-8")

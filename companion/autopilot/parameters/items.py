"""The parameters of one write, and the order that PX4's vectors need.

PX4 ignores a small change of a vector of offsets, unless the vector makes a far step first (`Change.via`).
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Sequence
from typing import Final, Protocol

from companion.autopilot.parameters.change import Change
from companion.estimation.records.record import Outcome, WrittenParameter

POLL_S: Final = 1.1
"""PX4's readers of parameters let 1 s pass between two looks (autopilots 9.2): after this long each has seen a value.
After twice that without a write each looks at the next value at once."""

_AXIS: Final = re.compile(r"[XYZ](?=OFF$|SCALE$)|\d$")
"""In the name of a parameter of a vector."""


class FarProbe(Protocol):
    """Verifies in the telemetry that a far value (`Change.via`) is in use."""

    def mark(self, parameter: str) -> None:
        """Keep the telemetry until now: the far value of this parameter is written next."""

    async def verify(self, parameter: str) -> str | None:
        """Compare with the telemetry since; the reason to restore the old values, if there is one."""


@dataclasses.dataclass(slots=True)
class Item:
    """One parameter of a set, and what has become of it."""

    change: Change
    sent: bool = False
    confirmed: bool = False
    """The autopilot has answered with a value of ours: another one found later is somebody else's."""
    is_far: bool = False
    """The value last written is the far one."""
    read_back: float | None = None
    outcome: Outcome = "failed"
    left: bool = False

    def seen(self) -> WrittenParameter:
        """What the record says of it."""
        change = self.change
        return WrittenParameter(
            before=change.before, after=change.after, read_back=self.read_back, outcome=self.outcome
        )


ItemVector = tuple[Item, list[Item]]
"""The axis with a far value, and the others of its vector."""


def by_vector(items: Sequence[Item]) -> tuple[list[Item], list[ItemVector]]:
    """Those that need no far value, and the vectors that do, in order."""
    vectors: dict[str, ItemVector] = {
        _AXIS.sub("", item.change.parameter): (item, []) for item in items if item.change.via is not None
    }
    plain: list[Item] = []
    for item in items:
        if item.change.via is None:
            vector = vectors.get(_AXIS.sub("", item.change.parameter))
            (plain if vector is None else vector[1]).append(item)
    return plain, list(vectors.values())

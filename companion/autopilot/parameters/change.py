"""Changes of parameters: planned, in the order that PX4's vectors need, and failed.

PX4 ignores a small change of a vector of offsets, unless the vector makes a far step first (`Change.via`).
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Awaitable, Callable, Sequence
from typing import ClassVar, Final, Literal

from companion.autopilot.parameters.wire import float32
from companion.errors import AutopilotError, NotDisarmedError
from companion.estimation.records.record import Outcome, WrittenParameter

FailureKind = Literal[
    "refused",
    "no answer",
    "answered another value",
    "armed in the middle",
    "rebooted in the middle",
    "arm state unknown",
    "changed by someone else",
    "not as believed",
    "without effect",
    "not kept",
]


POLL_S: Final = 1.1
"""PX4's readers of parameters let 1 s pass between two looks (autopilots 9.2): after this long each has seen a value.
After twice that without a write each looks at the next value at once."""

_AXIS: Final = re.compile(r"[XYZ](?=OFF$|SCALE$)|\d$")
"""Axis in the name of a vector's parameter."""


@dataclasses.dataclass(frozen=True, slots=True)
class Change:
    """Old and new value of one parameter, rounded to float32.

    Where `via` is set the firmware would ignore a small change of the vector: this far value is written first, and when
    the firmware uses it, the new values of the vector; a restore goes the same way.
    """

    parameter: str
    before: float
    after: float
    via: float | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "before", float32(self.before))
        object.__setattr__(self, "after", float32(self.after))
        if self.via is not None:
            object.__setattr__(self, "via", float32(self.via))

    @property
    def far(self) -> float:
        """The far value, or the new one where it needs none."""
        return self.after if self.via is None else self.via

    @property
    def ours(self) -> tuple[float, ...]:
        """Values besides the old one that our writes may have left in the autopilot."""
        return (self.after,) if self.via is None else (self.after, self.via)


class NothingWrittenError(NotDisarmedError):
    """Refused before anything was sent: armed, unknown whether armed, or the autopilot calibrates itself."""

    left_changed: ClassVar[tuple[str, ...]] = ()


class WriteFailedError(AutopilotError):
    """A set of parameters is not in force as a whole.

    `written` has every parameter of the set: "rolled_back" (restored) or "failed" (never written, or not restored; then
    `read_back` is the value in force, if known). `left_changed` names those whose old value may not be in force.
    """

    def __init__(
        self, kind: FailureKind, reason: str, written: dict[str, WrittenParameter], left_changed: tuple[str, ...]
    ) -> None:
        words = f"{kind}: {reason}"
        if left_changed:
            words += f"; old values NOT back in {', '.join(left_changed)}"
        elif any(parameter.outcome == "rolled_back" for parameter in written.values()):
            words += "; old values back"
        super().__init__(words)
        self.kind: FailureKind = kind
        self.reason = reason
        self.written = written
        self.left_changed = left_changed


FarProbe = Callable[[str], Callable[[], Awaitable[str | None]]]
"""Called with a parameter just before its far value (`Change.via`) is written; returns the verification.

The verification compares the telemetry since with that before, and returns the reason to restore the old values, if
there is one.
"""


@dataclasses.dataclass(slots=True)
class PendingChange:
    """One parameter of a write, and its state."""

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
        """Return its row in the record."""
        change = self.change
        return WrittenParameter(
            before=change.before, after=change.after, read_back=self.read_back, outcome=self.outcome
        )


PendingVector = tuple[PendingChange, list[PendingChange]]
"""The axis with a far value, and the others of its vector."""


def by_vector(items: Sequence[PendingChange]) -> tuple[list[PendingChange], list[PendingVector]]:
    """Split into parameters that need no far value, and vectors that do, in order."""
    vectors: dict[str, PendingVector] = {
        _AXIS.sub("", item.change.parameter): (item, []) for item in items if item.change.via is not None
    }
    plain: list[PendingChange] = []
    for item in items:
        if item.change.via is None:
            vector = vectors.get(_AXIS.sub("", item.change.parameter))
            (plain if vector is None else vector[1]).append(item)
    return plain, list(vectors.values())

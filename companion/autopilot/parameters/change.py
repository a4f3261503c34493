"""What is to be changed in the autopilot, and what can become of it."""

from __future__ import annotations

import dataclasses
from typing import ClassVar, Literal

from companion.autopilot.parameters.wire import float32
from companion.errors import AutopilotError, NotDisarmedError
from companion.estimation.records.record import WrittenParameter

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


@dataclasses.dataclass(frozen=True, slots=True)
class Change:
    """One parameter: the value it has, and the value it shall get. All are rounded to float32.

    Where `via` is set the firmware would ignore a small change of the vector: this far value is written first, and when
    the firmware uses it, the new values of the vector; the same on the way back.
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
        """The values that we may have left in the autopilot, besides the old one."""
        return (self.after,) if self.via is None else (self.after, self.via)


class NothingWrittenError(NotDisarmedError):
    """Refused before anything was sent: armed, unknown whether armed, or the autopilot calibrates itself."""

    left_changed: ClassVar[tuple[str, ...]] = ()


class WriteFailedError(AutopilotError):
    """Why a set of parameters is not in force as a whole, and what is in force instead.

    Attributes:
        kind: the cause in a word.
        written: every parameter of the set with its outcome: "rolled_back" (the old value is in force again),
            "failed" (never written, or not put back: then it is in `left_changed` too, and `read_back` says what
            is in force, None when that cannot be known).
        left_changed: the parameters of which the old value is not, or not surely, in force.
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

"""Interface to the autopilot's parameters, their values as 32 bit floats, and planned changes of them.

PX4 ignores a small change of a vector of offsets, unless one axis first makes a large step (`Change.via`).
"""

from __future__ import annotations

import abc
import ctypes
import dataclasses
import math
import re
import struct
from collections.abc import Awaitable, Callable, Iterable, Sequence
from typing import ClassVar, Final, Literal

from companion.errors import AutopilotError, NotDisarmedError
from companion.estimation.records.record import Outcome, WrittenParameter
from companion.messages import message
from companion.samples import Vector

FirmwareName = Literal["ardupilot", "px4", "other"]

Names = tuple[str, str, str]  # parameters of a vector: X, Y, Z

SCALES: Final = (0.5, 2.0)  # allowed accelerometer scales; a calibration divides by them


def float32(value: float) -> float:
    """Round to the nearest 32 bit float; infinite beyond the range of such floats."""
    return ctypes.c_float(value).value


def same_float32(one: float, other: float) -> bool:
    """Compare two numbers as 32 bit floats, to within 1 ulp; NaN equals nothing."""
    if not (math.isfinite(one) and math.isfinite(other)):
        return False
    return abs(_rank(one) - _rank(other)) <= 1


def _rank(value: float) -> int:
    """Return the position of a float among all 32 bit floats in order; both zeros are 0."""
    bits: int = struct.unpack("<i", struct.pack("<f", value))[0]
    return bits if bits >= 0 else -(bits & 0x7FFFFFFF)


def implausible(name: str, value: str, wanted: str) -> AutopilotError:
    return AutopilotError(message("parameter_not_plausible", parameter=name, value=value, wanted=wanted))


class Parameters(abc.ABC):
    """Interface to read parameters from an autopilot or from a log; `ParameterClient` documents the errors.

    `boots` counts the restarts of the autopilot seen so far; `firmware` is None before the first heartbeat.
    """

    @property
    @abc.abstractmethod
    def firmware(self) -> FirmwareName | None: ...

    @property
    @abc.abstractmethod
    def boots(self) -> int: ...

    @abc.abstractmethod
    async def read(self, name: str) -> float: ...

    @abc.abstractmethod
    async def read_optional(self, name: str) -> float | None:
        """Read one parameter; None: the autopilot does not have it."""

    @abc.abstractmethod
    async def read_many(self, names: Iterable[str], *, optional: bool = False) -> dict[str, float]: ...

    @abc.abstractmethod
    async def ensure_same_boot(self, boots: int, doing: str) -> None:
        """Request the time since boot; raise AutopilotRebootedError if there were more than `boots` restarts by now."""

    async def read_vector(self, names: Names, low: float = -math.inf, high: float = math.inf) -> Vector:
        """Read three numbers, each from `low` to `high`; raise AutopilotError if one is outside."""
        x, y, z = [await self.read(name) for name in names]
        for name, value in zip(names, (x, y, z), strict=True):
            if not math.isfinite(value) or not low <= value <= high:
                raise implausible(name, f"{value:.9g}", f"{low:g} to {high:g}" if math.isfinite(high) else "a number")
        return x, y, z

    async def read_integer(self, name: str) -> int | None:
        """Read a whole number; None: the firmware lacks the parameter. Raises AutopilotError if it is not finite."""
        value = await self.read_optional(name)
        if value is not None and not math.isfinite(value):
            raise implausible(name, f"{value}", "a number")
        return None if value is None else round(value)


FailureKind = Literal[
    "refused",
    "no answer",
    "answered another value",
    "armed in the middle",
    "rebooted in the middle",
    "arm state unknown",
    "changed by someone else",
    "wrong slot, orientation or scale",
    "without effect",
    "not kept",
]


POLL_S: Final = 1.1
"""Time, s, within which each module of PX4 reads a new value: modules read at most once a second
(docs/reference/autopilots 9.2). After twice this time without a write, each module reads the next value at once."""

_AXIS: Final = re.compile(r"[XYZ](?=OFF$|SCALE$|ODIAG$)|\d$")


@dataclasses.dataclass(frozen=True, slots=True)
class Change:
    """Old and new value of one parameter, rounded to float32.

    `via`: intermediate value, far enough away for firmware that ignores a small change of a vector. It is written
    first, and the new value once the firmware uses it. A restore goes through the intermediate value too.
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
        return self.after if self.via is None else self.via

    @property
    def ours(self) -> tuple[float, ...]:
        """Values, other than the old one, that our writes may have left in the autopilot."""
        return (self.after,) if self.via is None else (self.after, self.via)


def shown(value: float | None) -> str:
    return "unknown" if value is None else f"{value:.9g}"


def reads_otherwise(name: str, found: float | None, wanted: float) -> str:
    return message("parameter_reads_otherwise", parameter=name, found=shown(found), wanted=shown(wanted))


def with_restore(reason: str, left_changed: Sequence[str], *, restored: bool) -> str:
    """Append the outcome of the restore to the reason why a write ended."""
    if left_changed:
        return message("old_values_not_back", reason=reason, parameters=", ".join(left_changed))
    return message("old_values_back", reason=reason) if restored else reason


class NothingWrittenError(NotDisarmedError):
    """Write refused before anything was sent: armed, arm state unknown, or the autopilot is calibrating itself."""

    left_changed: ClassVar[tuple[str, ...]] = ()


class WriteFailedError(AutopilotError):
    """Write of several parameters that failed; the old values were restored as far as possible.

    `written` has every parameter: "rolled_back" (restored) or "failed" (never written, or not restored; then
    `read_back` is the present value, if known). `left_changed` names parameters that may still be changed.
    """

    def __init__(
        self, kind: FailureKind, reason: str, written: dict[str, WrittenParameter], left_changed: tuple[str, ...]
    ) -> None:
        restored = any(parameter.outcome == "rolled_back" for parameter in written.values())
        super().__init__(with_restore(f"{kind}: {reason}", left_changed, restored=restored))
        self.kind: FailureKind = kind
        self.reason = reason
        self.written = written
        self.left_changed = left_changed


FarProbe = Callable[[str], Callable[[], Awaitable[str | None]]]
"""Callback that gets a parameter's name just before its intermediate value (`Change.via`) is written.

The callback returns a verification, which compares the telemetry before and after that write. The verification returns
the reason to restore the old values, or None.
"""


@dataclasses.dataclass(slots=True)
class PendingChange:
    change: Change
    sent: bool = False  # a PARAM_SET was sent: the autopilot may have the new value
    confirmed: bool = False  # the autopilot confirmed a value of ours: a different one found later is somebody else's
    is_far: bool = False
    read_back: float | None = None
    outcome: Outcome = "failed"
    left: bool = False  # True: the old value may not be restored


PendingVector = tuple[PendingChange, list[PendingChange]]  # the axis with an intermediate value, and the others


def by_vector(items: Sequence[PendingChange]) -> tuple[list[PendingChange], list[PendingVector]]:
    """Split changes into single parameters, and vectors with an intermediate value on one axis; the order stays."""
    vectors: dict[str, PendingVector] = {
        _AXIS.sub("", item.change.parameter): (item, []) for item in items if item.change.via is not None
    }
    plain: list[PendingChange] = []
    for item in items:
        if item.change.via is None:
            vector = vectors.get(_AXIS.sub("", item.change.parameter))
            (plain if vector is None else vector[1]).append(item)
    return plain, list(vectors.values())

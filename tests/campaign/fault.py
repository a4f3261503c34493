"""A fault, and the phases in which it may strike."""

from __future__ import annotations

import dataclasses
from collections.abc import Awaitable, Callable, Mapping
from typing import Any, Literal

from tests.campaign.stage import Stage

Phase = Literal["idle", "waiting", "collecting", "solving", "writing", "verifying", "done", "armed"]
PHASES: tuple[Phase, ...] = ("idle", "waiting", "collecting", "solving", "writing", "verifying", "done", "armed")

Room = Literal["device", "link", "autopilot", "disk", "clock", "process", "files", "faces", "intruder"]


@dataclasses.dataclass
class Scene:
    """A stage on which a fault happens."""

    stage: Stage
    phase: Phase
    spoilt: set[str] = dataclasses.field(default_factory=set)
    """Files below the store that the fault has damaged: to be named, not to be missed."""
    notes: dict[str, Any] = dataclasses.field(default_factory=dict)
    """The fault's own, from its beginning to its end."""

    @property
    def chance(self) -> Any:
        return self.stage.chance


Act = Callable[[Scene], Awaitable[None]]


async def nothing(scene: Scene) -> None:
    """For a fault that is over with its beginning."""


@dataclasses.dataclass(frozen=True)
class Fault:
    """One row of the table.

    Args:
        name: short, for `--only`.
        room: what is at fault.
        does: what happens, for people.
        strike: begins it.
        lift: ends it.
        lasts_s: shortest and longest time in between.
        names: a pattern of the words in which the companion names it somewhere; None: it disturbs nothing, and
            nothing has to be said.
        excused: a pattern of what a calibration that fails meanwhile may give as the reason, beside `names`.
        not_in: phases in which it cannot strike, and why.
        variants: names of the autopilots that it can happen with.
        at_arm: how the daemon is set.
        recordings_mb: of the ring; 0: none.
        restarts: the daemon does not live through it.
        gone_s: so long the companion may be silent on the wire.
        moves: what is measured meanwhile may be wrong, for the aircraft or the truth itself has changed.
    """

    name: str
    does: str
    strike: Act
    lift: Act = nothing
    lasts_s: tuple[float, float] = (3.0, 8.0)
    names: str | None = None
    excused: str | None = None
    not_in: Mapping[Phase, str] = dataclasses.field(default_factory=dict)
    variants: tuple[str, ...] = ("ArduPilot 4.8", "PX4", "ArduPilot 4.6")
    at_arm: str = "off"
    recordings_mb: int = 0
    restarts: bool = False
    moves: bool = False
    named_in: tuple[Phase, ...] = PHASES
    """Phases in which `names` must be found; elsewhere it may be over before anybody notices."""
    room: Room = dataclasses.field(kw_only=True)

"""Arming: what is in force, whether that is good enough, and calibrations by itself that keep it so."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Mapping, Sequence

import msgspec

from companion.daemon.arming.armings import Armings, with_armings
from companion.daemon.arming.automatic import Automatic
from companion.daemon.arming.gate_setup import GateSetup
from companion.daemon.arming.in_force import InForce
from companion.daemon.arming.readiness import Readiness
from companion.daemon.arming.shown_calibration import shown_calibration
from companion.daemon.calibrating.subsystem import Calibrating
from companion.daemon.core import Core, Handler, Subsystem, Task
from companion.daemon.devices.subsystem import Devices
from companion.daemon.offsets.subsystem import Offsets
from companion.links.system.request import Object


class Arming(Subsystem):
    """May it arm, and what happens when it does."""

    def __init__(self, core: Core, devices: Devices, offsets: Offsets, calibrating: Calibrating) -> None:
        self._core, self._store, self._conductor = core, calibrating.store, calibrating.conductor
        # In this order they hear of a calibration's end: who starts the next one asks what is in force.
        self.in_force = InForce(core, devices.imus, calibrating.conductor, calibrating.alignment)
        self.automatic = Automatic(core, devices.imus, calibrating.conductor, self.in_force)
        self.readiness = Readiness(core, calibrating.conclusion, calibrating.conductor, self.in_force, self.automatic)
        self.armings = Armings(core, self.readiness)
        self.gate_setup = GateSetup(core, self.readiness)

    def commands(self) -> Mapping[str, Handler]:  # noqa: D102 - as in the base class
        return {"history": self._answer_history}

    def status(self) -> Object:  # noqa: D102
        now_s = asyncio.get_running_loop().time()
        return {
            "arming": {
                **self.readiness.status(),
                "setup": self.gate_setup.status(),
                "last": msgspec.to_builtins(self.armings.last),
            },
            "automatic": self.automatic.status(),
            "calibration": shown_calibration(self.in_force, self._conductor.last, now_s),
        }

    def tasks(self) -> Sequence[Task]:  # noqa: D102
        looking: list[Task] = [("gate-setup", self.gate_setup.run)]
        if self._core.only_listening is not None:
            return looking
        return [
            ("readiness", self.readiness.run),
            ("armings", self.armings.run),
            ("automatic", self.automatic.run),
            *looking,
        ]

    async def _answer_history(self, request: Object, _face: str) -> AsyncIterator[Object]:
        limit = request.get("limit")
        number = limit if isinstance(limit, int) and limit > 0 else None
        # A thousand records take longer to read than a ground station waits for an answer.
        yield await self._core.offload(self._history, number)

    def _history(self, limit: int | None) -> Object:
        armings = self.armings.history()
        found = self._store.numbered(limit)
        records = with_armings(list(found.values()), armings)
        return {
            "kind": "result",
            "numbers": list(found),
            "records": [msgspec.to_builtins(record) for record in records],
            "armings": [msgspec.to_builtins(arming) for arming in armings[:limit]],
        }

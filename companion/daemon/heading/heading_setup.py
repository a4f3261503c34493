"""What `companion autopilot-setup` leaves behind: a ledger of its own, and somebody who puts back what was interrupted.

The rest of it is loaded when it is asked for.
"""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING

from companion.autopilot.firmware.written import HEADING_SETUP
from companion.autopilot.parameters.client import ParameterClient
from companion.autopilot.parameters.writer import ParameterWriter
from companion.autopilot.vehicle.vehicle import Vehicle
from companion.component.statustext import Say
from companion.config import Config
from companion.daemon.calibrating.conductor import Conductor
from companion.daemon.offload import Offload
from companion.daemon.offsets.ledger import Ledger
from companion.daemon.offsets.recovery import Recovery
from companion.links.system.request import Object
from companion.storage.changes import ChangeLog

if TYPE_CHECKING:
    from companion.daemon.heading.autopilot_setup import AutopilotSetup


class HeadingSetup:
    """The door to `AutopilotSetup`; `run` it, so that an interrupted write is put back."""

    def __init__(
        self,
        config: Config,
        vehicle: Vehicle,
        parameters: ParameterClient,
        writer: ParameterWriter,
        conductor: Conductor,
        say: Say,
        offload: Offload,
    ) -> None:
        self._folder = config.storage.path / "setup"
        self.ledger = Ledger(ChangeLog(self._folder, HEADING_SETUP), offload)
        command = "companion autopilot-setup --undo"
        self.recovery = Recovery(vehicle, parameters, writer, self.ledger, say, contextlib.nullcontext, command=command)
        self._parts = (config, vehicle, parameters, writer, self.ledger, self.recovery, conductor, say)
        self._setup: AutopilotSetup | None = None

    async def run(self) -> None:
        """Put back what an earlier daemon has left half done, until cancelled."""
        if self._folder.exists():
            self.ledger.load()
        await self.recovery.run()

    async def answer(self, request: Object) -> Object:
        """As `AutopilotSetup.answer`."""
        from companion.daemon.heading.autopilot_setup import AutopilotSetup

        if self._setup is None:
            self.ledger.load()
            self._setup = AutopilotSetup(*self._parts)
        return await self._setup.answer(request)

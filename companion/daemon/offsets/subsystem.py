"""The offsets in the autopilot: who writes them, who puts them back, and what else changes them."""

from __future__ import annotations

import logging
from collections.abc import Sequence

from companion.autopilot.vehicle.parameter_writer import ParameterWriter
from companion.daemon.core import Core, Subsystem, Task
from companion.daemon.devices.subsystem import Devices
from companion.daemon.offsets.firmware_calibration import FirmwareCalibration
from companion.daemon.offsets.ledger import Ledger, Recovery
from companion.daemon.offsets.other_writers import OtherCompanions, Rivalry
from companion.daemon.offsets.px4_writes import Px4Writes
from companion.daemon.offsets.reboot import RebootOwed
from companion.daemon.offsets.write import WritePath
from companion.formats import Object
from companion.storage.changes import ChangeLog

logger = logging.getLogger(__name__)


class Offsets(Subsystem):
    """Writing, and what belongs to it."""

    def __init__(self, core: Core, devices: Devices) -> None:
        config, vehicle, parameters, imus = core.config, core.vehicle, core.parameters, devices.imus
        self._vehicle, self.slots = vehicle, devices.slots
        self.companions = OtherCompanions(core.link, core.texts.say, lambda: core.wanted.push)
        self.ledger = Ledger(ChangeLog(config.storage.path), core.offload, self.companions.why_not)
        self.writer = ParameterWriter(parameters, vehicle)
        self.rivalry, self.owed = Rivalry(core, imus), RebootOwed(core)
        px4 = Px4Writes(core.link, vehicle, self.writer, self.ledger, devices.slots, core.say)
        firmware = FirmwareCalibration(core, self.writer, self.ledger)
        self.write_path = WritePath(core, imus, self.writer, self.ledger, px4, firmware, self.owed)
        self.recovery = Recovery(core, self.writer, self.ledger, imus, self.owed)

    def load(self) -> None:  # noqa: D102 - as in the base class
        self.owed.load()
        self.ledger.load()
        if self.ledger.fault is not None:
            # Stay and say so: a daemon that is gone is harder to understand from the field.
            logger.error("%s", self.ledger.fault)

    def status(self) -> Object:  # noqa: D102
        others = [] if (words := self.companions.warning) is None else [words]
        return {
            "fault": self.ledger.fault,
            "putting_back": self.ledger.pending,
            "why_no_undo": self.recovery.why_no_undo(),
            "undoable": self.undoable(),
            "warnings": [*self.ledger.unusable, *others, *self.rivalry.warnings],
        }

    def undoable(self) -> list[Object]:
        """List the steps that can be undone on this aircraft, the latest first."""
        return [step.shown() for step in self.ledger.steps(self._vehicle.system_id)]

    def tasks(self) -> Sequence[Task]:  # noqa: D102
        return [
            ("recovery", self.recovery.run),
            ("reboot-owed", self.owed.run),
            ("other-companions", self.companions.run),
        ]

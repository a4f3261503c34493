"""Calibrations and alignments: who may start one, how it goes, and what is kept of it."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping

import msgspec

from companion.calibration.machine import Machine
from companion.calibration.solution.record import Record
from companion.daemon.calibrating.aligner import Aligner
from companion.daemon.calibrating.alignment import AlignmentInForce
from companion.daemon.calibrating.bias_memory import BiasMemory
from companion.daemon.calibrating.commands import Commands
from companion.daemon.calibrating.conductor import Conductor
from companion.daemon.calibrating.course import Course
from companion.daemon.calibrating.measuring import Measuring
from companion.daemon.calibrating.results import Results
from companion.daemon.calibrating.solving import Solving
from companion.daemon.core import Core, Handler, Subsystem
from companion.daemon.devices.subsystem import Devices
from companion.daemon.offsets.conclusion import Conclusion
from companion.daemon.offsets.dither import Ditherer
from companion.daemon.offsets.subsystem import Offsets
from companion.links.system.request import Object
from companion.storage.records import RecordStore


class Calibrating(Subsystem):
    """From request to record."""

    def __init__(self, core: Core, devices: Devices, offsets: Offsets) -> None:
        config, imus = core.config, devices.imus
        self._core = core
        machine = Machine()
        self.store = RecordStore(config.storage.path)
        self.alignment = AlignmentInForce(config, core.offload)
        self.memory = BiasMemory(core, imus, devices.sensors, self.alignment)
        measuring = Measuring(core, machine, imus)
        self.solving = Solving(core, self.alignment, self.memory)
        ditherer = Ditherer(core, machine, imus, offsets.writer, offsets.ledger)
        self.conclusion = Conclusion(core, machine, offsets.effect, offsets.firmware)
        course = Course(
            core, machine, measuring, self.solving, ditherer, offsets.planner, offsets.pusher, self.conclusion
        )
        aligner = Aligner(core, machine, imus, measuring, self.alignment)
        self._results = Results(core, self.store, self.memory)
        self.conductor = Conductor(core, machine, measuring, course, aligner, offsets.recovery, self._results)

    def load(self) -> None:  # noqa: D102 - as in the base class
        self.alignment.load()
        self.memory.load()
        self._results.load()

    def commands(self) -> Mapping[str, Handler]:  # noqa: D102
        return Commands(self.conductor, self.alignment).by_name()

    def status(self) -> Object:  # noqa: D102
        conductor, job = self.conductor, self.conductor.running
        still = self._core.collector.status(asyncio.get_running_loop().time())
        return {
            "state": conductor.state.shown,
            "reason": job.words if job is not None else conductor.reason,
            "progress": conductor.progress_percent if job is not None else None,
            "still_s": round(still.still_s, 1),
            "waiting_for": still.waiting_for,
            "alignment": self.alignment.status(),
            "last": _summary(conductor.last),
        }


def _summary(record: Record | None) -> Object | None:
    if record is None:
        return None
    return {
        "state": record.state,
        "started_at": record.started_at,
        "reason": record.reason,
        "magnetic": msgspec.to_builtins(record.magnetic),
    }

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
from companion.daemon.calibrating.results import Results
from companion.daemon.core import Core, Handler, Subsystem
from companion.daemon.devices.subsystem import Devices
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
        self.memory = BiasMemory(config, core.vehicle, imus, devices.sensors, self.alignment, core.offload)
        self.course = Course(
            config,
            machine,
            core.vehicle,
            core.collector,
            imus,
            offsets.pusher,
            core.say,
            core.offload,
            offsets.reboot,
            Ditherer(
                config,
                core.vehicle,
                core.parameters,
                imus,
                core.collector,
                offsets.writer,
                offsets.ledger,
                machine,
            ),
            self.alignment,
            self.memory,
        )
        aligner = Aligner(config, core.vehicle, core.collector, imus, machine, self.alignment, core.say, core.offload)
        self._results = Results(self.store, core.collector, self.memory, core.say, core.offload)
        self.conductor = Conductor(core, self.course, aligner, offsets.recovery, self._results)

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

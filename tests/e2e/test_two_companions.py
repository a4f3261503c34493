"""Two whole companions with the same settings on one autopilot: one writes, the other refuses and names it."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable
from pathlib import Path

from companion.component.service import Refusal
from companion.estimation.machine import What
from sim.station import End
from tests.e2e.test_calibration import calibrated
from tests.e2e.test_faults import values
from tests.e2e.test_undo import undone
from tests.support.rig import Rig
from tests.support.wire import Wire

WORDS = "second companion (1/191) on this link writes: stop one of them"


class Shared:
    """One port of an autopilot on a bus: all hear it and each other."""

    def __init__(self, port: End) -> None:
        self._port = port
        self._taps: list[Tap] = []
        port.attach(lambda data: self._to_all(data))

    def tap(self) -> Tap:
        self._taps.append(Tap(self))
        return self._taps[-1]

    def _to_all(self, data: bytes, but: Tap | None = None) -> None:
        for tap in self._taps:
            if tap is not but and tap.transmit is not None:
                tap.transmit(data)

    def from_tap(self, tap: Tap, data: bytes, t_s: float) -> None:
        self._port.receive(data, t_s)
        self._to_all(data, but=tap)


class Tap:
    """The autopilot's end of one wire."""

    def __init__(self, shared: Shared) -> None:
        self._shared = shared
        self.transmit: Callable[[bytes], None] | None = None

    def attach(self, transmit: Callable[[bytes], None] | None) -> None:
        self.transmit = transmit

    def receive(self, data: bytes, t_s: float) -> None:
        self._shared.from_tap(self, data, t_s)


@contextlib.asynccontextmanager
async def two(folder: Path) -> AsyncIterator[tuple[Rig, Rig]]:
    """Run two companions on one port of one double."""
    one = Rig(folder / "one", min_still_s=4.0, max_s=8.0)
    other = Rig(folder / "other", min_still_s=4.0, max_s=8.0)
    for wire in (one.wire, other.wire, other.radio):
        wire.unplug()
    shared = Shared(one.double)
    one.wire = Wire(one.link, shared.tap())
    other.autopilot, other.aircraft = one.autopilot, one.aircraft
    for device, same in zip(other.devices.values(), one.devices.values(), strict=True):
        device.aircraft = same.aircraft
    other.wire = Wire(other.link, shared.tap())
    async with one.running():
        other._start()
        feeding = asyncio.create_task(other._feed())
        try:
            yield one, other
        finally:
            await other._stop(other._serving)
            await other._stop(feeding)


async def test_one_writes_and_the_other_refuses_by_name_and_an_undo_brings_all_back(tmp_path: Path) -> None:
    async with two(tmp_path) as both:
        for rig in both:
            await rig.ready()
        await asyncio.sleep(8.0)
        before = values(both[0].double)
        refusing = [rig for rig in both if rig.service.offsets.companions.why_not() is not None]
        (second,) = refusing
        (writer,) = [rig for rig in both if rig is not second]
        refusal = second.service.calibrating.manager.start_calibration(What.BOTH, "test")
        assert isinstance(refusal, Refusal)
        assert refusal.reason == WORDS
        status = second.service.status()
        assert (status["headline"]["word"], status["headline"]["reason"]) == ("TWO COMPANIONS", WORDS)
        assert WORDS in status["warnings"]
        assert WORDS.replace("writes", "waits") in writer.service.status()["warnings"]
        said = {(rig.service.offsets.companions.warning or "").replace("second", "Second") for rig in both}
        assert said <= set(both[0].ground.texts())
        assert (await calibrated(writer))[0].outcome == "done"
        assert values(writer.double) != before
        undo = second.service.calibrating.manager.start_undo("test")
        assert isinstance(undo, Refusal)
        assert undo.reason == WORDS
        assert (await undone(writer)).outcome == "done"
        assert values(writer.double) == before


async def test_a_write_that_the_second_has_begun_to_measure_for_is_not_done(tmp_path: Path) -> None:
    """A request may come before the other companion is heard."""

    async with two(tmp_path) as both:
        for rig in both:
            await rig.ready()
        before = values(both[0].double)
        jobs = [rig.service.calibrating.manager.start_calibration(What.BOTH, "test") for rig in both]
        results = [await job.finished for job in jobs if not isinstance(job, Refusal)]
        reasons = [job.reason for job in jobs if isinstance(job, Refusal)]
        reasons += [result.reason for result in results if result.outcome != "done"]
        assert len(reasons) == 1
        assert WORDS in reasons[0]
        (writer,) = [rig for rig in both if rig.service.status()["undoable"]]
        assert (await undone(writer)).outcome == "done"
        assert values(writer.double) == before

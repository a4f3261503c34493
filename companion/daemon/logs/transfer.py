"""One log on its way from the autopilot: at half of what the line carries, going on where the last one ended."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from pathlib import Path
from typing import Final, TypeVar

from companion.autopilot.logs.blocks import BLOCK_BYTES, Blocks
from companion.autopilot.logs.ftp import FileClient
from companion.autopilot.logs.latest import find
from companion.daemon.calibrating.conductor import Conductor
from companion.daemon.core import Core
from companion.errors import AutopilotError
from companion.storage.flight_logs import LogFile, named

logger = logging.getLogger(__name__)

T = TypeVar("T")
PROGRESS_EVERY_S: Final = 0.5
SILENT_S: Final = 30.0
"""Without an answer for so long it ends; what has come stays."""
HANGS_S: Final = 5.0
"""How long the end waits for the disk."""
_WRITE_BYTES: Final = 1 << 16
"""So much waits in memory for the disk."""
_RATE_S: Final = 10.0
_REOPENINGS: Final = 5
"""In a row, with nothing new between them."""


class Transfer:
    """One log on its way."""

    def __init__(self, core: Core, conductor: Conductor, files: FileClient) -> None:
        self.size = 0
        """Of the log, in bytes; 0: not known yet."""
        self._core, self._conductor, self._files = core, conductor, files
        self._name, self._here, self._new = "", 0, b""
        self._waits = ""
        self._rate, self._measured = 0.0, (0.0, 0)

    @property
    def percent(self) -> int:
        """Of the log that is here."""
        return 100 * self._here // max(self.size, 1)

    def words(self) -> str:
        """What goes on, for people."""
        waits = self._waits or self._files.waits
        if not self.size:
            return waits or "looking for the log"
        now_s, (then_s, then) = asyncio.get_running_loop().time(), self._measured
        if now_s - then_s > _RATE_S or not self._rate:
            self._rate = (self._here - then) / max(now_s - then_s, PROGRESS_EVERY_S)
            self._measured = now_s, self._here
        ahead = waits or "no answer"
        if not waits and self._rate > 0.0:
            left_s = (self.size - self._here) / self._rate
            left = f"{left_s / 60.0:.0f} min" if left_s > 90.0 else f"{left_s:.0f} s"
            ahead = f"{self._rate / 1e3:.1f} kB/s, {left} left"
        return f"{self._name}: {self.percent} % of {self.size / 1e6:.1f} MB; {ahead}"

    def stopped(self) -> str:
        """Where it has ended before the log did."""
        return f"stopped at {self.percent} % of the log; companion flight --fetch goes on from there"

    async def run(self, wanted: str | None) -> Path:
        """Fetch it, and say where it is; `wanted` is its name or number, None the latest.

        Raises:
            AutopilotError: it has none, or does not give it.
            StorageError: it cannot be kept.
        """
        await self._calm()
        path = await find(self._files, self._core.vehicle.firmware, wanted)
        size = await self._files.open(path)
        if not size:
            raise AutopilotError(f"{path}: {'empty' if size == 0 else 'not'} on the autopilot")
        file = await self._place(path, size)
        if not file.is_whole or file.bytes < size:
            await self._on_disk(file.begin, size)
        self._name, self._here, self.size = file.path.name, file.bytes, size
        self._measured = asyncio.get_running_loop().time(), self._here
        self._files.patience_s = SILENT_S
        await self._fill(path, file)
        return file.path

    async def _place(self, path: str, size: int) -> LogFile:
        """The file of that log, or for it: another log of the same name, such as another aircraft's, stays."""
        # PX4's names are times of a day, and the folder is the day.
        name = "_".join(path.split("/")[-2 if ".ulg" in path else -1 :])
        files = named(self._core.config.storage.path / "logs", name)
        while True:
            file: LogFile = await self._on_disk(next, files)
            if file.bytes <= size and await self._continues(file):
                return file
            if not file.is_whole:
                await self._on_disk(file.cut, 0)
                return file

    async def _continues(self, file: LogFile) -> bool:
        """Whether the end of what is here is in the open file too: no two logs have the same times there.

        PX4 has one session for all stations: where another one opens a file meanwhile, its bytes come for ours.
        """
        tail = await self._on_disk(file.tail, BLOCK_BYTES)
        return not tail or await self._files.read(file.bytes - len(tail), len(tail)) == tail

    async def _fill(self, path: str, file: LogFile) -> None:
        """Until it is whole; what counts as its own is looked at again at every opening, and at the end."""
        sure, in_vain = file.bytes, 0
        while not file.is_whole:
            try:
                await self._read_on(file)
            finally:
                await self._write(file)
            size = await self._files.open(path)
            if size is None or size < self.size:
                raise AutopilotError(f"{path}: not on the autopilot any more as it was: fetch again")
            in_vain = 0 if file.bytes > sure else in_vain + 1
            if in_vain > _REOPENINGS:
                raise AutopilotError(f"the autopilot does not give the log: {self.stopped()}")
            if not await self._continues(file):
                logger.warning("%s: another file's bytes came for it; read again", path)
                await self._on_disk(file.cut, sure)
            elif file.bytes == self.size:
                await self._on_disk(file.finish)
            sure = self._here = file.bytes

    async def _read_on(self, file: LogFile) -> None:
        """Read until the end, or until the autopilot has closed the file."""
        loop, blocks = asyncio.get_running_loop(), Blocks(file.bytes, self.size)
        heard_s = loop.time()
        while blocks.front < self.size:
            if await self._calm():
                heard_s = loop.time()
            asked_s, wanted = loop.time(), blocks.wanted()
            answers = await self._files.read_all(wanted, blocks.within_s)
            for answer in answers:
                self._new += blocks.take(answer.offset, answer.data)
            self._here = blocks.front
            if any(answer.error for answer in answers):
                return
            if answers:
                heard_s = loop.time()
            elif loop.time() - heard_s > SILENT_S:
                raise AutopilotError(f"no answer from the autopilot for {SILENT_S:.0f} s: {self.stopped()}")
            if len(self._new) >= _WRITE_BYTES:
                await self._write(file)
            await asyncio.sleep(blocks.pause_s(loop.time() - asked_s, all_came=len(answers) == len(wanted)))

    async def _write(self, file: LogFile) -> None:
        new, self._new = self._new, b""
        if new:
            await self._on_disk(file.append, new)

    async def _on_disk(self, function: Callable[..., T], *arguments: object) -> T:
        """Run a call that touches the disk; a cancel waits for its end."""
        task: asyncio.Future[T] = asyncio.ensure_future(self._core.offload(function, *arguments))
        try:
            return await asyncio.shield(task)
        except asyncio.CancelledError:
            await asyncio.wait([task], timeout=HANGS_S)
            raise

    async def _calm(self) -> bool:
        """Let a calibration go first; whether there was one."""
        waited = False
        while self._conductor.running is not None:
            self._waits, waited = "waits for the calibration", True
            await asyncio.sleep(PROGRESS_EVERY_S)
        self._waits = ""
        return waited

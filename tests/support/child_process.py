"""A child process that behaves as COMPANION_TEST_CHILD says: `python -m tests.support.child_process`."""

from __future__ import annotations

import asyncio
import os
import signal
import sys
from pathlib import Path

from companion.formats import Object
from companion.links.system.process import REPORT_EVERY_S, ChildSettings, run_child


class Work:
    """Writes its process id into a file, then works, falls silent, fills its memory or crashes."""

    def __init__(self, settings: ChildSettings) -> None:
        self.manner, self.log = os.environ["COMPANION_TEST_CHILD"], Path(settings.config.storage.path, "log")

    def note(self, words: str) -> None:
        with self.log.open("a", encoding="utf-8") as log:
            log.write(words + "\n")

    def hoard(self) -> None:
        hoard = bytearray(1_000_000_000)
        self.note(f"has {len(hoard)} bytes")

    async def run(self) -> None:
        self.note(f"started {os.getpid()}")
        try:
            match self.manner:
                case "crash":
                    raise ZeroDivisionError
                case "hang":
                    os.kill(os.getpid(), signal.SIGSTOP)
                case "deaf":
                    signal.signal(signal.SIGTERM, signal.SIG_IGN)
                case "greedy":
                    self.hoard()
                case "greedy callback":
                    asyncio.get_running_loop().call_soon(self.hoard)
                case "garbage":
                    sys.stdout.buffer.write(b"{" * 1_000_000 + b"\n")
                    sys.stdout.buffer.flush()
            await asyncio.get_running_loop().create_future()
        except asyncio.CancelledError:
            if self.manner == "slow end":
                await asyncio.sleep(1.5 * REPORT_EVERY_S)
            self.note("ended")
            raise

    def status(self) -> Object:
        return {"good": True, "summary": "works"}


if __name__ == "__main__":
    run_child(Work, memory_mib=200)

"""A wall clock that can be set wrong; the monotonic one goes on."""

from __future__ import annotations

import contextlib
import datetime
import sys
import time
import types
from collections.abc import Iterator


class WallClock:
    """Shifts what the daemon's modules take for the date."""

    def __init__(self) -> None:
        self.shift_s = 0.0

    def set_to(self, unix_s: float) -> None:
        self.shift_s = unix_s - _real_time()

    @contextlib.contextmanager
    def worn(self) -> Iterator[None]:
        clock = self

        class Shifted(datetime.datetime):
            @classmethod
            def now(cls, tz: datetime.tzinfo | None = None) -> datetime.datetime:  # type: ignore[override]
                return datetime.datetime.fromtimestamp(_real_time() + clock.shift_s, tz)

        fake = types.ModuleType("datetime")
        fake.__dict__.update(datetime.__dict__)
        fake.__dict__["datetime"] = Shifted
        touched = [
            module
            for name, module in list(sys.modules.items())
            if name.startswith("companion.") and getattr(module, "datetime", None) is datetime
        ]
        for module in touched:
            module.datetime = fake  # type: ignore[attr-defined]
        time.time = lambda: _real_time() + clock.shift_s
        try:
            yield
        finally:
            time.time = _real_time
            for module in touched:
                module.datetime = datetime  # type: ignore[attr-defined]


_real_time = time.time

"""Every message that the daemon listens to, under the autopilot's and a ground station's ids, with the worst values."""

from __future__ import annotations

import asyncio
import logging
import math
import random
import tempfile
from pathlib import Path
from typing import Any, Final, Literal

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.component.service import Refusal
from companion.daemon.job import Job
from companion.estimation.machine import What
from tests.support.extent import extent
from tests.support.rig import Rig
from tests.support.virtual_time import run_virtual

MORE: Final = '[push]\nattitude = "full"'
SENDERS: Final = ((1, 1), (1, 1), (255, 190))
_BITS: Final = {"int8_t": 8, "int16_t": 16, "int32_t": 32, "int64_t": 64}


class Hostile:
    """Packs messages of any kind with values that no honest sender sends."""

    def __init__(self, chance: random.Random) -> None:
        self._chance = chance
        self._codecs = {ids: mavlink.MAVLink(None, srcSystem=ids[0], srcComponent=ids[1]) for ids in SENDERS}

    def pack(self, kind: type[mavlink.MAVLink_message]) -> bytes:
        codec = self._codecs[self._chance.choice(SENDERS)]
        lengths = dict(zip(kind.ordered_fieldnames, kind.array_lengths, strict=True))
        message = kind(
            *(
                self._field(name, kind_of, lengths[name])
                for name, kind_of in zip(kind.fieldnames, kind.fieldtypes, strict=True)
            )
        )
        data: bytes = message.pack(codec)
        codec.seq = (codec.seq + 1) % 256
        return data

    def _field(self, name: str, kind: str, length: int) -> Any:
        if kind == "char":
            names = (b"INS_GYROFFS_X", b"CAL_GYRO0_XOFF", b"CMP_AT_ARM", b"\xff\xfe\x80", b"")
            return self._chance.choice(names)[: length or 1]
        if name.startswith("target_") and self._chance.random() < 0.7:
            return 1 if name == "target_system" else 191
        return [self._value(kind) for _ in range(length)] if length else self._value(kind)

    def _value(self, kind: str) -> float:
        if kind in ("float", "double"):
            return self._chance.choice((math.nan, math.inf, -math.inf, 3.4e38, -3.4e38, 1e-45, -0.0, 0.0, 1.0, 31010.0))
        bits = _BITS[kind.removeprefix("u")]
        if kind.startswith("u"):
            return self._chance.choice((0, 1, 2 ** (bits - 1), 2**bits - 1, self._chance.getrandbits(bits)))
        return self._chance.choice((0, 1, -1, -(2 ** (bits - 1)), 2 ** (bits - 1) - 1))


class Errors(logging.Handler):
    """Keeps what may not be said: faults of the program."""

    def __init__(self) -> None:
        super().__init__(logging.ERROR)
        self.tracebacks: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        if record.exc_info:
            self.tracebacks.append(f"{record.getMessage()}: {record.exc_info[1]!r}")


async def _survives(folder: Path, firmware: Literal["ardupilot", "px4"], seed: int) -> None:
    rig = Rig(folder, seed=seed % 7, firmware=firmware, recordings_mb=16, at_arm="warn", imu_rate_hz=10.0, more=MORE)
    hostile = Hostile(random.Random(seed))
    async with rig.running():
        await rig.ready()
        kinds = [kind for kind in mavlink.mavlink_map.values() if rig.link._handlers.get(kind.msgname)]
        assert len(kinds) > 20
        start = rig.service.calibrating.manager.start_calibration
        asked = start(What.BOTH, "a pilot")
        for turn in range(1500):
            for kind in kinds if turn < 2 else hostile._chance.choices(kinds, k=3):
                rig.wire.carry_from_other(hostile.pack(kind))
            await asyncio.sleep(0.02)
            if turn % 10 == 0:
                await rig.service.faces.refresh()
        assert rig.link.received["handler error"] == 0
        assert rig.service.recorder.fault is None
        # Once it is over, all is as before: at the latest when the words of a spoofed restart have been looked into.
        await rig.until(lambda: not rig.service.calibrating.manager.state.busy, 240.0)
        if isinstance(asked, Job):
            assert asked.finished.done()
        await asyncio.sleep(60.0)
        await rig.until(lambda: not rig.service.calibrating.manager.state.busy, 240.0)
        again = start(What.BOTH, "a pilot")
        assert not isinstance(again, Refusal), again.reason
        async with asyncio.timeout(240.0):
            result = await asyncio.shield(again.finished)
        assert result.outcome == "done", result.reason
        assert again.record is not None
        assert again.record.site is not None
        assert again.record.site.latitude_deg == pytest.approx(rig.site.latitude_deg)
        await rig.service.faces.refresh()
        assert rig.service.recorder.fault is None


@pytest.mark.parametrize("firmware", ["ardupilot", "px4"])
@settings(max_examples=extent(whole=20, a_slice=1))
@given(seed=st.integers(0, 2**32))
def test_no_value_of_any_message_ends_status_recordings_or_calibrations(
    firmware: Literal["ardupilot", "px4"], seed: int
) -> None:
    errors = Errors()
    logging.getLogger().addHandler(errors)
    try:
        with tempfile.TemporaryDirectory() as folder:
            run_virtual(_survives(Path(folder), firmware, seed))
    finally:
        logging.getLogger().removeHandler(errors)
    assert errors.tracebacks == []

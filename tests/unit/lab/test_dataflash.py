"""ArduPilot's logs in rows, against pymavlink."""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest
from pymavlink.DFReader import DFReader_binary

from companion.lab.autopilot_logs import dataflash
from tests.support import flown


def test_dataflash_is_read_as_pymavlink_reads_it(tmp_path: Path) -> None:
    flight = flown.fly(seconds=70.0, rate_hz=20.0)
    path = flown.dataflash(tmp_path / "log.bin", flown.messages(flight, flown.parameters(), from_s=55.0))
    fields = {
        "IMU": ("I", ("GyrX", "AccZ", "T")),
        "GPS": ("I", ("Status", "Lat", "Alt", "None")),
        "ARM": ("", ("ArmState",)),
    }
    (found,), reader = dataflash(path, fields), DFReader_binary(str(path))  # type: ignore[no-untyped-call]
    theirs = defaultdict(list)
    while (one := reader.recv_msg()) is not None:  # type: ignore[no-untyped-call]
        if one.get_type() in fields:
            columns = fields[one.get_type()][1]
            theirs[one.get_type()].append([one.TimeUS * 1e-6, *(getattr(one, each, np.nan) for each in columns)])
    reader.close()  # type: ignore[no-untyped-call]
    for name in fields:
        np.testing.assert_allclose(found.rows(name), np.array(theirs[name], dtype=np.float64), rtol=1e-12)
    assert {name: value for _, name, value in found.parameters} == pytest.approx(flown.parameters())

"""ArduPilot's logs in blocks, against pymavlink, which reads whole ones."""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest
from pymavlink.DFReader import DFReader_binary

from companion.lab.logs.autopilot_logs import PARAMETERS, Block, dataflash
from tests.support import flown
from tests.support.made_noise import Floats

WHERE = pytest.mark.parametrize("piece", [61, 1 << 22], ids=["in pieces", "at once"])


def rows_of(blocks: list[Block | None]) -> dict[tuple[str, int], Floats]:
    found = defaultdict(list)
    for block in blocks:
        if block is not None:
            found[block.name, block.instance].append(block.rows)
    return {key: np.concatenate(rows) for key, rows in found.items()}


def parameters_of(blocks: list[Block | None]) -> list[tuple[float, str, float]]:
    told = [block for block in blocks if block is not None and block.name == PARAMETERS]
    return [
        (t_s, name, value) for each in told for (t_s, value), name in zip(each.rows.tolist(), each.texts, strict=True)
    ]


@WHERE
def test_dataflash_is_read_as_pymavlink_reads_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, piece: int) -> None:
    monkeypatch.setattr("companion.lab.logs.autopilot_logs._PIECE", piece)
    flight = flown.fly(seconds=70.0, rate_hz=20.0)
    path = flown.dataflash(tmp_path / "log.bin", flown.messages(flight, flown.parameters(), from_s=55.0))
    fields = {
        "IMU": ("I", ("GyrX", "AccZ", "T")),
        "GPS": ("I", ("Status", "Lat", "Alt", "None")),
        "ARM": ("", ("ArmState",)),
    }
    blocks = list(dataflash(path, fields))
    assert blocks[0] is None
    found, reader = rows_of(blocks), DFReader_binary(str(path))  # type: ignore[no-untyped-call]
    theirs = defaultdict(list)
    while (one := reader.recv_msg()) is not None:  # type: ignore[no-untyped-call]
        if one.get_type() in fields:
            columns = fields[one.get_type()][1]
            theirs[one.get_type()].append([one.TimeUS * 1e-6, *(getattr(one, each, np.nan) for each in columns)])
    reader.close()  # type: ignore[no-untyped-call]
    for name in fields:
        np.testing.assert_allclose(found[name, 0], np.array(theirs[name], dtype=np.float64), rtol=1e-12)
    assert {name: value for _, name, value in parameters_of(blocks)} == pytest.approx(flown.parameters())

"""Logs in blocks, against pyulog and pymavlink, which read whole ones; and what damage leaves of them."""

from __future__ import annotations

import struct
import sys
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import pytest
from pymavlink.DFReader import DFReader_binary
from pyulog import ULog

from companion.errors import StorageError
from companion.replay.blocks import DROPOUTS, PARAMETERS, Block
from companion.replay.dataflash import dataflash
from companion.replay.ulog import ulog
from tests.support import flown
from tests.support.autopilot_files import ulog_message as message
from tests.support.made_noise import Floats

TOPICS = {"gyro": ("x[0]", "x[2]", "flag", "not_there"), "other": ("n",)}
TEXTS = ["gyro:uint64_t timestamp;float[3] x;bool flag;uint8_t[3] _padding0;", "other:uint64_t timestamp;int16_t n;"]
WHERE = pytest.mark.parametrize("piece", [61, 1 << 22], ids=["in pieces", "at once"])


def flags(incompatible: int = 0, offset: int = 0) -> bytes:
    return message(b"B", struct.pack("<8xB7xQ16x", incompatible, offset))


def subscribed(number: int, name: str, instance: int = 0) -> bytes:
    return message(b"A", struct.pack("<BH", instance, number) + name.encode())


def parameter(name: str, value: float) -> bytes:
    key, data = (f"int32_t {name}", struct.pack("<i", value)) if isinstance(value, int) else (
        f"float {name}", struct.pack("<f", value)
    )  # fmt: skip
    return message(b"P", bytes((len(key),)) + key.encode() + data)


def gyro(number: int, t_us: int, x: float) -> bytes:
    return message(b"D", struct.pack("<HQ3f?", number, t_us, x, -x, 2.0 * x, True))


def definitions(flagged: bytes = b"") -> list[bytes]:
    head = b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 1_000_000)
    return [head, flagged or flags(), *(message(b"F", text.encode()) for text in TEXTS), parameter("SOME", 1.5)]


def body(start_us: int = 2_000_000, count: int = 40) -> list[bytes]:
    parts = [subscribed(7, "gyro"), subscribed(8, "gyro", 1), subscribed(9, "other"), subscribed(10, "unknown")]
    for k in range(count):
        t_us = start_us + 10_000 * k
        parts += [gyro(7, t_us, 0.5 * k), gyro(8, t_us + 100, -0.5 * k)]
        parts += [message(b"D", struct.pack("<H", 10) + bytes(29)), message(b"L", b"6" + bytes(8) + b"words")]
        if k % 4 == 0:
            parts.append(message(b"D", struct.pack("<HQh", 9, t_us, k)))
        if k == 20:
            parts += [parameter("SOME", 2.5), parameter("WHOLE", 7), message(b"O", struct.pack("<H", 130))]
            parts.append(message(b"S", bytes.fromhex("2f731320250cbb12")))
    return parts


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
def test_a_ulog_is_read_as_pyulog_reads_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, piece: int) -> None:
    monkeypatch.setattr("companion.replay.blocks._PIECE", piece)
    path = tmp_path / "log.ulg"
    path.write_bytes(b"".join([*definitions(), *body()]))
    shares: list[float] = []
    blocks = list(ulog(path, TOPICS, shares.append))
    assert shares[-1] == 1.0
    assert shares == sorted(shares)
    found, whole = rows_of(blocks), ULog(str(path))
    for instance in (0, 1):
        data, rows = whole.get_dataset("gyro", instance).data, found["gyro", instance]
        columns = [data["timestamp"] * 1e-6, data["x[0]"], data["x[2]"], data["flag"]]
        np.testing.assert_allclose(rows[:, :4], np.column_stack(columns), rtol=1e-15)
        assert np.isnan(rows[:, 4]).all()
    data = whole.get_dataset("other").data
    np.testing.assert_allclose(found["other", 0], np.column_stack([data["timestamp"] * 1e-6, data["n"]]), rtol=1e-15)
    assert len(found[DROPOUTS, 0]) == len(whole.dropouts) == 1
    first, *others = parameters_of(blocks)
    assert first == (1.0, "SOME", whole.initial_parameters["SOME"])
    assert [each[1:] for each in others] == [each[1:] for each in whole.changed_parameters]
    # Of several topics' last times, the middle one.
    assert [each[0] for each in others] == pytest.approx(
        [each[0] * 1e-6 for each in whole.changed_parameters], abs=0.011
    )


@WHERE
def test_dataflash_is_read_as_pymavlink_reads_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, piece: int) -> None:
    monkeypatch.setattr("companion.replay.blocks._PIECE", piece)
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


def test_what_px4_wrote_after_a_crash_is_not_of_the_flight(tmp_path: Path) -> None:
    path = tmp_path / "log.ulg"
    start = b"".join(body())
    offset = len(b"".join(definitions())) + len(start) - 5
    whole = b"".join(definitions(flags(1, offset))) + start[:-5]
    path.write_bytes(whole + gyro(7, 9_000_000, 1e6) * 3)
    found = rows_of(list(ulog(path, TOPICS)))
    assert len(found["gyro", 0]) == 40
    assert found["gyro", 0][-1, 0] < 3.0


def test_a_later_format_is_one_line(tmp_path: Path) -> None:
    path = tmp_path / "log.ulg"
    path.write_bytes(b"".join([*definitions(flags(2)), *body()]))
    with pytest.raises(StorageError, match=r"log\.ulg: of a later format of PX4's logs than is known here$"):
        list(ulog(path, TOPICS))


@WHERE
def test_damage_costs_the_messages_that_it_hits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, piece: int) -> None:
    monkeypatch.setattr("companion.replay.blocks._PIECE", piece)
    parts, wrong = body(), 0
    path = tmp_path / "log.ulg"
    for cut in range(1, 30):
        damaged = list(parts)
        damaged[60] = damaged[60][:-cut] if cut < len(damaged[60]) else b"\xff" * 700
        path.write_bytes(b"".join([*definitions(), *damaged]))
        found = rows_of(list(ulog(path, TOPICS)))
        for instance, sign in ((0, 1.0), (1, -1.0)):
            rows = found["gyro", instance]
            assert len(rows) >= 36
            wrong += int((rows[:, 1] != sign * 0.5 * np.round((rows[:, 0] - 2.0) / 0.01)).sum())
    # 5 bytes left of one, 21 of the next one's 26 put behind them, and the rest begins as a parameter would.
    assert wrong <= 1


@WHERE
def test_logs_put_together_are_told_apart(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, piece: int) -> None:
    monkeypatch.setattr("companion.replay.blocks._PIECE", piece)
    path = tmp_path / "log.ulg"
    one = b"".join([*definitions(), *body()])
    path.write_bytes(one[:-3] + one)
    blocks = list(ulog(path, TOPICS))
    assert blocks.count(None) == 2
    second = rows_of(blocks[len(blocks) - blocks[::-1].index(None) :])
    assert len(second["gyro", 0]) == 40


def steps(path: Path) -> int:
    """Count the instructions of Python that reading a log takes."""
    count = 0

    def trace(frame: FrameType, event: str, _argument: Any) -> Any:
        nonlocal count
        frame.f_trace_opcodes = True
        count += event == "opcode"
        return trace

    sys.settrace(trace)
    try:
        list(ulog(path, TOPICS))
    finally:
        sys.settrace(None)
    return count


def many(count: int, between: Callable[[int], bytes]) -> bytes:
    """A log with that many subscriptions, and something of each between it and the next."""
    parts = definitions()
    for k in range(count):
        parts += [subscribed(k, "gyro", k % 4), between(k)]
    return b"".join(parts)


BETWEEN: dict[str, Callable[[int], bytes]] = {
    "nothing": lambda _: b"",
    "data": lambda k: gyro(k, 10_000 * k, 1.0),
    "parameters": lambda k: gyro(k, 10_000 * k, 1.0) + parameter("SOME", float(k)),
    "damage": lambda k: b"\xff" * 30 + gyro(k // 2, 10_000 * k, 1.0),
    "a number used again": lambda k: gyro(k, 10_000 * k, 1.0) + subscribed(k, "other"),
    "formats": lambda k: message(b"F", b"gyro:uint64_t timestamp;uint8_t[30000] many;float x;"),
}


@pytest.mark.parametrize("between", BETWEEN)
def test_the_work_of_reading_grows_as_the_log_does(tmp_path: Path, between: str) -> None:
    """A log of 3.5 MB has room for 150,000 subscriptions: work by its square takes minutes."""
    path, found = tmp_path / "log.ulg", []
    for count in (100, 400):
        path.write_bytes(many(count, BETWEEN[between]))
        found.append(steps(path))
    assert found[1] < 4.2 * found[0]
    assert found[1] < 400 * 4000

"""Files of state with whatever content, and whatever lies in their place: named, set aside, never believed."""

from __future__ import annotations

import json
import logging
import os
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import pytest

from companion.errors import StorageError
from companion.estimation.records.record import ArmingRecord
from companion.storage.changes import Changed, ChangeLog, ChangeSet, Undoable
from companion.storage.profiles import ProfileStore, read_profile
from companion.storage.records import SIGNING_FILE, BiasStore, RecordStore, alignment_in, faces_in, signing_time_in
from companion.storage.state import MOST_ASIDE, MOST_BYTES, BoundedList, StateFile, sealed
from companion.web.access import stored_token

# A read of a FIFO that nobody writes to never ends.
pytestmark = pytest.mark.timeout(60)


def sparse(path: Path) -> None:
    with path.open("wb") as file:
        file.truncate(100_000_000)


HOSTILE: dict[str, Callable[[Path], Any]] = {
    "nothing": lambda path: path.write_bytes(b""),
    "zeros": lambda path: path.write_bytes(bytes(500)),
    "no UTF-8": lambda path: path.write_bytes(b'{"system_id": "\xff\xfe"}'),
    "NaN": lambda path: path.write_bytes(b'{"system_id": NaN, "ticks": NaN, "imus": Infinity}'),
    "another type": lambda path: path.write_bytes(b'{"system_id": [], "ticks": "1", "imus": 1, "entries": {}}'),
    "a number": lambda path: path.write_bytes(b"1" * 5000),
    "too deep": lambda path: path.write_bytes(b'{"x":' + b"[" * 100_000 + b"]" * 100_000 + b"}"),
    "100 MB": sparse,
    "a FIFO": os.mkfifo,
    "a folder": lambda path: path.mkdir(),
    "a device": lambda path: path.symlink_to("/dev/zero"),
    "a terminal": lambda path: path.symlink_to("/dev/ptmx"),
    "a loop": lambda path: path.symlink_to(path.name),
}
FILES: dict[str, Callable[[Path], Any]] = {
    "journal.json": lambda folder: ChangeLog(folder).journal.load(),
    "undo-1.json": lambda folder: ChangeLog(folder).undos()[0].load(),
    "alignment.json": lambda folder: alignment_in(folder).load(),
    "faces.json": lambda folder: faces_in(folder).load(),
    "biases.json": lambda folder: BiasStore(folder).read() or None,
    "armings.json": lambda folder: BoundedList(folder / "armings.json", ArmingRecord, 200).read() or None,
    SIGNING_FILE: lambda folder: signing_time_in(folder).load(),
}


@pytest.mark.parametrize("what", HOSTILE)
@pytest.mark.parametrize("name", FILES)
def test_what_cannot_be_used_is_set_aside_and_said_in_one_line(
    tmp_path: Path, name: str, what: str, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    HOSTILE[what](path)
    assert FILES[name](tmp_path) is None
    (said,) = caplog.records
    words = said.getMessage()
    assert (said.levelno, words.count("\n")) == (logging.WARNING, 0)
    assert words.startswith(f"{path}: cannot be ")
    assert words.endswith(f"; renamed to {path.name}.unusable")
    assert len(words) < 400
    assert not os.path.lexists(path)
    assert os.path.lexists(f"{path}.unusable")
    # And never met again.
    caplog.clear()
    if "undo" not in name:
        assert FILES[name](tmp_path) is None
    assert caplog.records == []


@pytest.mark.parametrize("what", sorted(HOSTILE.keys() - {"a loop"}))
def test_others_that_are_read_are_refused_at_once(tmp_path: Path, what: str) -> None:
    (tmp_path / "records").mkdir()
    (tmp_path / "profiles").mkdir()
    record, profile = tmp_path / "records/000001.json", "profiles/mine.json"
    for path in (record, tmp_path / profile, tmp_path / "web-token"):
        HOSTILE[what](path)
    store = RecordStore(tmp_path)
    assert store.history() == []
    with pytest.raises(StorageError):
        ProfileStore(tmp_path).read("mine")
    with pytest.raises(StorageError):
        read_profile(tmp_path / profile)
    if what not in ("NaN", "another type"):  # a token is any short text
        with pytest.raises(StorageError):
            stored_token(tmp_path)
    assert os.path.lexists(record)  # of records, each is named and stays


@pytest.mark.parametrize("what", ["a FIFO", "a device", "a folder"])
def test_what_is_no_regular_file_is_not_even_opened(tmp_path: Path, what: str, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "journal.json"
    HOSTILE[what](path)

    def opened(*_: object) -> int:
        raise AssertionError("a device may do something when it is opened")

    monkeypatch.setattr(os, "open", opened)
    with pytest.raises(StorageError, match=r"journal\.json: cannot be read: not a regular file$"):
        ChangeLog(tmp_path).journal.read()


def test_no_more_is_read_than_may_be_there(tmp_path: Path) -> None:
    sparse(tmp_path / "journal.json")
    tracemalloc.start()
    try:
        with pytest.raises(StorageError, match=f"more than {MOST_BYTES} bytes"):
            ChangeLog(tmp_path).journal.read()
        assert tracemalloc.get_traced_memory()[1] < 10_000_000
    finally:
        tracemalloc.stop()


def test_where_it_cannot_be_set_aside_it_is_named_and_not_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "journal.json"
    path.write_bytes(b"{")

    def read_only(*_: object) -> None:
        raise OSError(30, "Read-only file system")

    monkeypatch.setattr(os, "replace", read_only)
    for _ in range(2):
        journal = ChangeLog(tmp_path).journal
        assert journal.load() is None
        assert journal.unusable is not None
        assert journal.unusable.endswith("it cannot be renamed either")


def test_a_few_are_kept_of_each_name(tmp_path: Path) -> None:
    path = tmp_path / "journal.json"
    for number in range(MOST_ASIDE + 3):
        path.write_text(str(number))
        assert ChangeLog(tmp_path).journal.load() is None
    kept = {entry.name: entry.read_text() for entry in tmp_path.iterdir()}
    # The first that went wrong tells most.
    assert kept == {
        "journal.json.unusable": "0",
        "journal.json.unusable-2": "1",
        "journal.json.unusable-3": str(MOST_ASIDE + 2),
    }


CHANGES = ChangeSet(1, (Changed("INS_GYROFFS_X", before=0.0015, after=0.001), Changed("INS_ACCOFFS_Z", 0.25, -0.5)))


def test_no_flipped_bit_of_a_journal_goes_unnoticed(tmp_path: Path) -> None:
    log = ChangeLog(tmp_path)
    log.journal.write(CHANGES)
    path = tmp_path / "journal.json"
    whole = path.read_bytes()
    assert json.loads(whole)["sha256"]
    for position in range(8 * len(whole)):
        data = bytearray(whole)
        data[position // 8] ^= 1 << position % 8
        path.write_bytes(data)
        try:
            assert log.journal.read() == CHANGES  # the last byte is a new line, or another gap
        except StorageError:
            continue
        assert position // 8 == len(whole) - 1


def test_a_value_changed_by_hand_is_noticed_and_a_file_from_before_there_were_checksums_is_not_lost(
    tmp_path: Path,
) -> None:
    log = ChangeLog(tmp_path)
    log.undo_of(1).write(Undoable(1, (CHANGES,)))
    path = tmp_path / "undo-1.json"
    path.write_bytes(path.read_bytes().replace(b"0.0015", b"0.0025"))
    with pytest.raises(StorageError, match="its checksum does not fit: damaged, or changed by hand"):
        log.undo_of(1).read()
    # Of a version that kept a single step, and not whose that was.
    single = msgspec.json.encode({"system_id": 1, "changes": CHANGES.changes}) + b"\n"
    path.write_bytes(single)
    kept = log.undo_of(1).read()
    assert kept is not None
    assert kept.all == (CHANGES,)
    # A key that is not known may be a checksum's with a wrong letter.
    path.write_bytes(msgspec.json.encode(msgspec.to_builtins(CHANGES) | {"sha257": "0"}))
    with pytest.raises(StorageError, match="unknown field"):
        log.undo_of(1).read()


# --- what may be written to an autopilot


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        (Changed("INS_GYROFFS_X", before=1e30, after=0.0), "INS_GYROFFS_X = 1e[+]30; allowed: -0.486 to 0.486 rad/s"),
        (Changed("INS_GYROFFS_X", before=9.5, after=0.0), "INS_GYROFFS_X = 9.5; allowed"),
        (Changed("INS_ACCOFFS_X", before=9.5, after=0.0), "INS_ACCOFFS_X = 9.5; allowed: -4.9 to 4.9 m/s"),
        (Changed("CAL_ACC0_XOFF", before=0.0, after=0.0, via=9.5), "CAL_ACC0_XOFF = 9.5"),
        (Changed("CAL_GYRO3_ZOFF", before=0.0, after=0.0, also=(0.0, -1.0)), "CAL_GYRO3_ZOFF = -1"),
        (Changed("INS_GYR1_CALTEMP", before=1e4, after=None), "INS_GYR1_CALTEMP = 10000; allowed: -300 to 400 deg C"),
        (Changed("INS_GYR_ID", before=0.5, after=None), "INS_GYR_ID = 0.5; allowed: whole numbers 0 to"),
        (Changed("SENS_IMU_AUTOCAL", before=0.5, after=0.0), "SENS_IMU_AUTOCAL = 0.5"),
        (Changed("ARMING_CHECK", before=0.0, after=1.0), "'ARMING_CHECK': not a parameter that the companion writes"),
        (Changed("A" * 40, before=0.0, after=1.0), "'A{40}': not a parameter that the companion writes"),
        (Changed("INS_ACC_X", before=1.0, after=1.0), "'INS_ACC_X': not a parameter that the companion writes"),
        (Changed("VISO_TYPE", before=0.0, after=1.0), "'VISO_TYPE': not a parameter that the companion writes"),
    ],
)
def test_only_names_that_the_companion_writes_with_values_that_an_imu_can_have(
    tmp_path: Path, changed: Changed, words: str
) -> None:
    changes = ChangeSet(1, (changed,))
    log = ChangeLog(tmp_path)
    files: tuple[tuple[StateFile[Any], ChangeSet | Undoable], ...] = (
        (log.journal, changes),
        (log.undo_of(1), Undoable(1, (CHANGES, changes))),
        (log.undo_of(1), Undoable(1, changes=changes.changes)),
    )
    for file, kept in files:
        # Neither from a file, nor by whatever fault into one.
        with pytest.raises(StorageError, match=f"^found {words}"):
            file.write(kept)
        file.path.write_bytes(sealed(msgspec.json.encode(kept)))
        with pytest.raises(StorageError, match=f"cannot be used: found {words}"):
            file.read()


def test_a_change_set_is_of_one_vehicle_and_names_each_parameter_once(tmp_path: Path) -> None:
    log = ChangeLog(tmp_path)
    for changes, words in (
        (msgspec.structs.replace(CHANGES, changes=CHANGES.changes * 2), "named twice"),
        (msgspec.structs.replace(CHANGES, system_id=0), "found system_id 0; allowed: 1 to 255"),
        (msgspec.structs.replace(CHANGES, system_id=256), "found system_id 256"),
    ):
        with pytest.raises(StorageError, match=words):
            log.journal.write(changes)
    with pytest.raises(StorageError, match="found system_id 2; allowed: 1"):
        log.undo_of(1).write(Undoable(1, (CHANGES, msgspec.structs.replace(CHANGES, system_id=2))))
    log.undo_of(2).write(Undoable(2, (msgspec.structs.replace(CHANGES, system_id=2),)))
    (tmp_path / "undo-2.json").rename(tmp_path / "undo-1.json")
    with pytest.raises(StorageError, match="found system_id 2; allowed: 1"):
        log.undo_of(1).read()
    for stray in ("undo-01.json", "undo-x.json", "undo-1\n.json", "undo-1000.json"):
        (tmp_path / stray).write_bytes(b"{")
    assert [file.path.name for file in log.undos()] == ["undo-1.json"]


def test_everything_that_a_calibration_writes_may_be_kept(tmp_path: Path) -> None:
    xyz = "XYZ"
    # Names and unset values as the firmwares have them (ArduPilot's first IMU is irregular, 4 and 5 are again).
    ardupilot = [
        *(f"INS_{kind}{n}OFFS_{axis}" for kind in ("GYR", "ACC") for n in ("2", "3") for axis in xyz),
        *(f"INS_{kind}FFS_{axis}" for kind in ("GYRO", "ACCO") for axis in xyz),
        *(f"INS{n}_{kind}FFS_{axis}" for kind in ("GYRO", "ACCO") for n in "45" for axis in xyz),
    ]
    px4 = [f"CAL_{kind}{slot}_{axis}OFF" for kind in ("GYRO", "ACC") for slot in range(4) for axis in xyz]
    # 20 deg/s and 3.5 m/s^2 are the most that is written; residuals of 5 deg/s and 1 m/s^2 the most that is believed.
    most = {"GYR": (0.349, 0.43, 0.45), "ACC": (3.5, 4.5, 4.55)}
    offsets = [
        Changed(name, before=-before, after=after, via=via, also=(via, -via))
        for name in (*ardupilot, *px4)
        for after, before, via in (most["GYR" if "GYR" in name else "ACC"],)
    ]
    family = [
        *(Changed(name, -300.0, None) for name in ("INS_GYR1_CALTEMP", "INS_GYR2_CALTEMP", "INS4_GYR_CALTEMP")),
        *(Changed(name, 2752771.0, None) for name in ("INS_GYR_ID", "INS_GYR3_ID", "INS5_GYR_ID")),
        Changed("INS_GYR_CAL", 1.0, 0.0),
        Changed("IMU_GYRO_CAL_EN", 1.0, 0.0),
        Changed("SENS_IMU_AUTOCAL", 1.0, 0.0),
    ]
    changes = ChangeSet(255, (*offsets, *family))
    ChangeLog(tmp_path).journal.write(changes)
    assert ChangeLog(tmp_path).journal.read() == changes
    with pytest.raises(StorageError, match="VISO_TYPE"):
        ChangeLog(tmp_path).journal.write(ChangeSet(1, (Changed("VISO_TYPE", 0.0, 1.0),)))

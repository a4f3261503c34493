"""No bytes in a file of state raise anything but the one error, and what is believed of a journal may be written."""

from __future__ import annotations

import math
import tempfile
from pathlib import Path
from typing import Any

import msgspec
from hypothesis import given
from hypothesis import strategies as st

from companion.daemon.offsets.reboot import owed_in
from companion.estimation.records.record import ArmingRecord
from companion.storage.changes import Changed, ChangeLog, ChangeSet
from companion.storage.records import (
    SIGNING_FILE,
    BiasStore,
    Done,
    RecordStore,
    alignment_in,
    faces_in,
    signing_time_in,
)
from companion.storage.state import BoundedList, sealed

NAMES = st.sampled_from(
    ["INS_GYROFFS_X", "INS_ACC2OFFS_Y", "CAL_GYRO0_XOFF", "CAL_ACC3_ZOFF", "INS_GYR_ID", "ARMING_CHECK", "", "A" * 40]
)
NUMBERS = st.one_of(st.floats(), st.integers(), st.sampled_from([1e30, -1e300, 9.5, 0.49, 4.91, 2**63, 10**400]))
LEAVES = st.one_of(st.none(), st.booleans(), NUMBERS, NAMES, st.text(max_size=20))
KEYS = st.sampled_from(
    [
        *("system_id", "changes", "parameter", "before", "after", "via", "also", "sha256", "state", "format_version"),
        *("imus", "points", "entries", "ticks", "reserved", "uptime_s", "boot_id", "offset_deg", "sigma_deg"),
    ]
)
JSON = st.recursive(
    LEAVES,
    lambda inner: st.one_of(st.lists(inner, max_size=4), st.dictionaries(KEYS, inner, max_size=6)),
    max_leaves=20,
)


def encoded(value: Any) -> bytes:
    try:
        return msgspec.json.encode(value)
    except (OverflowError, msgspec.MsgspecError, UnicodeEncodeError):
        return b"10" * 500


@st.composite
def cut_and_changed(draw: st.DrawFn) -> bytes:
    whole = bytearray(sealed(msgspec.json.encode(ChangeSet(1, (Changed("INS_GYROFFS_X", 0.0, 0.001),)))))
    for _ in range(draw(st.integers(0, 3))):
        whole[draw(st.integers(0, len(whole) - 1))] = draw(st.integers(0, 255))
    return bytes(whole[: draw(st.integers(0, len(whole)))])


CONTENTS = st.one_of(st.binary(max_size=300), cut_and_changed(), JSON.map(encoded), JSON.map(encoded).map(sealed))


@given(CONTENTS)
def test_any_bytes_in_any_file(data: bytes) -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "records").mkdir()
        files = ("journal.json", "undo-1.json", "alignment.json", "biases.json", "armings.json", SIGNING_FILE)
        for file in (*files, "faces.json", "reboot-owed.json", "by-hand.json", "records/000001.json"):
            (folder / file).write_bytes(data)
        log = ChangeLog(folder)
        log.journal.load()
        log.undo_of(1).load()
        alignment_in(folder).load()
        faces_in(folder).load()
        owed_in(folder).load()
        BoundedList(folder / "by-hand.json", Done, 5).read()
        BiasStore(folder).read()
        BoundedList(folder / "armings.json", ArmingRecord, 5).read()
        signing_time_in(folder).load()
        RecordStore(folder).history()


VALUES = st.one_of(st.none(), NUMBERS)
CHANGES = st.fixed_dictionaries(
    {"parameter": NAMES, "before": VALUES, "after": VALUES}, optional={"via": VALUES, "also": st.lists(VALUES)}
)
LIMITS = {"GYROFFS": 0.5, "GYRO0": 0.5, "OFF": 5.0, "GYR_ID": 2.0**24}


@given(st.fixed_dictionaries({"system_id": st.integers(-1, 300), "changes": st.lists(CHANGES, max_size=4)}))
def test_what_is_believed_of_a_journal_is_what_an_imu_can_have(changes: dict[str, Any]) -> None:
    with tempfile.TemporaryDirectory() as name:
        (Path(name) / "journal.json").write_bytes(sealed(encoded(changes)))
        found = ChangeLog(Path(name)).journal.load()
    if found is None:
        return
    assert 1 <= found.system_id <= 255
    for changed in found.changes:
        limit = next(most for part, most in LIMITS.items() if part in changed.parameter)
        values = [each for each in (changed.before, changed.after, changed.via, *changed.also) if each is not None]
        assert all(math.isfinite(value) and abs(value) <= limit for value in values)

"""Files after a power cut: whole or absent, whatever step fails."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import msgspec
import pytest

from companion.errors import StorageError
from companion.estimation.records.record import ImuRecord, Record, WrittenParameter, to_json
from companion.storage.changes import Changed, ChangeLog, ChangeSet, Undoable
from companion.storage.records import RecordStore
from companion.storage.state import only_daemon, write_atomically


def _record(reason: str) -> Record:
    imu = ImuRecord(
        name="fc",
        samples=6000,
        temperature_degc=None,
        gyro_bias_rad_s=(1e-4, -2e-4, 0.1 + 0.2),
        gyro_sigma_stat_rad_s=(1e-6, 1e-6, 1e-6),
        gyro_sigma_use_rad_s=(1e-5, 1e-5, 1e-5),
        accel_bias_m_s2=None,
        accel_sigma_stat_m_s2=None,
        accel_sigma_use_m_s2=None,
        covariance=None,
        residual_gyro_rad_s=None,
        residual_accel_m_s2=None,
        written={"INS_GYROFFS_X": WrittenParameter(before=0.0, after=1e-4, read_back=1e-4, outcome="verified")},
    )
    return Record(
        state="done",
        reason=reason,
        warnings=(),
        started_at="2026-05-01T10:00:00+00:00",
        duration_s=12.0,
        pose=None,
        site=None,
        imus=(imu,),
    )


@pytest.mark.parametrize("step", ["fsync", "replace", "fdopen"])
def test_a_failure_at_any_step_leaves_the_old_content(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: str
) -> None:
    path = tmp_path / "state.json"
    write_atomically(path, b"old")

    def fail(*args: object) -> Any:
        if step == "fdopen":
            os.close(int(str(args[0])))
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, step, fail)
    with pytest.raises(StorageError, match=r"state\.json: cannot be written: No space left on device"):
        write_atomically(path, b"new")
    monkeypatch.undo()
    assert path.read_bytes() == b"old"
    assert [entry.name for entry in tmp_path.iterdir()] == ["state.json"]


def test_order_is_content_then_name_then_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    steps: list[str] = []
    real_fsync, real_replace = os.fsync, os.replace

    def fsync(descriptor: int) -> None:
        steps.append("folder" if os.path.isdir(f"/proc/self/fd/{descriptor}") else "content")
        real_fsync(descriptor)

    def replace(old: str, new: str) -> None:
        steps.append("name")
        real_replace(old, new)

    monkeypatch.setattr(os, "fsync", fsync)
    monkeypatch.setattr(os, "replace", replace)
    write_atomically(tmp_path / "x", b"1")
    assert steps == ["content", "name", "folder"]


_WRITER = """
import sys, pathlib
from companion.storage.state import write_atomically
path, n = pathlib.Path(sys.argv[1]), 0
while True:
    n += 1
    write_atomically(path, b"%d\\n" % n * 20000)
    print(n, flush=True)
"""


@pytest.mark.real_clock
def test_kill_9_at_any_moment_leaves_a_whole_file(tmp_path: Path) -> None:
    path = tmp_path / "state"
    for rounds in (1, 3, 7, 12):
        with subprocess.Popen([sys.executable, "-c", _WRITER, str(path)], stdout=subprocess.PIPE) as writer:
            assert writer.stdout is not None
            for _ in range(rounds):
                said = int(writer.stdout.readline())
            writer.send_signal(signal.SIGKILL)
        lines = path.read_bytes().split()
        assert len(lines) == 20000
        assert len(set(lines)) == 1
        assert int(lines[0]) >= said


def test_records_come_back_newest_first_and_whole(tmp_path: Path) -> None:
    store = RecordStore(tmp_path)
    assert store.history() == []
    saved = [_record(f"number {n}") for n in range(12)]
    for record in saved:
        store.save(record)
    assert RecordStore(tmp_path).history() == saved[::-1]
    assert RecordStore(tmp_path).history(limit=3) == saved[:8:-1]


def test_a_damaged_record_is_passed_over_and_said(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    store = RecordStore(tmp_path)
    store.save(_record("good"))
    store.file(store.save(_record("cut"))).path.write_bytes(b'{"format_version": 1, "st')
    assert [record.reason for record in store.history()] == ["good"]
    assert "000002.json: cannot be used: " in caplog.text


def test_a_record_with_keys_that_were_removed_since_is_read(tmp_path: Path) -> None:
    """`by_model` stood in `prior` where a fleet's statistics had taken part."""
    gyro = {
        "used": True,
        "power_ups": 5,
        "temperature_model": False,
        "expected_rad_s": [1e-4, 0.0, 0.0],
        "by_model": True,
        "shift_sigma": [0.0, 0.0, 0.0],
    }
    record = _record("of before")
    imu = msgspec.structs.replace(record.imus[0], prior={"gyro": gyro, "accel": None})
    record = msgspec.structs.replace(record, imus=(imu,))
    store = RecordStore(tmp_path)
    before = to_json(record).replace(b'"samples"', b'"by_model":true,"samples"')
    assert before.count(b'"by_model"') == 2
    store.file(store.save(record)).path.write_bytes(before)
    assert store.history() == [record]


def test_a_record_that_was_changed_is_passed_over_and_one_from_before_there_were_checksums_is_not(
    tmp_path: Path,
) -> None:
    store = RecordStore(tmp_path)
    store.file(store.save(_record("of before"))).path.write_bytes(to_json(_record("of before")) + b"\n")
    path = store.file(store.save(_record("changed"))).path
    path.write_bytes(path.read_bytes().replace(b'"duration_s":12.0', b'"duration_s":19.0'))
    assert [record.reason for record in store.history()] == ["of before"]
    with pytest.raises(StorageError, match="damaged, or changed by hand"):
        store.file(2).read()


def test_a_storage_directory_below_a_missing_folder_is_refused(tmp_path: Path) -> None:
    """A typing error, or a stick that is not mounted: a tree made silently would hide it."""
    directory = tmp_path / "stick" / "state"
    with only_daemon(directory), pytest.raises(StorageError, match=r"cannot be written: No such file or directory$"):
        ChangeLog(directory).check_writable()
    assert list(tmp_path.iterdir()) == []
    directory.parent.mkdir()
    with only_daemon(directory):
        ChangeLog(directory).check_writable()
    assert list(tmp_path.rglob("*")) == [directory.parent, directory]


def test_journal_and_undo_outlive_the_process(tmp_path: Path) -> None:
    changes = ChangeSet(1, (Changed("INS_GYROFFS_X", before=0.1, after=-0.25),))
    log = ChangeLog(tmp_path)
    assert log.journal.read() is None
    log.journal.write(changes)
    log.undo_of(1).write(Undoable(1, (changes,)))
    assert ChangeLog(tmp_path).journal.read() == changes
    log.journal.clear()
    log.journal.clear()
    assert ChangeLog(tmp_path).journal.read() is None
    assert ChangeLog(tmp_path).undo_of(1).read() == Undoable(1, (changes,))


def test_a_journal_that_cannot_be_understood_is_an_error_not_an_empty_one(tmp_path: Path) -> None:
    (tmp_path / "journal.json").write_text("{")
    with pytest.raises(StorageError, match=r"journal\.json: cannot be used"):
        ChangeLog(tmp_path).journal.read()


def test_a_folder_that_cannot_be_written_is_found_out_before_it_matters(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(StorageError, match="cannot be written"):
        ChangeLog(tmp_path / "file").check_writable()
    ChangeLog(tmp_path / "new").check_writable()
    assert list((tmp_path / "new").iterdir()) == []

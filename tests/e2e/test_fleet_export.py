"""`companion fleet export`, read back by another reader, from both databases, against what the aircraft have told."""

from __future__ import annotations

import csv
import datetime
import json
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import polars as pl
import pytest
import sqlalchemy as sa

from companion.cli import main as companion
from companion.errors import StorageError
from companion.fleet import schema
from companion.fleet.database import engine_of
from companion.fleet.export import export, names
from companion.fleet.simulated import Aircraft
from companion.fleet.store import Message, Store
from tests.support.collecting import NOW
from tests.support.postgres import INITDB, postgres

UTC = datetime.UTC


def told_aircraft() -> list[Aircraft]:
    fleet = [Aircraft(k) for k in range(4)]
    for each in fleet[:3]:
        each.live(NOW, 9)
    fleet[0].calibrate(NOW, 'not still, "gyro x"\nand more; é')
    fleet[1].calibrate(NOW, held_back=True)
    fleet[2].tell("event", NOW, {"what": "lost", "epoch": fleet[2].epoch, "sequences": [[1, 3]]})
    return fleet


FLEET = told_aircraft()


def fill(database: str) -> str:
    store = Store(database)
    store.prepare()
    for each in FLEET:
        store.take([Message(f"fleet/{each.id}/item", payload) for payload in each.told.values()])
        store.take([Message(f"fleet/{each.id}/hello", each.hello)])
    store.take([Message(f"fleet/{FLEET[0].id}/item", b"\xff~")])
    store.close()
    return database


@pytest.fixture(scope="module")
def in_sqlite(tmp_path_factory: pytest.TempPathFactory) -> str:
    return fill(str(tmp_path_factory.mktemp("export") / "fleet.sqlite"))


@pytest.fixture(scope="module")
def in_postgres() -> Iterator[str]:
    if INITDB is None:
        pytest.skip("no PostgreSQL")
    with postgres() as server:
        yield fill(server.create("fleet"))


def read(path: Path) -> tuple[dict[str, str], list[tuple[Any, ...]]]:
    """Columns with their types, and rows in some order, by another reader."""
    frame = pl.read_parquet(path) if path.suffix == ".parquet" else pl.read_csv(path, infer_schema=False)
    return {name: str(kind) for name, kind in frame.schema.items()}, sorted(frame.rows(), key=str)


@pytest.mark.parametrize("what", names())
def test_both_databases_give_the_same_file(in_sqlite: str, in_postgres: str, tmp_path: Path, what: str) -> None:
    files = {}
    for ending in ("csv", "parquet"):
        for database, name in ((in_sqlite, "sqlite"), (in_postgres, "postgres")):
            files[name, ending] = tmp_path / f"{name}.{ending}"
            count = export(database, what, files[name, ending])
            columns, rows = read(files[name, ending])
            assert len(rows) == count
            engine = engine_of(database, reads_only=True)
            with engine.connect() as connection:
                assert connection.exec_driver_sql(f"SELECT COUNT(*) FROM {what}").scalar() == count  # noqa: S608
                if name == "postgres" and ending == "parquet":
                    _are_of_the_types(connection, what, columns)
            engine.dispose()
    collectors = {"received_at", "heard_at", "last_at", "hello_at"}  # by the clock
    for ending in ("csv", "parquet"):
        columns, rows = read(files["sqlite", ending])
        others, other_rows = read(files["postgres", ending])
        assert columns == others
        kept = [k for k, name in enumerate(columns) if name not in collectors]

        def figures(of: list[tuple[Any, ...]], kept: list[int] = kept) -> list[str]:
            return sorted(str([row[k] for k in kept]) for row in of)

        assert figures(rows) == figures(other_rows)


def _are_of_the_types(connection: sa.Connection, what: str, columns: dict[str, str]) -> None:
    """What PostgreSQL says that each column is."""
    same = {
        "timestamp with time zone": "Datetime(time_unit='us', time_zone='UTC')",
        "double precision": "Float64",
        "bigint": "Int64",
        "integer": "Int64",
        "bytea": "Binary",
    }
    query = "SELECT column_name, data_type FROM information_schema.columns WHERE table_name = %s"
    for name, kind in connection.exec_driver_sql(query, (what,)):
        assert columns[name] == same.get(kind, "String"), (what, name)


def test_it_has_what_was_told(in_sqlite: str, tmp_path: Path) -> None:
    path = tmp_path / "biases.parquet"
    export(in_sqlite, "bias_history", path)
    columns = ["aircraft", "sequence", "imu", "axis", "started_at", "gyro_bias_deg_h"]
    found = {row[:4]: row[4:] for row in pl.read_parquet(path, columns=columns).rows()}
    wanted = {}
    for each in FLEET:
        for sequence in each.biases:
            body = json.loads(each.told[sequence])["body"]
            for imu in body["imus"]:
                for k, axis in enumerate("xyz"):
                    at = datetime.datetime.fromisoformat(body["started_at"])
                    wanted[each.id, sequence, imu["name"], axis] = at, imu["gyro_bias_rad_s"][k]
    assert found.keys() == wanted.keys()
    for key, (at, gyro_rad_s) in wanted.items():
        assert found[key][0] == at
        assert found[key][1] == pytest.approx(gyro_rad_s * 180.0 / 3.141592653589793 * 3600.0, rel=1e-14)


def test_words_and_times_in_csv(in_sqlite: str, tmp_path: Path) -> None:
    path = tmp_path / "calibrations.csv"
    export(in_sqlite, "calibrations", path)
    with path.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert 'not still, "gyro x"\nand more; é' in {row["reason"] for row in rows}
    assert all(re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{6}Z", row["started_at"]) for row in rows)
    assert {row["undone_at"] for row in rows} == {""}


def test_what_cannot_be_is_one_line_and_leaves_the_former_file(
    in_sqlite: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "fleet.csv"
    path.write_text("former")
    none, text, other = tmp_path / "none.sqlite", tmp_path / "text.sqlite", tmp_path / "other.sqlite"
    other.touch()
    text.write_text("no database, but long enough to be read as one" * 20)
    for words, code, said in (
        (["fleets", str(path)], 2, "found 'fleets'; allowed: aircraft, "),
        (["fleet", str(tmp_path / "fleet.xlsx")], 2, "found the ending '.xlsx'; allowed: .csv, .parquet"),
        (["fleet", str(path), "--database", str(none)], 1, f"{none}: no such file"),
        (["fleet", str(path), "--database", str(text)], 1, "file is not a database"),
        (["fleet", str(path), "--database", str(other)], 1, "has no fleet yet: "),
        (["fleet", str(tmp_path / "no" / "fleet.csv")], 1, "cannot be written: No such file or directory"),
    ):
        assert companion(["fleet", "export", "--database", in_sqlite, *words]) == code
        err = capsys.readouterr().err
        assert said in err
        assert err.count("\n") == 1
    assert not none.exists()
    monkeypatch.setattr(os, "fsync", lambda _: (_ for _ in ()).throw(OSError(28, "No space left on device")))
    with pytest.raises(StorageError, match="No space left"):
        export(in_sqlite, "fleet", path)
    assert path.read_text() == "former"
    assert {each.name for each in tmp_path.iterdir()} == {"fleet.csv", "text.sqlite", "other.sqlite"}
    monkeypatch.undo()
    assert companion(["fleet", "export", "--database", in_sqlite, "fleet", str(path)]) == 0
    assert capsys.readouterr().out == f"{path}: {len(FLEET)} rows\n"
    assert path.stat().st_mode & 0o777 == 0o644


@pytest.mark.parametrize("ending", ["csv", "parquet"])
def test_memory_is_bounded(tmp_path: Path, ending: str) -> None:
    """A table that is larger than what the process may have."""
    database = str(tmp_path / "fleet.sqlite")
    store = Store(database)
    store.prepare()
    store.close()
    engine = engine_of(database)
    row = {"epoch": "0" * 16, "format_version": 1, "received_at": NOW, "state": "taken", "payload": ""}
    with engine.begin() as connection:
        for k in range(16):
            rows = [row | {"aircraft": f"{k:036x}", "sequence": j, "payload": f"{k}-{j}-" * 1000} for j in range(1000)]
            connection.execute(sa.insert(schema.items), rows)
    engine.dispose()
    size = (tmp_path / "fleet.sqlite").stat().st_size
    before = "import pyarrow.parquet, resource; " * (ending == "parquet") + "from companion.fleet.export import export"
    peak = (
        f"{before}; import resource, sys; used = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_maxrss;"
        " first = used(); export(sys.argv[1], 'items', __import__('pathlib').Path(sys.argv[2])); print(used() - first)"
    )
    answer = subprocess.run(
        [sys.executable, "-c", peak, database, str(tmp_path / f"items.{ending}")],
        check=True,
        capture_output=True,
        text=True,
    )
    assert size > 100e6
    assert int(answer.stdout) * 1024 < 80e6

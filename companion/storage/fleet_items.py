"""Store of numbered items (results and events) for the fleet, by aircraft.

One SQLite file (`fleet.sqlite` in the storage directory) has the items, and "marks": which sources were already read.
Both change in one transaction, so that a power cut neither loses nor repeats an item. If the file is full, the oldest
confirmed items are dropped first. Every call blocks.
"""

from __future__ import annotations

import contextlib
import os
import sqlite3
import threading
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Final, Literal, NamedTuple

import msgspec

from companion.storage.state import file_error, set_aside

FILE: Final = "fleet.sqlite"
FORMAT_VERSION: Final = 1
MOST_BYTES: Final = 16 * 1024 * 1024  # most bytes of all items: some 2500 calibrations
MAKE_ROOM: Final = 1 / 16  # fraction dropped at once when the file is full, so that losses are reported rarely
CACHE_KIB: Final = 128
LOG_PAGES: Final = 64

Clock = Literal["good", "unknown"]
Range = tuple[int, int]  # first and last item number, both included


class Item(NamedTuple):
    """Item for the fleet: a result or an event of an aircraft, as JSON."""

    kind: str
    at: str  # time of the event: UTC, ISO 8601
    clock: Clock
    body: bytes  # A JSON object


class Mark(NamedTuple):
    """State of a source (a file, an IMU, ...) when it was last read for items."""

    stamp: str  # timestamp of the source's file, to notice a change quickly
    value: str


class SourceItems(NamedTuple):
    """Items found by one read of a source, and the new marks of the sources, by key."""

    marks: dict[str, Mark]
    items: Sequence[Item] = ()


class Kept(NamedTuple):
    """Item numbers stored for one aircraft, number of unconfirmed items, and time of the last confirmation."""

    aircraft: str
    epoch: str
    first: int  # first stored item number; `last` + 1 if no item is stored
    last: int  # last assigned item number; 0 if there is none
    waiting: int
    confirmed_at: str | None


class Waiting(NamedTuple):
    """Item that no collector has confirmed yet."""

    number: int  # position among the items of all aircraft
    aircraft: str
    epoch: str
    sequence: int
    item: Item


class FleetItems:
    """Database of the items for the fleet. A method that raises StorageError has changed nothing."""

    def __init__(self, directory: Path, *, most_bytes: int = MOST_BYTES) -> None:
        self.path = directory / FILE
        self._most_bytes = most_bytes
        self._connection: sqlite3.Connection | None = None
        self._lock = threading.Lock()

    def close(self) -> None:
        """Wait for a call in another thread to end, then close the file; the next call opens it again."""
        with self._lock:
            self._drop()

    def _drop(self) -> None:
        if self._connection is not None:
            connection, self._connection = self._connection, None
            with contextlib.suppress(sqlite3.Error):
                connection.close()

    def add(self, aircraft: str, entries: Iterable[SourceItems], now: str) -> None:
        """Save items with new numbers, and the marks. Add an event if unconfirmed items must be dropped for room."""
        with self._transaction() as db:
            for entry in entries:
                for item in entry.items:
                    _insert(db, aircraft, item)
                rows = [(key, *mark) for key, mark in entry.marks.items()]
                db.executemany("INSERT OR REPLACE INTO mark VALUES (?, ?, ?)", rows)
            self._make_room(db, now)

    def marks(self, prefix: str) -> dict[str, Mark]:
        with self._transaction() as db:
            found = db.execute("SELECT key, stamp, value FROM mark WHERE substr(key, 1, ?) = ?", (len(prefix), prefix))
            return {key: Mark(stamp, value) for key, stamp, value in found}

    def forget(self, keys: Iterable[str]) -> None:
        with self._transaction() as db:
            db.executemany("DELETE FROM mark WHERE key = ?", [(key,) for key in keys])

    def aircraft(self) -> list[Kept]:
        with self._transaction() as db:
            found = db.execute(
                "SELECT id, epoch, ifnull(min(sequence), last + 1), last, ifnull(sum(NOT confirmed), 0), confirmed_at"
                " FROM aircraft LEFT JOIN item ON aircraft = id GROUP BY id ORDER BY aircraft.rowid"
            )
            return [Kept(*row) for row in found]

    def waiting(self, after: int, limit: int) -> list[Waiting]:
        with self._transaction() as db:
            found = db.execute(
                "SELECT number, aircraft, epoch, sequence, kind, at, clock, body FROM item"
                " JOIN aircraft ON id = aircraft WHERE NOT confirmed AND number > ? ORDER BY number LIMIT ?",
                (after, limit),
            )
            return [Waiting(number, of, epoch, sequence, Item(*told)) for number, of, epoch, sequence, *told in found]

    def confirm(self, aircraft: str, epoch: str, ranges: Iterable[Range], now: str | None) -> bool:
        """Mark items as confirmed, or unconfirmed if `now` is None; return False if numbering `epoch` is outdated."""
        with self._transaction() as db:
            if db.execute("SELECT 1 FROM aircraft WHERE (id, epoch) = (?, ?)", (aircraft, epoch)).fetchone() is None:
                return False
            db.executemany(
                "UPDATE item SET confirmed = ? WHERE aircraft = ? AND sequence BETWEEN ? AND ?",
                [(now is not None, aircraft, first, last) for first, last in ranges],
            )
            if now is not None:
                db.execute("UPDATE aircraft SET confirmed_at = ? WHERE id = ?", (now, aircraft))
            return True

    def _make_room(self, db: sqlite3.Connection, now: str) -> None:
        (held,) = db.execute("SELECT ifnull(sum(bytes), 0) FROM item").fetchone()
        if held <= self._most_bytes:
            return
        lost: dict[str, list[Range]] = {}
        # Never drop events: they are few, and a report of lost items must not be lost.
        oldest = db.execute(
            "SELECT number, aircraft, sequence, bytes, confirmed FROM item WHERE kind != 'event'"
            " ORDER BY confirmed DESC, number"
        ).fetchall()
        for number, aircraft, sequence, size, confirmed in oldest:
            if held <= self._most_bytes * (1 - MAKE_ROOM):
                break
            db.execute("DELETE FROM item WHERE number = ?", (number,))
            held -= size
            if not confirmed:
                ranges = lost.setdefault(aircraft, [])
                if ranges and ranges[-1][1] == sequence - 1:
                    ranges[-1] = (ranges[-1][0], sequence)
                else:
                    ranges.append((sequence, sequence))
        for aircraft, ranges in lost.items():
            (epoch,) = db.execute("SELECT epoch FROM aircraft WHERE id = ?", (aircraft,)).fetchone()
            body = msgspec.json.encode({"what": "lost", "epoch": epoch, "sequences": ranges})
            _insert(db, aircraft, Item("event", now, "unknown", body))

    # --- the file

    @contextlib.contextmanager
    def _transaction(self) -> Iterator[sqlite3.Connection]:
        with self._lock:
            try:
                if self._connection is None:
                    self._connection = self._opened()
                db = self._connection
                db.execute("BEGIN IMMEDIATE")
                try:
                    yield db
                    db.execute("COMMIT")
                except BaseException:
                    with contextlib.suppress(sqlite3.Error):
                        db.execute("ROLLBACK")
                    raise
            except sqlite3.Error as error:
                self._drop()
                words = str(error)
                if getattr(error, "sqlite_errorcode", 0) & 0xFF in (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB):
                    words += f"; {self._begin_anew()}"
                raise file_error(self.path, "used", words) from error
            except OSError as error:
                raise file_error(self.path, "used", error) from error

    def _opened(self) -> sqlite3.Connection:
        if self.path.exists() and not self.path.is_file():
            raise file_error(self.path, "used", "not a regular file")
        self.path.parent.mkdir(exist_ok=True)
        os.close(os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_NONBLOCK, 0o600))
        db = sqlite3.connect(self.path, isolation_level=None, check_same_thread=False, timeout=1.0)
        try:
            # Exclusive locking: the log needs no shared memory. The other settings: safe at a power cut, small cache.
            db.execute("PRAGMA locking_mode = EXCLUSIVE")
            db.execute("PRAGMA journal_mode = WAL")
            db.execute("PRAGMA synchronous = FULL")
            db.execute(f"PRAGMA cache_size = -{CACHE_KIB}")
            db.execute(f"PRAGMA wal_autocheckpoint = {LOG_PAGES}")
            (version,) = db.execute("PRAGMA user_version").fetchone()
            if version > FORMAT_VERSION:
                raise file_error(self.path, "used", f"found format {version}; allowed: up to {FORMAT_VERSION}")
            if version < FORMAT_VERSION:
                db.executescript(
                    f"""
                    BEGIN IMMEDIATE;
                    CREATE TABLE aircraft (
                        id TEXT PRIMARY KEY, epoch TEXT NOT NULL, last INTEGER NOT NULL, confirmed_at TEXT);
                    CREATE TABLE item (
                        number INTEGER PRIMARY KEY, aircraft TEXT NOT NULL, sequence INTEGER NOT NULL,
                        confirmed INTEGER NOT NULL, bytes INTEGER NOT NULL, kind TEXT NOT NULL, at TEXT NOT NULL,
                        clock TEXT NOT NULL, body BLOB NOT NULL, UNIQUE (aircraft, sequence));
                    CREATE INDEX waiting ON item (number) WHERE NOT confirmed;
                    CREATE TABLE mark (key TEXT PRIMARY KEY, stamp TEXT NOT NULL, value TEXT NOT NULL);
                    PRAGMA user_version = {FORMAT_VERSION};
                    COMMIT;
                    """
                )
        except BaseException:
            db.close()
            raise
        return db

    def _begin_anew(self) -> str:
        """Set a damaged database file aside, and delete its log, which would damage the next file."""
        words = set_aside(self.path)
        for end in ("-wal", "-shm", "-journal"):
            with contextlib.suppress(OSError):
                self.path.with_name(self.path.name + end).unlink(missing_ok=True)
        return words


def _insert(db: sqlite3.Connection, aircraft: str, item: Item) -> None:
    db.execute("INSERT INTO aircraft VALUES (?, ?, 0, NULL) ON CONFLICT DO NOTHING", (aircraft, os.urandom(8).hex()))
    db.execute("UPDATE aircraft SET last = last + 1 WHERE id = ?", (aircraft,))
    db.execute(
        "INSERT INTO item (aircraft, sequence, confirmed, bytes, kind, at, clock, body)"
        " SELECT id, last, 0, ?, ?, ?, ?, ? FROM aircraft WHERE id = ?",
        (len(item.body), *item, aircraft),
    )

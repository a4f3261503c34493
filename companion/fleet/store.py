"""Writer of the fleet's database. Each batch is one transaction, so that no item is stored in part or twice."""

from __future__ import annotations

import contextlib
import datetime
import hashlib
import logging
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, Final, NamedTuple

import msgspec
import numpy as np
import sqlalchemy as sa
from sqlalchemy.dialects import postgresql, sqlite

from companion.errors import LinkError
from companion.fleet import schema
from companion.fleet.contract import (
    KINDS,
    Hello,
    InvalidPayloadError,
    ReceivedItem,
    Row,
    Rows,
    addressed,
    moment,
    read_hello,
    read_item,
    rows_of,
)
from companion.fleet.judgement import judged
from companion.fleet.schema import OF_THE_DATABASE, OF_THE_ITEM, engine_of, why
from companion.mqtt.client import Incoming
from companion.mqtt.fleet import FORMAT_VERSION

logger = logging.getLogger(__name__)

MOST_REJECTED: Final = 10_000
_SHOWN_BYTES: Final = 4096
_REJECTED: Final[Row] = {"state": "rejected", "kind": None, "at": None, "clock": None, "same": None}
_AGAIN: Final = 500  # Stored items parsed per transaction after an update that knows their kind or format


class BatchResult(NamedTuple):
    """Result of a batch: item numbers to confirm and to request, by (aircraft, id of numbering); rejected messages."""

    confirmed: dict[tuple[str, str], list[int]]
    wanted: dict[tuple[str, str], list[list[int]]]
    rejected: list[tuple[Incoming, str]]


class Store:
    """Access to the fleet's database: items, hellos, findings about sensors. Methods block: call them in a thread."""

    def __init__(self, database: str) -> None:
        self._engine, self._reads = engine_of(database), engine_of(database, reads_only=True)
        self._insert: Any = postgresql.insert if self._engine.dialect.name == "postgresql" else sqlite.insert

    @property
    def where(self) -> str:
        return self._engine.url.set(drivername=self._engine.dialect.name).render_as_string()

    def close(self) -> None:
        self._engine.dispose()
        self._reads.dispose()

    @contextlib.contextmanager
    def _link_errors(self) -> Iterator[None]:
        try:
            yield
        except sa.exc.SQLAlchemyError as error:
            raise LinkError(f"{self.where}: {why(error)}") from None

    def prepare(self) -> None:
        """Create missing tables, and parse stored items that an older companion could not parse.

        Raises:
            StorageError: the tables are of another version of the companion.
            LinkError: the database cannot be reached, or fails.
        """
        with self._link_errors():
            with self._engine.begin() as connection:
                schema.bring_up_to_date(connection)
            while self._take_in_again():
                pass

    def judge(self) -> bool:
        """Judge the sensors of one aircraft with new calibrations or undos; return False if there is no such aircraft.

        Raises:
            LinkError: the database cannot be reached, or fails.
        """
        table = schema.judgements
        with self._link_errors():
            with self._reads.begin() as connection:
                due = connection.execute(sa.select(table).where(table.c.judged < table.c.news).limit(1)).first()
                if due is None:
                    return False
                found = self._judged(connection, due.aircraft)
            is_it = table.c.aircraft == due.aircraft
            with self._engine.begin() as connection:
                # Write nothing if new items have arrived meanwhile.
                update = sa.update(table).where(is_it, table.c.news == due.news).values(judged=due.news)
                if connection.execute(update).rowcount and found is not None:
                    for of, rows in zip((schema.parts, schema.findings), found, strict=True):
                        connection.execute(sa.delete(of).where(of.c.aircraft == due.aircraft))
                        self._put(connection, of, rows)
        return True

    def _judged(self, connection: sa.Connection, aircraft: str) -> tuple[list[Row], list[Row]] | None:
        try:
            with np.errstate(all="ignore"):
                return judged(connection, aircraft)
        except (ArithmeticError, LookupError, ValueError):
            logger.error("fleet: %s cannot be judged; what was found before stands", aircraft, exc_info=True)
            return None

    def take(self, messages: Sequence[Incoming]) -> BatchResult:
        """Store a batch of messages in the database; refused messages go to the table `rejected` with their reasons.

        Raises:
            LinkError: the database cannot be reached, or fails; nothing of the batch may be confirmed.
        """
        now = datetime.datetime.now(tz=datetime.UTC)
        try:
            return self._take(messages, now)
        except OF_THE_DATABASE as error:
            raise LinkError(f"{self.where}: {why(error)}") from None
        except sa.exc.SQLAlchemyError as error:
            reason = _refusal(error)
        # To find the refused message, write each in its own transaction.
        if len(messages) == 1:
            return self._reject(messages[0], reason, now)
        found = BatchResult({}, {}, [])
        for message in messages:
            one = self.take([message])
            for key, sequences in one.confirmed.items():
                found.confirmed.setdefault(key, []).extend(sequences)
            found.wanted.update(one.wanted)
            found.rejected.extend(one.rejected)
        return found

    def _take(self, messages: Sequence[Incoming], now: datetime.datetime) -> BatchResult:
        outcome = BatchResult({}, {}, [])
        told: list[Row] = []
        rows: Rows = {}
        heard: set[str] = set()
        hellos: dict[tuple[str, str], tuple[Hello, bool]] = {}
        for message in messages:
            if (to := addressed(message.topic)) is None:
                continue
            try:
                if to[1] == "hello":
                    hello = read_hello(to[0], message.payload)
                    hellos[to[0], hello.epoch] = hello, message.retained
                    continue
                item = read_item(to[0], message.payload)
            except InvalidPayloadError as error:
                outcome.rejected.append((message, str(error)))
                continue
            outcome.confirmed.setdefault((item.aircraft, item.epoch), []).append(item.sequence)
            heard.add(item.aircraft)
            try:
                columns, made = rows_of(item)
            except InvalidPayloadError as error:
                outcome.rejected.append((message, str(error)))
                columns, made = _REJECTED, {}
            told.append({**item.key, **_raw(item, message), **columns, "received_at": now})
            for table, of in made.items():
                rows.setdefault(table, []).extend(of)
        with self._engine.begin() as connection:
            self._put(connection, schema.items, told)
            self._put_made(connection, rows)
            self._hear(connection, hellos.values(), heard, now)
            self._keep_aside(connection, outcome.rejected, now)
            if hellos:
                outcome.wanted.update(_lacking(connection, {aircraft for aircraft, _ in hellos}))
        return outcome

    def _put_made(self, connection: sa.Connection, made: Rows) -> None:
        for name, rows in sorted(made.items()):
            self._put(connection, schema.tables.tables[name], rows)
        table = schema.judgements
        which = {row["aircraft"] for name in ("calibrations", "undos") for row in made.get(name, ())}
        if which:
            insert, values = self._insert_many(
                table, [{"aircraft": one, "news": 1, "judged": 0} for one in sorted(which)]
            )
            news = {"news": table.c.news + 1}
            connection.execute(insert.on_conflict_do_update(index_elements=["aircraft"], set_=news), values)

    def _put(self, connection: sa.Connection, table: sa.Table, rows: list[Row]) -> None:
        if not rows:
            return
        keys = [column.name for column in table.primary_key]
        rows.sort(key=lambda row: [row[key] for key in keys])
        insert, values = self._insert_many(table, rows)
        connection.execute(insert.on_conflict_do_nothing(), values)

    def _insert_many(self, table: sa.Table, rows: list[Row]) -> tuple[Any, Any]:
        """Return one INSERT statement for all rows, and its values: as JSON for PostgreSQL, which is 3 times faster."""
        insert, names = self._insert(table), list(rows[0])
        if self._insert is sqlite.insert:
            return insert, rows
        text = msgspec.json.encode(rows).decode()
        if "\\u0000" in text:
            text = msgspec.json.encode([{name: _without_zero(row[name]) for name in row} for row in rows]).decode()
        like = sa.text(f"NULL::{table.name}")
        source = sa.func.json_populate_recordset(like, sa.bindparam("rows")).table_valued(*names)
        return insert.from_select(names, sa.select(source)), {"rows": text}

    def _hear(
        self,
        connection: sa.Connection,
        hellos: Iterable[tuple[Hello, bool]],
        heard: set[str],
        now: datetime.datetime,
    ) -> None:
        table = schema.aircraft
        nothing: Row = dict.fromkeys(table.c.keys())
        rows = {name: {**nothing, "aircraft": name, "heard_at": now} for name in heard}
        for hello, retained in hellos:
            row = rows.setdefault(hello.aircraft, {**nothing, "aircraft": hello.aircraft})
            row |= {"name": hello.name, "epoch": hello.epoch, "first": hello.first, "last": hello.last}
            with contextlib.suppress(InvalidPayloadError):
                row["hello_at"] = moment(hello.at)
            if not retained:  # a retained hello does not show that the aircraft is connected now
                row["heard_at"] = now
        if rows:
            insert, values = self._insert_many(table, [row for _, row in sorted(rows.items())])
            news = {name: sa.func.coalesce(insert.excluded[name], table.c[name]) for name in nothing}
            connection.execute(insert.on_conflict_do_update(index_elements=["aircraft"], set_=news), values)

    def _keep_aside(
        self, connection: sa.Connection, refused: Sequence[tuple[Incoming, str]], now: datetime.datetime
    ) -> None:
        table = schema.rejected
        rows: dict[str, tuple[Incoming, str]] = {}
        for message, reason in refused:
            digest = hashlib.sha256(message.topic.encode() + b"\0" + message.payload).hexdigest()[:32]
            rows[digest] = message, reason
        for digest, (message, reason) in sorted(rows.items()):
            insert = self._insert(table).values(
                digest=digest,
                times=1,
                last_at=now,
                topic=message.topic[:200],
                reason=reason[:600],
                payload=message.payload[:_SHOWN_BYTES],
            )
            news = {"times": table.c.times + 1, "last_at": now}
            connection.execute(insert.on_conflict_do_update(index_elements=["digest"], set_=news))
        if rows:
            beyond = sa.select(table.c.digest).order_by(table.c.last_at.desc()).offset(MOST_REJECTED)
            connection.execute(sa.delete(table).where(table.c.digest.in_(beyond)))

    def _reject(self, message: Incoming, reason: str, now: datetime.datetime) -> BatchResult:
        """Record a message that the database refuses; confirm it if it is an item, or it would be resent for ever."""
        outcome = BatchResult({}, {}, [(message, reason)])
        to = addressed(message.topic)
        item = None
        with contextlib.suppress(InvalidPayloadError):
            item = read_item(to[0], message.payload) if to is not None and to[1] == "item" else None
        with self._link_errors(), self._engine.begin() as connection:
            self._keep_aside(connection, outcome.rejected, now)
            if item is not None:
                raw = {**item.key, **_raw(item, message), **_REJECTED, "received_at": now}
                with contextlib.suppress(*OF_THE_ITEM), connection.begin_nested():
                    self._put(connection, schema.items, [raw])
                outcome.confirmed[item.aircraft, item.epoch] = [item.sequence]
        return outcome

    def _take_in_again(self) -> bool:
        """Parse stored items whose kind and format have become known by an update; return True if there may be more."""
        items, each, refused = schema.items, schema.items.c, []
        of_a_kind = each.kind.is_(None) | each.kind.in_(KINDS)
        known = sa.select(items).where(each.state == "unknown", each.format_version == FORMAT_VERSION, of_a_kind)
        with self._engine.begin() as connection:
            found = connection.execute(known.limit(_AGAIN)).all()
            for row in found:
                message = Incoming(f"fleet/{row.aircraft}/item", row.payload.encode())
                update = sa.update(items).where(*(column == getattr(row, column.name) for column in items.primary_key))
                try:
                    with connection.begin_nested():
                        columns, made = rows_of(read_item(row.aircraft, message.payload))
                        connection.execute(update.values(columns))
                        self._put_made(connection, made)
                except (InvalidPayloadError, *OF_THE_ITEM) as error:
                    connection.execute(update.values(_REJECTED))
                    reason = _refusal(error) if isinstance(error, sa.exc.SQLAlchemyError) else str(error)
                    refused.append((message, reason))
            self._keep_aside(connection, refused, datetime.datetime.now(tz=datetime.UTC))
        return len(found) == _AGAIN


def _refusal(error: sa.exc.SQLAlchemyError) -> str:
    return f"the database refuses it: {why(error)}"


def _raw(item: ReceivedItem, message: Incoming) -> Row:
    return {"format_version": item.format_version, "payload": message.payload.decode(errors="replace")}


def _lacking(connection: sa.Connection, which: Iterable[str]) -> dict[tuple[str, str], list[list[int]]]:
    """List the ranges of items that these aircraft store, by their last hello messages, but the database lacks."""
    one, items = schema.aircraft.c, schema.items.c
    of = one.aircraft.in_(sorted(which))
    before = sa.select(one.aircraft, one.epoch, one.last, (one.first - 1).label("number")).where(of)
    kept = [items.aircraft == one.aircraft, items.epoch == one.epoch, items.sequence.between(one.first, one.last)]
    there = sa.select(one.aircraft, one.epoch, one.last, items.sequence).where(of, *kept)
    all_of = sa.union_all(before, there).subquery()
    following = sa.func.lead(all_of.c.number, 1, all_of.c.last + 1).over(
        partition_by=all_of.c.aircraft, order_by=all_of.c.number
    )
    ends = sa.select(all_of.c.aircraft, all_of.c.epoch, all_of.c.number, following.label("next")).subquery()
    gaps = sa.select(ends).where(ends.c.next > ends.c.number + 1).order_by(ends.c.aircraft, ends.c.number)
    found: dict[tuple[str, str], list[list[int]]] = {}
    for aircraft, epoch, number, following_number in connection.execute(gaps):
        found.setdefault((aircraft, epoch), []).append([number + 1, following_number - 1])
    return found


def _without_zero(value: object) -> object:
    return value.replace("\0", "\ufffd") if isinstance(value, str) else value

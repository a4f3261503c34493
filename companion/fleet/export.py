"""A view or a table as a file for others' tools: CSV or Parquet, little of it in memory, there whole or not at all.

The same from both databases: times are UTC, numbers keep every digit, what is not known is empty or null.
"""

from __future__ import annotations

import contextlib
import csv
import datetime
import os
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import IO, Any, Final

import sqlalchemy as sa

from companion.errors import ConfigError, LinkError, StorageError
from companion.fleet import schema
from companion.fleet.database import engine_of, url_of, why
from companion.storage.state import sync_folder

ROWS: Final = 1000
"""That are fetched at a time."""
GROUP_BYTES: Final = 16 * 1024**2
"""Of a row group of Parquet."""
Rows = Iterator[Sequence[Sequence[Any]]]


def names() -> list[str]:
    """Of all that can be exported."""
    return sorted([*(view for view, _, _ in schema.views()), *schema.tables.tables])


def export(database: str, what: str, path: Path) -> int:
    """Write a view or a table to a file, by its ending; returns how many rows it has.

    Raises:
        ConfigError: there is no such view, or the ending is another one.
        StorageError: there is no such database, or the file cannot be written; there is none, or the former one.
        LinkError: the database cannot be read.
    """
    writers = {".csv": _csv, ".parquet": _parquet}
    if path.suffix not in writers:
        raise ConfigError(f"{path}: found the ending {path.suffix!r}; allowed: {', '.join(writers)}")
    if what not in names():
        raise ConfigError(f"found {what!r}; allowed: {', '.join(names())}")
    url = url_of(database)
    if url.drivername == "sqlite" and not Path(url.database or "").is_file():
        raise StorageError(f"{url.database}: no such file")
    engine = engine_of(database, reads_only=True)
    try:
        with engine.connect() as connection, _whole(path) as file:
            if engine.dialect.name == "postgresql":
                connection.exec_driver_sql(
                    "SET statement_timeout = 0"
                )  # a view of all that was ever told takes a while
            columns = _columns(connection, what)
            query = sa.select(*(sa.column(name, kind) for name, kind in columns.items())).select_from(sa.table(what))
            found = connection.execution_options(yield_per=ROWS).execute(query)
            return writers[path.suffix](file, columns, found.partitions())
    except sa.exc.NoSuchTableError:
        where = url.render_as_string()
        raise StorageError(f"{where}: has no {what} yet: no collector of this version has made it") from None
    except sa.exc.SQLAlchemyError as error:
        raise LinkError(f"{url.render_as_string()}: {why(error)}") from None
    finally:
        engine.dispose()


def _columns(connection: sa.Connection, what: str) -> dict[str, sa.types.TypeEngine[Any]]:
    """Columns with their types, which a view of SQLite does not tell: as in the tables, else by the first value."""
    tables = schema.tables.tables
    own = [tables[what]] if what in tables else tables.values()
    known = {column.name: column.type for table in own for column in table.columns}
    found: dict[str, Any] = {}
    for name in [each["name"] for each in sa.inspect(connection).get_columns(what)]:
        if name in known:
            found[name] = known[name]
        elif name.endswith("_at"):
            found[name] = schema.Moment()
        else:
            column: sa.ColumnClause[Any] = sa.column(name)
            first = sa.select(column).select_from(sa.table(what)).where(column.is_not(None)).limit(1)
            kinds = {int: sa.BigInteger, str: sa.Text}
            found[name] = kinds.get(type(connection.execute(first).scalar()), sa.Double)()
    return found


@contextlib.contextmanager
def _whole(path: Path) -> Iterator[IO[bytes]]:
    """A file that takes its place once all is in it and on the disk."""
    try:
        with tempfile.NamedTemporaryFile(prefix=f".{path.name}.", dir=path.parent, delete=False) as file:
            try:
                yield file
                file.flush()
                os.fsync(file.fileno())
                os.chmod(file.name, 0o644)
                os.replace(file.name, path)
            except BaseException:
                os.unlink(file.name)
                raise
        sync_folder(path.parent)
    except OSError as error:
        raise StorageError(f"{path}: cannot be written: {error.strerror or error}") from None


def _csv(file: IO[bytes], columns: dict[str, Any], parts: Rows) -> int:
    count = 0
    with open(os.dup(file.fileno()), "w", encoding="utf-8", newline="") as text:
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(columns)
        for rows in parts:
            writer.writerows([_plain(value) for value in row] for row in rows)
            count += len(rows)
    return count


def _plain(value: Any) -> Any:
    if isinstance(value, datetime.datetime):
        return value.astimezone(datetime.UTC).isoformat(timespec="microseconds").replace("+00:00", "Z")
    return value.hex() if isinstance(value, bytes) else value


def _parquet(file: IO[bytes], columns: dict[str, Any], parts: Rows) -> int:
    try:
        import pyarrow as pa
        from pyarrow import parquet
    except ImportError as error:
        how = "pip install '.[parquet]' in the folder of the companion's sources"
        raise ConfigError(f"Parquet needs more than is installed: {how} ({error})") from None
    kinds: dict[type[Any], Any] = {
        schema.Moment: pa.timestamp("us", "UTC"),
        sa.BigInteger: pa.int64(),
        sa.Integer: pa.int64(),
        sa.Double: pa.float64(),
        sa.LargeBinary: pa.binary(),
    }
    fields = pa.schema([(name, kinds.get(type(kind), pa.string())) for name, kind in columns.items()])
    count = 0
    group: list[Any] = []
    with parquet.ParquetWriter(file, fields, compression="zstd") as writer:
        for rows in parts:
            values = zip(*rows, strict=True)
            group.append(pa.record_batch([list(column) for column in values], schema=fields))
            count += len(rows)
            if sum(batch.nbytes for batch in group) >= GROUP_BYTES:
                writer.write_table(pa.Table.from_batches(group))
                group = []
        writer.write_table(pa.Table.from_batches(group, fields))
    return count

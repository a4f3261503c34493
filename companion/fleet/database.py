"""Connections to the database, PostgreSQL or SQLite, and their errors."""

from __future__ import annotations

from typing import Any, Final

import sqlalchemy as sa

from companion.errors import StorageError

_STATEMENT_MS: Final = 30_000
_BUSY_S: Final = 10.0
OF_THE_DATABASE: Final = (sa.exc.OperationalError, sa.exc.InterfaceError, sa.exc.InternalError, sa.exc.TimeoutError)
"""Errors of a database that cannot be reached, is full or broken."""
OF_THE_ITEM: Final = (sa.exc.DataError, sa.exc.IntegrityError, sa.exc.ProgrammingError)
"""Errors of a row that the database refuses."""


def url_of(database: str) -> sa.URL:
    """Parse postgresql://..., sqlite:///... or the path of a file.

    Raises:
        StorageError: it is none of these.
    """
    try:
        url = sa.make_url(database if "://" in database else f"sqlite:///{database}")
    except sa.exc.ArgumentError:
        url = sa.URL.create("none")
    if url.drivername in ("postgresql", "postgres"):
        url = url.set(drivername="postgresql+psycopg")
    if url.drivername not in ("sqlite", "postgresql+psycopg") or (url.drivername == "sqlite" and not url.database):
        raise StorageError(
            f"database: found {database.partition('@')[2] or database!r}; allowed: postgresql://USER@HOST/NAME,"
            " or the path of an SQLite file"
        )
    return url


def engine_of(database: str, *, reads_only: bool = False) -> sa.Engine:
    """Make an engine without opening a connection.

    Raises:
        StorageError: the address cannot be parsed.
    """
    url = url_of(database)
    if url.drivername == "sqlite":
        engine = sa.create_engine(url, connect_args={"timeout": _BUSY_S})
        sa.event.listen(engine, "connect", _prepare_sqlite)
        sa.event.listen(engine, "begin", _begin_reading if reads_only else _begin_writing)
        return engine
    return sa.create_engine(
        url,
        # Notice the death of the server's host within seconds, before TCP does.
        connect_args={
            "connect_timeout": 5,
            "tcp_user_timeout": 10_000,
            "options": f"-c statement_timeout={_STATEMENT_MS} -c timezone=UTC"
            + " -c default_transaction_read_only=on" * reads_only,
        },
    )


def _begin_reading(connection: sa.Connection) -> None:
    connection.exec_driver_sql("BEGIN")


def _begin_writing(connection: sa.Connection) -> None:
    # SQLite refuses the first write of a transaction that began with a read when another has written meanwhile.
    connection.exec_driver_sql("BEGIN IMMEDIATE")


def _prepare_sqlite(connection: Any, _record: object) -> None:
    connection.isolation_level = None  # `_begin_...` starts transactions
    connection.execute("PRAGMA journal_mode=WAL")
    # A confirmed item must survive a power cut.
    connection.execute("PRAGMA synchronous=FULL")


def why(error: sa.exc.SQLAlchemyError) -> str:
    """Give the database's own message in one line."""
    cause = getattr(error, "orig", None) or error
    return " ".join(str(cause).split())[:300] or type(cause).__name__

"""Connections to the database, PostgreSQL or SQLite, and what may go wrong there."""

from __future__ import annotations

from typing import Any, Final

import sqlalchemy as sa

from companion.errors import StorageError

_STATEMENT_MS: Final = 30_000
_BUSY_S: Final = 10.0
OF_THE_DATABASE: Final = (sa.exc.OperationalError, sa.exc.InterfaceError, sa.exc.InternalError, sa.exc.TimeoutError)
"""It is not there, full, or broken: no fault of what was to be written."""
OF_THE_ITEM: Final = (sa.exc.DataError, sa.exc.IntegrityError, sa.exc.ProgrammingError)
"""The database is well, and does not take it."""


def url_of(database: str) -> sa.URL:
    """The database that people mean: postgresql://..., sqlite:///..., or a file's path.

    Raises:
        StorageError: it is neither.
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
    """Connections to the database, none of which is opened yet.

    Raises:
        StorageError: the address cannot be read.
    """
    url = url_of(database)
    if url.drivername == "sqlite":
        engine = sa.create_engine(url, connect_args={"timeout": _BUSY_S})
        sa.event.listen(engine, "connect", _prepare_sqlite)
        sa.event.listen(engine, "begin", _begin_reading if reads_only else _begin_writing)
        return engine
    return sa.create_engine(
        url,
        # A server whose host has died is noticed within seconds, not when TCP gives up.
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
    # One that began by reading and then wrote would be refused where another has written meanwhile.
    connection.exec_driver_sql("BEGIN IMMEDIATE")


def _prepare_sqlite(connection: Any, _record: object) -> None:
    connection.isolation_level = None  # transactions begin where we say so
    connection.execute("PRAGMA journal_mode=WAL")
    # What was confirmed outlives a power cut.
    connection.execute("PRAGMA synchronous=FULL")


def why(error: sa.exc.SQLAlchemyError) -> str:
    """The database's own words, in one line."""
    cause = getattr(error, "orig", None) or error
    return " ".join(str(cause).split())[:300] or type(cause).__name__

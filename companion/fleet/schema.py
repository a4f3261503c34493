"""Database of the collector, PostgreSQL or SQLite: its schema, connections and errors.

The table `items` has the received payloads. All other tables are derived from it and can be rebuilt. Axes are the
vehicle's FRD. Times are UTC by the aircraft's clock, which may be wrong. Only `heard_at`, `received_at` and `last_at`
are by the collector's clock.
"""

from __future__ import annotations

import datetime
import re
from pathlib import Path
from typing import Any, Final

import sqlalchemy as sa

from companion.errors import StorageError

VERSION: Final = 4
_LOCK: Final = 0x636F6D70616E696F
"""Key of the PostgreSQL advisory lock that a collector holds while it checks the schema and creates tables."""
_STATEMENT_MS: Final = 30_000
_BUSY_S: Final = 10.0
OF_THE_DATABASE: Final = (sa.exc.OperationalError, sa.exc.InterfaceError, sa.exc.InternalError, sa.exc.TimeoutError)
"""SQLAlchemy errors due to the database itself: it is unreachable, full or broken."""
OF_THE_ITEM: Final = (sa.exc.DataError, sa.exc.IntegrityError, sa.exc.ProgrammingError)


class UtcTime(sa.types.TypeDecorator[datetime.datetime]):
    """Column type for a time in UTC. In Python it always has a time zone, although SQLite stores text without one."""

    impl = sa.DateTime(timezone=True)
    cache_ok = True

    def process_bind_param(self, value: datetime.datetime | None, dialect: sa.Dialect) -> datetime.datetime | None:
        return value if value is None or dialect.name != "sqlite" else value.astimezone(datetime.UTC)

    def process_result_value(self, value: Any, dialect: sa.Dialect) -> datetime.datetime | None:
        found: datetime.datetime | None = value
        return found if found is None or found.tzinfo is not None else found.replace(tzinfo=datetime.UTC)


class Words(sa.types.TypeDecorator[str]):
    """Column type for text; NUL characters, which PostgreSQL refuses, are replaced by U+FFFD."""

    impl = sa.Text
    cache_ok = True

    def process_bind_param(self, value: str | None, dialect: sa.Dialect) -> str | None:
        return value if value is None else value.replace("\0", "\ufffd")


tables: Final = sa.MetaData()


def _key() -> list[sa.Column[Any]]:
    return [
        sa.Column("aircraft", sa.String(36), primary_key=True),
        sa.Column("epoch", sa.String(16), primary_key=True),
        sa.Column("sequence", sa.BigInteger, primary_key=True, autoincrement=False),
    ]


items: Final = sa.Table(
    "items",
    tables,
    *_key(),
    sa.Column("format_version", sa.BigInteger, nullable=False),
    sa.Column("kind", Words, comment="null: of a newer format"),
    sa.Column("at", UtcTime),
    sa.Column("clock", Words, comment="whether at can be believed: good, unknown"),
    sa.Column("received_at", UtcTime, nullable=False, comment="by the collector's clock"),
    sa.Column("state", sa.String(8), nullable=False, comment="taken; unknown: of a newer aircraft; rejected"),
    sa.Column("same", sa.String(32), comment="equal where one thing was told again under another epoch"),
    sa.Column("payload", Words, nullable=False, comment="JSON, as it came"),
)
sa.Index("items_same", items.c.aircraft, items.c.same)
sa.Index("items_state", items.c.state, sqlite_where=items.c.state != "taken", postgresql_where=items.c.state != "taken")

aircraft: Final = sa.Table(
    "aircraft",
    tables,
    sa.Column("aircraft", sa.String(36), primary_key=True, comment="the autopilot's unique id"),
    sa.Column("name", Words),
    sa.Column("epoch", sa.String(16), comment="of its last hello, as the next three"),
    sa.Column("first", sa.BigInteger),
    sa.Column("last", sa.BigInteger),
    sa.Column("hello_at", UtcTime),
    sa.Column("heard_at", UtcTime, comment="by the collector's clock"),
)

calibrations: Final = sa.Table(
    "calibrations",
    tables,
    *_key(),
    sa.Column("started_at", UtcTime, nullable=False),
    sa.Column("duration_s", sa.Double, nullable=False),
    sa.Column("state", sa.String(16), nullable=False, comment="done, failed, cancelled"),
    sa.Column("reason", Words, nullable=False),
    sa.Column("held_back", Words, nullable=False, comment="measured and not written, contradicting earlier ones"),
    sa.Column("undone_at", UtcTime, comment="undone when it was told; later ones are in undos"),
    sa.Column("firmware", sa.String(16), comment="ardupilot, px4; null: nothing was written"),
    sa.Column("heading_bound_deg", sa.Double, comment="the heading's error exceeds it in one case of twenty"),
    sa.Column("zero_at", UtcTime, comment="of the gradienter's alignment in force, as the next three"),
    sa.Column("zero_x_deg", sa.Double),
    sa.Column("zero_y_deg", sa.Double),
    sa.Column("zero_sigma_deg", sa.Double),
)
sa.Index("calibrations_started_at", calibrations.c.aircraft, calibrations.c.started_at)

biases: Final = sa.Table(
    "biases",
    tables,
    *_key(),
    sa.Column("imu", sa.String(64), primary_key=True),
    sa.Column("axis", sa.String(1), primary_key=True, comment="x forward, y right, z down"),
    sa.Column("gyro_id", sa.BigInteger, comment="device id in the autopilot"),
    sa.Column("accel_id", sa.BigInteger),
    sa.Column("temperature_degc", sa.Double),
    sa.Column("gyro_bias_rad_s", sa.Double),
    sa.Column("gyro_sigma_stat_rad_s", sa.Double, comment="of the mean over the window"),
    sa.Column("gyro_sigma_use_rad_s", sa.Double, comment="of the bias over the next minutes"),
    sa.Column("accel_bias_m_s2", sa.Double),
    sa.Column("accel_sigma_stat_m_s2", sa.Double),
    sa.Column("accel_sigma_use_m_s2", sa.Double),
    sa.Column("samples", sa.BigInteger),
    sa.Column("gyro_read_rad_s", sa.Double, comment="before earlier ones were weighed in; null: none were"),
    sa.Column("accel_read_m_s2", sa.Double),
)

armings: Final = sa.Table(
    "armings",
    tables,
    *_key(),
    sa.Column("armed_at", UtcTime, nullable=False),
    sa.Column("state", sa.String(16), nullable=False, comment="calibrated, checked, uncalibrated"),
    sa.Column("reason", Words, nullable=False),
    sa.Column("calibration_at", UtcTime, comment="started_at of the calibration in force"),
    sa.Column("gyro_sigma_use_rad_s", sa.Double, comment="the largest of all axes in force"),
    sa.Column("accel_sigma_use_m_s2", sa.Double),
)
sa.Index("armings_armed_at", armings.c.aircraft, armings.c.armed_at)

undos: Final = sa.Table(
    "undos",
    tables,
    *_key(),
    sa.Column("what", Words, nullable=False),
    sa.Column("of_at", UtcTime, nullable=False, comment="started_at or measured_at of what was put back"),
    sa.Column("undone_at", UtcTime, nullable=False),
)

alignments: Final = sa.Table(
    "alignments",
    tables,
    *_key(),
    sa.Column("what", Words, nullable=False),
    sa.Column("state", sa.String(16), nullable=False),
    sa.Column("measured_at", UtcTime, nullable=False),
    sa.Column("reason", Words, nullable=False),
)

events: Final = sa.Table(
    "events",
    tables,
    *_key(),
    sa.Column("at", UtcTime),
    sa.Column("what", Words, nullable=False, comment="imu exchanged, airframe changed, lost"),
    sa.Column("body", Words, nullable=False, comment="JSON"),
)

flights: Final = sa.Table(
    "flights",
    tables,
    *_key(),
    sa.Column("instance", sa.BigInteger, primary_key=True, autoincrement=False, comment="of the IMU in the autopilot"),
    sa.Column("triad", sa.String(16), primary_key=True, comment="gyro, accel"),
    sa.Column("axis", sa.String(1), primary_key=True),
    sa.Column("flight", Words, nullable=False, comment="the same from whichever log it was read"),
    sa.Column("began_at", UtcTime),
    sa.Column("gyro_id", sa.BigInteger),
    sa.Column("accel_id", sa.BigInteger),
    sa.Column("calibration_at", UtcTime, comment="started_at of the calibration whose offsets it flew with"),
    sa.Column("drift_s", sa.Double, comment="a time of free inertial navigation"),
    sa.Column("drift_m", sa.Double, comment="how far it is off by then, median"),
    sa.Column(
        "in_flight", sa.Double, comment="mean in the air, over what the offsets left; rad/s or m/s^2, as the next"
    ),
    sa.Column("in_flight_sigma", sa.Double),
    sa.Column("turn_on", sa.Double, comment="before the motors"),
    sa.Column("turn_on_sigma", sa.Double),
    sa.Column("motors", sa.Double, comment="the step at their start"),
    sa.Column("motors_sigma", sa.Double),
)

judgements: Final = sa.Table(
    "judgements",
    tables,
    sa.Column("aircraft", sa.String(36), primary_key=True),
    sa.Column("news", sa.BigInteger, nullable=False, comment="batches with calibrations or undos of it"),
    sa.Column("judged", sa.BigInteger, nullable=False, comment="how many they were when it was last judged"),
)

parts: Final = sa.Table(
    "parts",
    tables,
    sa.Column("aircraft", sa.String(36), primary_key=True),
    sa.Column("imu", sa.String(64), primary_key=True),
    sa.Column("triad", sa.String(8), primary_key=True, comment="gyro, accel"),
    sa.Column("axis", sa.String(1), primary_key=True),
    sa.Column("model", Words, comment="by its device ids; null: not known"),
    sa.Column("power_ups", sa.BigInteger, nullable=False),
    sa.Column("turn_on", sa.Double, comment="its scatter from power-up to power-up, rad/s or m/s^2; null: too few"),
    sa.Column("wander", sa.Double, comment="likewise the step that stays, from one to the next"),
)
sa.Index("parts_model", parts.c.model)

findings: Final = sa.Table(
    "findings",
    tables,
    sa.Column("aircraft", sa.String(36), primary_key=True),
    sa.Column("place", sa.BigInteger, primary_key=True, autoincrement=False, comment="0: the worst"),
    sa.Column("kind", sa.String(16), nullable=False, comment="bias, drift, scatter, noise, zero, compass"),
    sa.Column("imu", sa.String(64)),
    sa.Column("since", UtcTime, comment="by the aircraft's clock"),
    sa.Column("power_ups", sa.BigInteger, nullable=False, comment="since then"),
    sa.Column("size", sa.Double, nullable=False, comment="in what is usual: the worst of them are the largest"),
    sa.Column("words", Words, nullable=False),
)

rejected: Final = sa.Table(
    "rejected",
    tables,
    sa.Column("digest", sa.String(32), primary_key=True, comment="of topic and payload"),
    sa.Column("times", sa.BigInteger, nullable=False),
    sa.Column("last_at", UtcTime, nullable=False, comment="by the collector's clock"),
    sa.Column("topic", Words, nullable=False),
    sa.Column("reason", Words, nullable=False),
    sa.Column("payload", sa.LargeBinary, nullable=False, comment="its first 4 KiB"),
)
sa.Index("rejected_last_at", rejected.c.last_at)

_version: Final = sa.Table("schema_version", tables, sa.Column("version", sa.Integer, nullable=False))

_VIEW: Final = re.compile(r"-- (\w+): (.*)\n([^;]+);")
_VIEWS: Final = Path(__file__).with_name("views.sql")


def bring_up_to_date(connection: sa.Connection) -> None:
    """Create missing tables and views in the connection's transaction, under a lock that other collectors respect.

    Raises:
        StorageError: the tables are of another version.
    """
    if connection.dialect.name == "postgresql":
        connection.execute(sa.select(sa.func.pg_advisory_xact_lock(_LOCK)))
        connection.exec_driver_sql("SET LOCAL statement_timeout = 0")  # large tables need long
    inspector = sa.inspect(connection)
    found = connection.execute(sa.select(_version)).scalar_one() if inspector.has_table(_version.name) else None
    if found not in (None, VERSION):
        remedy = "a newer companion has made them: update this one"
        if found < VERSION:
            remedy = "name a new database with --database: aircraft send again what they still keep"
        raise StorageError(f"the database has tables of version {found}; allowed: {VERSION}; {remedy}")
    if found is not None and {view for view, _, _ in views()} <= {*inspector.get_view_names()}:
        return
    for view, _, _ in reversed(views()):
        connection.exec_driver_sql(f"DROP VIEW IF EXISTS {view}")
    if found is None:
        tables.create_all(connection)
        connection.execute(sa.insert(_version).values(version=VERSION))
    for view, purpose, query in views():
        connection.exec_driver_sql(f"CREATE VIEW {view} AS /* {purpose} */ {query}")
        if connection.dialect.name == "postgresql":  # it drops comments in a view's query
            connection.exec_driver_sql(f"COMMENT ON VIEW {view} IS '{purpose}'")


def views() -> list[tuple[str, str, str]]:
    """List name, purpose and SQL query of each database view; a view comes after the views that it uses."""
    return _VIEW.findall(_VIEWS.read_text(encoding="utf-8"))


def url_of(database: str) -> sa.URL:
    """Parse a database address: postgresql://..., sqlite:///... or the path of an SQLite file.

    Raises:
        StorageError: the text is none of these.
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
    """Make the SQLAlchemy engine of a database, without opening a connection.

    Raises:
        StorageError: the address cannot be parsed.
    """
    url = url_of(database)
    if url.drivername == "sqlite":
        engine = sa.create_engine(url, connect_args={"timeout": _BUSY_S})
        sa.event.listen(engine, "connect", _prepare_sqlite)
        # In SQLite a transaction that began with a read cannot write after another one has written.
        begin = "BEGIN" if reads_only else "BEGIN IMMEDIATE"
        sa.event.listen(engine, "begin", lambda connection: connection.exec_driver_sql(begin))
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


def _prepare_sqlite(connection: Any, _record: object) -> None:
    connection.isolation_level = None  # the listener to "begin" starts transactions
    connection.execute("PRAGMA journal_mode=WAL")
    # A confirmed item must survive a power cut.
    connection.execute("PRAGMA synchronous=FULL")


def why(error: sa.exc.SQLAlchemyError) -> str:
    cause = getattr(error, "orig", None) or error
    return " ".join(str(cause).split())[:300] or type(cause).__name__

"""HTML pages of the whole fleet and of one aircraft, from the database views in fleet/views.sql."""

from __future__ import annotations

import datetime
from collections.abc import Sequence
from typing import Any, Final

import sqlalchemy as sa

from companion.fleet.schema import UtcTime, findings, rejected
from companion.fleet.schema import aircraft as known
from companion.physics.units import UNITS
from companion.report.markup import Child, Markup, row, tag
from companion.report.page import NAMES, PlotPoint, arming_items, card, drift, page, seconds_of, with_sigma
from companion.samples import TRIADS, Triad, Vector

STALE: Final = datetime.timedelta(days=30)
SILENT: Final = datetime.timedelta(days=7)
MOST_AIRCRAFT: Final = 500
"""Most aircraft listed on the fleet's page, which then has some 90 kB; the database views list all."""
MOST_CALIBRATIONS: Final = 120
MOST_LISTED: Final = 25
MOST_REFUSED: Final = 5
MOST_FINDINGS: Final = 8


_CLASSES: Final = {"alarm": "bad", "caution": "warn", "fine": "ok"}
SOURCE: Final = "from the fleet's database"
_STANDINGS: Final = (
    ("alarm", "not calibrated", "calibrated_at IS NULL"),
    ("alarm", "not written", "held_back <> ''"),
    ("caution", "stale", "calibrated_at < :stale"),
    ("caution", "armed uncalibrated", "armed_state = 'uncalibrated' AND armed_at > calibrated_at"),
    ("caution", "last try failed", "tried_state IN ('failed', 'cancelled') AND tried_reason <> ''"),
    ("caution", "suspect", "EXISTS (SELECT 1 FROM findings w WHERE w.aircraft = f.aircraft)"),
    ("fine", "calibrated", "1 = 1"),
)
"""Kind, name and SQL condition of each calibration status, worst first: the first condition that is true counts."""
_CASES: Final = " ".join(f"WHEN {holds} THEN {place}" for place, (_, _, holds) in enumerate(_STANDINGS))
_FLEET: Final = (
    f"SELECT f.*, CASE {_CASES} END AS standing,"  # noqa: S608 - constants
    " CASE WHEN heard_at IS NULL OR heard_at < :silent THEN 1 ELSE 0 END AS silent,"
    " CASE WHEN tried_at IS NULL THEN 1 ELSE 0 END AS untold FROM fleet f"
)
_ORDERED: Final = (
    f"SELECT s.* FROM ({_FLEET}) s LEFT JOIN findings w ON w.aircraft = s.aircraft AND w.place = 0"  # noqa: S608 - constants
    " ORDER BY w.size DESC NULLS LAST, s.untold, s.standing, s.heard_at DESC NULLS LAST, s.aircraft"
    " LIMIT :most"
)
"""SQL query that selects the aircraft to list. Ids without a calibration come last: anybody may have invented them."""


def standing(one: Any) -> tuple[str, str, str]:
    kind, word, _ = _STANDINGS[one.standing]
    why = one.tried_reason if one.tried_state in ("failed", "cancelled") else ""
    if word == "not calibrated":
        why = why or "no calibration is active"
    elif word == "not written":
        why = f"disagrees with history: {one.held_back}"
    elif word == "armed uncalibrated":
        why = one.armed_reason
    elif word == "suspect":
        why = "calibrated; see the findings"
    return kind, word, why


def glance(connection: sa.Connection, now: datetime.datetime) -> str:
    since = {"stale": now - STALE, "silent": now - SILENT}
    counted = f"SELECT standing, COUNT(*) AS number, SUM(silent) AS silent FROM ({_FLEET}) s GROUP BY standing"  # noqa: S608 - constants
    groups = _rows(connection, f"{counted} ORDER BY standing", **since)
    known_in_all = sum(group.number for group in groups)
    left_out = known_in_all > MOST_AIRCRAFT
    found = _rows(connection, _ORDERED, **since, most=MOST_AIRCRAFT)
    found = sorted(found, key=lambda one: (one.standing, one.name or one.aircraft))
    silent = sum(group.silent for group in groups)
    words = [f"{group.number} {_STANDINGS[group.standing][1]}" for group in groups]
    words += [f"{silent} silent for a week"] * (silent > 0)
    head = tag("tr", *(tag("th", words) for words in ("Aircraft", "Calibration", "Seen")))
    return page(
        "Fleet",
        now,
        tag("h1", "Fleet"),
        tag(
            "p",
            f"{known_in_all} aircraft: {', '.join(words)}" if found else "No aircraft was heard yet.",
            class_="lead",
        ),
        _findings(connection),
        tag("table", head, *(_line(one, now) for one in found), class_="fleet") if found else None,
        tag("p", f"The {MOST_AIRCRAFT} with findings, worst and latest heard are listed.") if left_out else None,
        _refused(connection, now),
        source=SOURCE,
    )


def _line(one: Any, now: datetime.datetime) -> Markup:
    kind, word, why = standing(one)
    calibrated = "" if one.calibrated_at is None else _ago(one.calibrated_at, now)
    return row(
        tag("td", tag("a", one.name or one.aircraft, href=f"/aircraft/{one.aircraft}"), _small(why)),
        tag("td", word, _small(calibrated), class_=_CLASSES[kind]),
        tag("td", _ago(one.heard_at, now), class_="warn" if one.silent else None),
    )


def aircraft(connection: sa.Connection, which: str, now: datetime.datetime) -> str | None:
    """Render the HTML page of one aircraft; return None if the aircraft is unknown."""
    query = f"SELECT * FROM ({_FLEET}) s WHERE aircraft = :which"  # noqa: S608 - constants
    found = _rows(connection, query, which=which, stale=now - STALE, silent=now - SILENT)
    if not found:
        return None
    one = found[0]
    kind, word, why = standing(one)
    name = one.name or one.aircraft
    calibrated = "" if one.calibrated_at is None else f", by the calibration of {_moment(one.calibrated_at)}"
    parts: list[Child] = [
        tag("p", tag("a", "Fleet", href="/")),
        tag("h1", name),
        card(
            kind,
            tag("p", f"{word.capitalize()}{calibrated}", class_="lead"),
            tag("p", why) if why else None,
            tag("p", f"Heard {_ago(one.heard_at, now)}." if one.heard_at else "Not heard by this collector yet."),
        ),
        _findings(connection, which),
        tag("p", "Autopilot ", tag("span", one.aircraft, class_="mono"), class_="soft"),
    ]
    parts += _imus(connection, which)
    parts += _armings(connection, which)
    parts += _notes(connection, which)
    return page(name, now, *parts, source=SOURCE)


def _findings(connection: sa.Connection, which: str | None = None) -> Markup | None:
    each, one = findings.c, sa.join(findings, known, findings.c.aircraft == known.c.aircraft)
    query = sa.select(each.aircraft, known.c.name, each.words, sa.func.count().over().label("all")).select_from(one)
    query = query.where(each.place == 0 if which is None else each.aircraft == which)
    found = connection.execute(query.order_by(each.size.desc(), each.aircraft).limit(MOST_FINDINGS)).all()
    if not found:
        return None
    lines = [
        tag("li", row.words)
        if which is not None
        else tag("li", tag("a", row.name or row.aircraft, href=f"/aircraft/{row.aircraft}"), f": {row.words}")
        for row in found
    ]
    more = found[0].all - len(found)
    return card("caution", tag("ul", *lines), tag("p", f"and {more} more", class_="soft") if more else None)


def _imus(connection: sa.Connection, which: str) -> list[Child]:
    query = "SELECT * FROM bias_history WHERE aircraft = :which ORDER BY started_at DESC, imu, axis LIMIT :most"
    by_imu: dict[str, dict[tuple[str, int], dict[str, Any]]] = {}
    for each in _rows(connection, query, which=which, most=MOST_CALIBRATIONS * 3 * 4):
        by_imu.setdefault(each.imu, {}).setdefault((each.epoch, each.sequence), {})[each.axis] = each
    parts: list[Child] = []
    for imu, found in sorted(by_imu.items()):
        latest = [axes for axes in found.values() if len(axes) == 3][:MOST_CALIBRATIONS][::-1]
        newest = next(iter(next(iter(found.values())).values()))
        named = (("gyro", newest.gyro_id), ("accelerometer", newest.accel_id))
        ids = [f"{what} {value}" for what, value in named if value]
        parts.append(tag("h2", f"IMU {imu}"))
        parts.append(tag("p", f"Device ids: {', '.join(ids)}", class_="soft") if ids else None)
        for triad in TRIADS:
            unit, unit_name, _ = UNITS[triad]
            points = [
                PlotPoint(
                    axes["x"].sequence, seconds_of(axes["x"].started_at), _scaled(bias, unit), _scaled(sigma, unit)
                )
                for axes in latest
                if (bias := _triad(axes, triad, "bias")) and (sigma := _triad(axes, triad, "sigma_use"))
            ]
            if not points:
                continue
            pairs = (with_sigma(points[-1].bias[k], points[-1].sigma_use[k], unit) for k in range(3))
            cells = [tag("td", value, " ± ", sigma) for value, sigma in pairs]
            parts += [
                tag("h3", f"{NAMES[triad]}, {unit_name}"),
                tag("table", row(*(tag("th", axis) for axis in "xyz")), row(*cells)),
                drift(points, triad, name=f"{imu} {triad}"),
            ]
    return parts


def _triad(axes: dict[str, Any], triad: Triad, what: str) -> Vector | None:
    """Return the bias or sigma of a gyro (deg/h) or accelerometer (mg), x y z; None if it is unknown for any axis."""
    column = f"{triad}_{what}_{UNITS[triad].name.replace('/', '_')}"
    x, y, z = (getattr(axes[axis], column) for axis in "xyz")
    return None if None in (x, y, z) else (x, y, z)


def _scaled(figures: Vector, unit: float) -> Vector:
    return figures[0] * unit, figures[1] * unit, figures[2] * unit


def _armings(connection: sa.Connection, which: str) -> list[Child]:
    query = "SELECT * FROM arming_history WHERE aircraft = :which ORDER BY armed_at DESC LIMIT :most"
    found = [
        (each.armed_at.isoformat(), each.state, each.reason or each.state)
        for each in _rows(connection, query, which=which, most=MOST_LISTED)
    ]
    return [tag("h2", "Armings"), arming_items(found)] if found else []


def _notes(connection: sa.Connection, which: str) -> list[Child]:
    query = """
        SELECT started_at AS at, 'calibration ' || state AS what, reason AS more FROM calibrations
        WHERE aircraft = :which AND state <> 'done'
        UNION SELECT undone_at, what || ' put back', '' FROM undos WHERE aircraft = :which
        UNION SELECT at, what, body FROM events WHERE aircraft = :which
        UNION SELECT began_at, 'flight, ' || CAST(MAX(drift_s) AS BIGINT) || ' s without GNSS',
                     'off by ' || ROUND(CAST(MAX(drift_m) AS NUMERIC), 1) || ' m'
              FROM flight_history WHERE aircraft = :which AND drift_m IS NOT NULL GROUP BY flight, began_at
        ORDER BY at DESC NULLS LAST LIMIT :most"""
    found = _rows(connection, query, which=which, most=MOST_LISTED)
    notes = [
        tag("li", tag("strong", f"{_moment(each.at)}: "), each.what, f": {each.more}" if each.more else None)
        for each in found
    ]
    return [tag("h2", "Notes"), tag("ul", *notes)] if notes else []


def _refused(connection: sa.Connection, now: datetime.datetime) -> Markup | None:
    """Render the latest rejected payloads by topic; the broker's access list lets one aircraft publish to a topic."""
    last = sa.select(rejected).order_by(rejected.c.last_at.desc()).limit(MOST_REFUSED).subquery()
    of = last.c.topic.startswith("fleet/" + known.c.aircraft + "/")
    query = sa.select(last, known.c.name).outerjoin_from(last, known, of).order_by(last.c.last_at.desc())
    lines = [
        tag(
            "li",
            tag("strong", f"{each.name or each.topic}: "),
            f"{each.reason} ({each.times} times, last {_ago(each.last_at, now)})",
        )
        for each in connection.execute(query)
    ]
    if not lines:
        return None
    more = tag("p", "By whose topic it came on. The table rejected has them all.", class_="soft")
    return card("caution", tag("p", "Not everything could be taken:"), tag("ul", *lines), more)


_TIMES: Final = dict.fromkeys(("heard_at", "calibrated_at", "tried_at", "armed_at", "started_at", "at"), UtcTime())


def _rows(connection: sa.Connection, query: str, **values: Any) -> Sequence[Any]:
    """Run an SQL query; return times as datetimes, even if the database stores them as text."""
    times = [
        sa.bindparam(name, type_=UtcTime()) for name, value in values.items() if isinstance(value, datetime.datetime)
    ]
    return connection.execute(sa.text(query).bindparams(*times).columns(**_TIMES), values).all()


def _moment(at: datetime.datetime | None) -> str:
    return "?" if at is None else f"{at:%Y-%m-%d %H:%M} UTC"


def _ago(at: datetime.datetime | None, now: datetime.datetime) -> str:
    """Format how long ago a time was, rounded. Show a future time in full, because some clock is wrong."""
    if at is None:
        return "never"
    ago_s = (now - at).total_seconds()
    if ago_s < -120.0:
        return _moment(at)
    for least_s, unit in ((86400.0, "d"), (3600.0, "h"), (60.0, "min")):
        if ago_s >= least_s:
            return f"{ago_s / least_s:.0f} {unit} ago"
    return "now"


def _small(words: str) -> Markup | None:
    return tag("small", words) if words else None

"""Judgement of an aircraft: from the rows of its calibrations to rows of `parts` and `findings`.

Every collector gets the same result, however often it judges: all calibrations are the input, never an earlier
judgement.
"""

from __future__ import annotations

import datetime
from collections.abc import Sequence
from itertools import pairwise
from typing import Any, Final, NamedTuple

import numpy as np
import sqlalchemy as sa

from companion.fleet import schema
from companion.fleet.contract import Row
from companion.fleet.judgement import Finding, History, judge, judge_compass, judge_zero
from companion.fleet.models import Scatter, scatter_of_model, scatter_of_part
from companion.fleet.schema import Moment
from companion.physics.frames import Floats
from companion.physics.units import DEG, MG, G

MOST_CALIBRATIONS: Final = 2000
"""Most calibrations of an aircraft, the latest ones: five years of one a day."""
SAME_POWER_UP: Final = datetime.timedelta(minutes=30)
"""Most time between two calibrations that agree and count as one power-up."""
MOST_DEGC: Final = 150.0
"""Limit of a believable temperature, to catch kelvins that were not turned into degrees."""
_AGREE_SIGMAS: Final = 5.0
MOST_PARTS: Final = 300
"""Parts of one model that are compared."""
_TOGETHER: Final = 10
"""Most power-ups between moves of accelerometers that count as one move of the gradienter."""
REPLACE: Final = {"scatter": 3.0, "noise": 2.0, "drift": 8.0, "bias": 8.0}
"""Least sizes of findings, by kind, for the word "replace"."""


Part = tuple[str, str]
"""Aircraft and name of the IMU there."""


class Judged(NamedTuple):
    """Rows of one aircraft, by table."""

    parts: list[Row]
    findings: list[Row]


class _Calibration(NamedTuple):
    at: datetime.datetime
    about: Any
    """Row of `calibrations`."""
    axes: list[Any]
    """Rows of `biases` of one IMU: x, y, z."""

    def figures(self, name: str) -> list[float]:
        """Give a figure of gyro x y z, accelerometer x y z."""
        names = (f"gyro_{name}_rad_s", f"accel_{name}_m_s2")
        return [np.nan if (value := getattr(row, each)) is None else value for each in names for row in self.axes]


def judged(connection: sa.Connection, aircraft: str) -> Judged:
    """Judge an aircraft by all calibrations in the database."""
    done = _done(connection, aircraft)
    imus: dict[str, list[_Calibration]] = {}
    for key, rows in _biases(connection, aircraft).items():
        if key[:2] in done and len(rows) == 3:
            about = done[key[:2]]
            imus.setdefault(key[2], []).append(_Calibration(about.started_at, about, rows))
    # The import is heavy, and most of the collector does without.
    from companion.autopilot.firmware.firmwares import model_of

    firmware = next((row.firmware for row in reversed(done.values()) if row.firmware), None)
    parts: list[Row] = []
    found: list[tuple[str | None, Sequence[datetime.datetime], Finding]] = []
    places = {key: place for place, key in enumerate(done)}
    for imu, calibrations in sorted(imus.items()):
        calibrations.sort(key=lambda one: places[one.about.epoch, one.about.sequence])
        history = _history(_power_ups(_present(calibrations)))
        ids = calibrations[-1].axes[0]
        model = model_of(firmware, ids.gyro_id, ids.accel_id)
        parts += _part(aircraft, imu, model, scatter_of_part(history.biases, history.temperature_degc))
        others = None if model is None else scatter_of_model([*parts_of(connection, model, but=aircraft).values()])
        found += [(imu, history.at, each) for each in judge(history, others)]
    found = _of_the_gradienter(found, len(imus))
    rows = list(done.values())
    bounds = [row for row in rows if row.heading_bound_deg is not None]
    figures = np.array([row.heading_bound_deg for row in bounds])
    found += [(None, [row.started_at for row in bounds], each) for each in judge_compass(figures)]
    zeros = list({row.zero_at: row for row in rows if row.zero_at is not None}.values())
    offsets, sigmas = ([(row.zero_x_deg, row.zero_y_deg) for row in zeros], [row.zero_sigma_deg for row in zeros])
    found += [(None, [row.zero_at for row in zeros], each) for each in judge_zero(np.array(offsets), np.array(sigmas))]
    worst = sorted(found, key=lambda one: -one[2].size)
    return Judged(parts, [_row(aircraft, place, *each) for place, each in enumerate(worst)])


def parts_of(connection: sa.Connection, model: str, *, but: str = "") -> dict[Part, Scatter]:
    """Read the scatter of each part of a model that is in an aircraft now, except in the aircraft `but`."""
    query = sa.select(schema.parts).where(schema.parts.c.model == model, schema.parts.c.aircraft != but)
    found: dict[Part, Scatter] = {}
    for row in connection.execute(query.order_by("aircraft", "imu").limit(6 * MOST_PARTS)):
        one = found.setdefault((row.aircraft, row.imu), Scatter(row.power_ups, *np.full((3, 6), np.nan)))
        place = "xyz".index(row.axis) + 3 * (row.triad == "accel")
        for name in ("turn_on", "wander", "per_k"):
            getattr(one, name)[place] = np.nan if (value := getattr(row, name)) is None else value
    return found


def _done(connection: sa.Connection, aircraft: str) -> dict[tuple[str, int], Any]:
    """Read the calibrations that were not undone, by key, in the order of epochs and sequences."""
    query = """
        SELECT s.epoch, s.sequence, s.started_at, s.duration_s, s.firmware, s.heading_bound_deg,
               s.zero_at, s.zero_x_deg, s.zero_y_deg, s.zero_sigma_deg, i.received_at
        FROM standing s
        JOIN tellings t ON t.aircraft = s.aircraft AND t.epoch = s.epoch AND t.sequence = s.sequence
        JOIN items i ON i.aircraft = s.aircraft AND i.epoch = s.epoch AND i.sequence = s.sequence
        WHERE s.aircraft = :aircraft"""
    moments = {name: Moment() for name in ("started_at", "zero_at", "received_at")}
    rows = connection.execute(sa.text(query).columns(**moments), {"aircraft": aircraft}).all()
    began: dict[str, datetime.datetime] = {}
    for row in rows:
        began[row.epoch] = min(row.received_at, began.get(row.epoch, row.received_at))
    ordered = sorted(rows, key=lambda row: (began[row.epoch], row.epoch, row.sequence))[-MOST_CALIBRATIONS:]
    return {(row.epoch, row.sequence): row for row in ordered}


def _biases(connection: sa.Connection, aircraft: str) -> dict[tuple[str, int, str], list[Any]]:
    b = schema.biases.c
    query = sa.select(
        b.epoch, b.sequence, b.imu, b.gyro_id, b.accel_id, b.temperature_degc, b.samples,
        sa.func.coalesce(b.gyro_read_rad_s, b.gyro_bias_rad_s).label("gyro_read_rad_s"),
        sa.func.coalesce(b.accel_read_m_s2, b.accel_bias_m_s2).label("accel_read_m_s2"),
        b.gyro_sigma_stat_rad_s, b.gyro_sigma_use_rad_s, b.accel_sigma_stat_m_s2, b.accel_sigma_use_m_s2,
    )  # fmt: skip
    found: dict[tuple[str, int, str], list[Any]] = {}
    for row in connection.execute(query.where(b.aircraft == aircraft).order_by(b.axis)):
        found.setdefault((row.epoch, row.sequence, row.imu), []).append(row)
    return found


def _present(calibrations: list[_Calibration]) -> list[_Calibration]:
    """Select the calibrations of the part that is in the aircraft now."""
    ids = [(one.axes[0].gyro_id, one.axes[0].accel_id) for one in calibrations]
    others = [place for place, each in enumerate(ids) if each != ids[-1]]
    return calibrations[others[-1] + 1 if others else 0 :]


def _power_ups(calibrations: list[_Calibration]) -> list[_Calibration]:
    """Select the last calibration of each power-up; they must also agree, as a wrong clock could join many."""
    found = calibrations[:1]
    for before, one in pairwise(calibrations):
        read, use = (np.array([each.figures(name) for each in (before, one)]) for name in ("read", "sigma_use"))
        off = np.nan_to_num(np.abs(read[1] - read[0]) / np.sqrt(np.square(use).sum(axis=0)))
        if abs(one.at - before.at) < SAME_POWER_UP and (off < _AGREE_SIGMAS).all():
            found.pop()
        found.append(one)
    return found


def _history(calibrations: Sequence[_Calibration]) -> History:
    samples = np.array([one.axes[0].samples or np.nan for one in calibrations], dtype=np.float64)
    took_s = np.array([one.about.duration_s for one in calibrations])
    # Sample rate by the quickest of the calibrations before: the duration of others includes waiting.
    rate = samples / np.maximum(took_s, 1.0)
    rate = np.array([np.fmax.reduce(rate[max(k - 7, 0) : k + 1]) for k in range(len(rate))])
    degc = [np.nan if (told := one.axes[0].temperature_degc) is None else told for one in calibrations]
    zeros = [one.about.zero_at for one in calibrations]
    warmth = np.array(degc, dtype=np.float64)
    return History(
        at=[one.at for one in calibrations],
        temperature_degc=np.where(np.abs(warmth) < MOST_DEGC, warmth, np.nan),
        biases=_matrix(calibrations, "read"),
        sigma_use=_matrix(calibrations, "sigma_use"),
        white=_matrix(calibrations, "sigma_stat") * np.sqrt(samples / rate)[:, None],
        new_zero=np.array([False, *(a != b for a, b in pairwise(zeros))]),
    )


def _matrix(calibrations: Sequence[_Calibration], name: str) -> Floats:
    return np.array([one.figures(name) for one in calibrations])


def _part(aircraft: str, imu: str, model: str | None, scatter: Scatter) -> list[Row]:
    found = []
    for place in range(6):
        row: Row = {"aircraft": aircraft, "imu": imu, "triad": ("gyro", "accel")[place // 3], "axis": "xyz"[place % 3]}
        row |= {"model": model, "power_ups": scatter.power_ups}
        for name in ("turn_on", "wander", "per_k"):
            value = float(getattr(scatter, name)[place])
            row[name] = value if np.isfinite(value) else None
        found.append(row)
    return found


_Found = list[tuple[str | None, Sequence[datetime.datetime], Finding]]


def _of_the_gradienter(found: _Found, imus: int) -> _Found:
    """Replace findings of level accelerometers that moved together by one against the gradienter."""
    left = list(found)
    for axis, name in ((3, "forward"), (4, "right")):
        of_it = [one for one in found if one[2].axis == axis and one[2].kind in ("bias", "drift")]
        moved = [one[2].moved for one in of_it]
        sinces = [one[2].since for one in of_it]
        if imus < 2 or len(of_it) < imus or max(sinces) - min(sinces) > _TOGETHER:
            continue
        if min(moved) * max(moved) > 0.0 and max(map(abs, moved)) < 2.0 * min(map(abs, moved)):
            mean = float(np.mean(np.abs(moved)))
            words = (
                f"all accelerometers have moved {name} by {mean / MG:.1f} mg at once: the gradienter's zero, by"
                f" {mean / G / DEG:.2f} deg, or its mounting"
            )
            worst = max(of_it, key=lambda one: one[2].size)
            left = [one for one in left if one not in of_it]
            left.append((None, worst[1], worst[2]._replace(kind="zero", words=words)))
    return left


def _row(aircraft: str, place: int, imu: str | None, at: Sequence[datetime.datetime], found: Finding) -> Row:
    since = at[min(found.since, len(at) - 1)]
    what = "" if imu is None else f"{'replace' if found.size >= REPLACE[found.kind] else 'watch'} IMU {imu}: "
    return {
        "aircraft": aircraft,
        "place": place,
        "kind": found.kind,
        "imu": imu,
        "since": since,
        "power_ups": len(at) - found.since,
        "size": found.size,
        "words": f"{what}{found.words}, since {since.day} {since:%B %Y}",
    }

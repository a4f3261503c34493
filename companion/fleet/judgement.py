"""Detection of failing sensors of an aircraft: from all its calibrations to rows of the tables `parts` and `findings`.

Each IMU's biases at its power-ups become a `PartHistory`, then columns for the tests in fleet/sequential.py, and alarms
of these tests become findings. The input is always all calibrations, never an earlier result, so that every collector
gets the same findings.
"""

from __future__ import annotations

import datetime
from collections.abc import Sequence
from itertools import pairwise
from typing import Any, Final, NamedTuple

import numpy as np
import sqlalchemy as sa
from numpy.typing import NDArray

from companion.fleet import schema
from companion.fleet.contract import Row
from companion.fleet.schema import UtcTime
from companion.fleet.sequential import Alarm, Columns, middle_of, scatter_of_model, scatter_of_part, watch
from companion.physics.frames import Floats
from companion.physics.units import DEG, DEG_H, MG, G

LEARNS: Final = 16
"""Number of first power-ups that define an IMU's usual bias and scatter, if no statistics of its model exist."""
_WITH_MODEL: Final = 10
"""Number of first power-ups that define an IMU's usual bias, if statistics of its model define the scatter."""
_OF_MODEL, _OF_OWN = 1.5, 3.0
"""Largest factor by which an IMU's scatter may exceed its model's, or its own at the first power-ups, as usual."""
WANDER: Final = (0.03, 0.3)
"""Least and largest assumed sigma of a bias's lasting change per power-up, as fractions of the turn-on scatter."""
LEAST_SIZE: Final = 1.8
LEAST_TIMES: Final = 1.4
_FEW_TELL: Final = 1.2
"""Factor that enlarges the scatter of an IMU's first power-ups: an estimate from few values may be too small."""
_LEAST_NOISE: Final = 0.08
"""Least assumed scatter of the natural logarithm of an IMU's noise, as each noise is measured over some ten seconds."""
_BOUND_DEG: Final = 5.0
_DRIFT_AFTER_POWER_UPS: Final = 8
SHOWN_POWER_UPS: Final = 30
_AXES: Final = [f"{triad} {axis}" for triad in ("gyro", "accel") for axis in "xyz"]
LEAST_ZERO_SIGMAS: Final = 8.0
ZERO_USUAL_DEG: Final = 0.05
"""One-sigma difference, degrees, of two zero offsets of a sound gradienter (tilt sensor), due to air temperature."""
MOST_CALIBRATIONS: Final = 2000
"""Number of latest calibrations of an aircraft that are used: five years at one a day."""
SAME_POWER_UP_WITHIN: Final = datetime.timedelta(minutes=30)
MOST_DEGC: Final = 150.0
"""Largest plausible temperature: a larger one is ignored, because it is probably in kelvins."""
_AGREE_SIGMAS: Final = 5.0
MOST_PARTS: Final = 300
_TOGETHER_WITHIN_POWER_UPS: Final = 10
REPLACE: Final = {"scatter": 3.0, "noise": 2.0, "drift": 8.0, "bias": 8.0}
"""Size of a finding, by kind, above which the advice is to replace the IMU, not only to watch it."""


class PartHistory(NamedTuple):
    """Measurements of one IMU at its n power-ups, in order of time; NaN: unknown.

    Columns of (n, 6) arrays are gyro x y z in rad/s, then accelerometer x y z in m/s^2. `biases` are not combined with
    earlier calibrations. `white` is the white noise, in these units times sqrt(s). `new_zero`, (n,), is True where the
    gradienter's zero offset was measured anew since the power-up before.
    """

    at: Sequence[datetime.datetime]
    temperature_degc: Floats  # (n,)
    biases: Floats
    sigma_use: Floats  # (n, 6) sigma of the biases, same units
    white: Floats
    new_zero: NDArray[np.bool_]


class PartFinding(NamedTuple):
    """Finding about a sensor that may be failing.

    `axis`: 0 to 2 gyro x y z, 3 to 5 accelerometer x y z, -1 none. `since`: index of the power-up when the fault began.
    `size`: multiple of the usual value. `moved`: change of the bias, rad/s or m/s^2.
    """

    kind: str  # bias, drift, scatter, noise, zero, compass
    axis: int
    since: int
    size: float
    words: str
    moved: float = 0.0


def columns_of(history: PartHistory, model: Floats | None) -> Columns:
    """Make the 12 columns to test: 6 biases, then 6 noises. `model`: scatter of other IMUs of the same model."""
    turn_on = _FEW_TELL * scatter_of_part(history.biases[:LEARNS], history.temperature_degc[:LEARNS])[0]
    wander = np.full(6, WANDER[0])
    first, most_own = np.full(12, LEARNS), np.full(12, _OF_OWN)
    if model is not None:
        known = np.isfinite(model[0])
        turn_on = np.where(known, model[0], turn_on)
        wander = np.clip(np.nan_to_num(model[1] / turn_on), *WANDER)
        first[:6][known], most_own[:6][known] = _WITH_MODEL, _OF_MODEL
    unit = np.where(turn_on > 0.0, turn_on, np.nan)
    use = np.square(history.sigma_use)
    usual = np.array([middle_of(column) for column in use.T])
    # The usual sigma is already included in the scatter.
    variance = np.nan_to_num(np.maximum(use - usual, 0.0) / unit**2)
    noise = np.log(np.where(history.white > 0.0, history.white, np.nan))
    # At the end of a warm-up the sigma is that of a fitted line, which does not show the noise.
    share = np.sqrt(use) / history.white
    noise = np.where(share > 3.0 * np.array([middle_of(column) for column in share.T]), np.nan, noise)
    of_noise = scatter_of_part(noise[:LEARNS], history.temperature_degc[:LEARNS])[0]
    of_noise = np.fmax(of_noise, np.where(np.isfinite(of_noise), _LEAST_NOISE, np.nan))
    values = np.hstack([history.biases / unit, noise / of_noise])
    n = len(values)
    relevel = np.zeros((n, 12), dtype=bool)
    relevel[:, 3:5] = history.new_zero[:, None]
    return Columns(
        values=values,
        variance=np.hstack([variance, np.zeros((n, 6))]),
        temperature_degc=np.repeat(history.temperature_degc[:, None], 12, axis=1),
        wander=np.concatenate([wander, np.full(6, WANDER[0])]),
        relevel=relevel,
        first=first,
        most_own=most_own,
        least=np.concatenate([np.full(6, LEAST_SIZE), np.log(LEAST_TIMES) / of_noise]),
        unit=np.concatenate([unit, of_noise]),
    )


def counts(alarm: Alarm) -> bool:
    """Return False for an alarm that shows no fault: a noise that became smaller, or that scatters more."""
    return alarm.column < 6 or (alarm.kind == "level" and alarm.size > 0.0)


def judge(history: PartHistory, model: Floats | None) -> list[PartFinding]:
    columns = columns_of(history, model)
    n = len(history.biases)
    found: dict[tuple[int, str], PartFinding] = {}
    for alarm in filter(counts, watch(columns)):
        axis, unit = alarm.column % 6, columns.unit[alarm.column]
        if alarm.column >= 6:
            before = found.pop((axis, "noise"), None)
            since = before.since if before else alarm.since
            values = columns.values[:, alarm.column] * unit
            times = float(np.exp(middle_of(values[-LEARNS:]) - middle_of(values[max(since - LEARNS, 0) : since])))
            if times >= LEAST_TIMES:
                words = f"{_AXES[axis]} noise {times:.1f} times what it was"
                found[axis, "noise"] = PartFinding("noise", axis, since, times, words)
        elif alarm.kind == "scatter" and alarm.until == n:
            its = "times its model's" if model is not None else "times what it was"
            words = f"{_AXES[axis]} turn-on scatter {alarm.size:.1f} {its}"
            found[axis, "scatter"] = PartFinding("scatter", axis, alarm.since, alarm.size, words)
        elif alarm.kind == "level" and n - alarm.at <= SHOWN_POWER_UPS:
            before = found.get((axis, "level"))
            size = alarm.size + (before.size if before else 0.0)
            since = before.since if before else alarm.since
            kind = "drift" if before or alarm.at - alarm.since >= _DRIFT_AFTER_POWER_UPS else "bias"
            moved = abs(size) * unit / (DEG_H if axis < 3 else MG)
            its = "its model's turn-on scatter" if model is not None else "its turn-on scatter"
            words = (
                f"{_AXES[axis]} bias has {'drifted' if kind == 'drift' else 'moved'} by {moved:.3g}"
                f" {'deg/h' if axis < 3 else 'mg'}, {abs(size):.1f} times {its}"
            )
            found[axis, "level"] = PartFinding(kind, axis, since, size, words, size * unit)
    # A larger scatter also raises false alarms of a changed bias: drop those.
    left = [each for (axis, what), each in found.items() if what != "level" or (axis, "scatter") not in found]
    return sorted((each._replace(size=abs(each.size)) for each in left), key=lambda each: -each.size)


def judge_compass(heading_bound_deg: Floats) -> list[PartFinding]:
    """Judge the compass by the error bound of the heading at each calibration, in degrees, (n,); NaN: unknown."""
    if len(heading_bound_deg) <= LEARNS:
        return []
    columns = compass_column(heading_bound_deg)
    found = []
    for alarm in watch(columns):
        now = middle_of(heading_bound_deg[-LEARNS // 2 :])
        before = middle_of(heading_bound_deg[max(alarm.since - LEARNS, 0) : alarm.since])
        if alarm.kind == "level" and now > max(_BOUND_DEG, LEAST_TIMES * before):
            words = f"compass: heading good to {now:.0f} deg, before to {before:.1f}: iron near it?"
            found = [PartFinding("compass", -1, alarm.since, now / before, words)]
    return found


def compass_column(heading_bound_deg: Floats) -> Columns:
    bound = np.log(np.where(heading_bound_deg > 0.0, heading_bound_deg, np.nan))[:, None]
    n, nowhere = len(bound), np.full((len(bound), 1), np.nan)
    unit = np.fmax(scatter_of_part(bound[:LEARNS], nowhere[:LEARNS, 0])[0], _LEAST_NOISE)
    return Columns(
        values=bound / unit,
        variance=np.zeros((n, 1)),
        temperature_degc=nowhere,
        wander=np.full(1, WANDER[0]),
        relevel=np.zeros((n, 1), dtype=bool),
        first=np.full(1, LEARNS),
        most_own=np.full(1, _OF_OWN),
        least=np.log(LEAST_TIMES) / unit,
        unit=unit,
    )


def judge_zero(offset_deg: Floats, sigma_deg: Floats) -> list[PartFinding]:
    if len(offset_deg) < 2:
        return []
    moved = float(np.abs(offset_deg[-1] - offset_deg[-2]).max())
    sigmas = moved / float(np.sqrt(np.square(sigma_deg[-2:]).sum() + ZERO_USUAL_DEG**2))
    if not sigmas > LEAST_ZERO_SIGMAS:
        return []
    words = f"gradienter: its zero has moved by {moved:.2f} deg between two alignments ({moved * G * DEG / MG:.1f} mg)"
    return [PartFinding("zero", -1, len(offset_deg) - 1, sigmas / 2.0, words)]


_CalibrationOfImu = tuple[Any, list[Any]]  # row of `calibrations`, rows of `biases`: x, y, z


def _figures(calibration: _CalibrationOfImu, name: str) -> list[float]:
    names = (f"gyro_{name}_rad_s", f"accel_{name}_m_s2")
    return [np.nan if (value := getattr(row, each)) is None else value for each in names for row in calibration[1]]


def judged(connection: sa.Connection, aircraft: str) -> tuple[list[Row], list[Row]]:
    """Judge an aircraft's sensors by its calibrations in the database; return rows of `parts` and `findings`."""
    done = _done(connection, aircraft)
    imus: dict[str, list[_CalibrationOfImu]] = {}
    biases = _biases(connection, aircraft)
    for key, about in done.items():
        for imu, rows in biases.get(key, {}).items():
            if len(rows) == 3:
                imus.setdefault(imu, []).append((about, rows))
    # Imported here: it is slow, and most of the collector does not need it.
    from companion.autopilot.firmware.firmwares import model_of

    firmware = next((row.firmware for row in reversed(done.values()) if row.firmware), None)
    parts: list[Row] = []
    found: _Found = []
    for imu, calibrations in sorted(imus.items()):
        history = _history(_power_ups(calibrations))
        ids = calibrations[-1][1][0]
        model = model_of(firmware, ids.gyro_id, ids.accel_id)
        about = {"aircraft": aircraft, "imu": imu, "model": model, "power_ups": len(history.at)}
        scatter = scatter_of_part(history.biases, history.temperature_degc)
        for place, name in enumerate(_AXES):
            triad, axis = name.split()
            turn_on, wander = (float(each) if np.isfinite(each) else None for each in scatter[:, place])
            parts.append({**about, "triad": triad, "axis": axis, "turn_on": turn_on, "wander": wander})
        others = None if model is None else _others(connection, model, aircraft)
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
    return parts, [_row(aircraft, place, *each) for place, each in enumerate(worst)]


def _others(connection: sa.Connection, model: str, aircraft: str) -> Floats | None:
    query = sa.select(schema.parts).where(schema.parts.c.model == model, schema.parts.c.aircraft != aircraft)
    found: dict[tuple[str, str], Floats] = {}
    for row in connection.execute(query.order_by("aircraft", "imu").limit(6 * MOST_PARTS)):
        one = found.setdefault((row.aircraft, row.imu), np.full((2, 6), np.nan))
        figures = [np.nan if value is None else value for value in (row.turn_on, row.wander)]
        one[:, _AXES.index(f"{row.triad} {row.axis}")] = figures
    return scatter_of_model(list(found.values()))


def _done(connection: sa.Connection, aircraft: str) -> dict[tuple[str, int], Any]:
    query = """
        SELECT s.epoch, s.sequence, s.started_at, s.duration_s, s.firmware, s.heading_bound_deg,
               s.zero_at, s.zero_x_deg, s.zero_y_deg, s.zero_sigma_deg, i.received_at
        FROM standing s
        JOIN tellings t ON t.aircraft = s.aircraft AND t.epoch = s.epoch AND t.sequence = s.sequence
        JOIN items i ON i.aircraft = s.aircraft AND i.epoch = s.epoch AND i.sequence = s.sequence
        WHERE s.aircraft = :aircraft"""
    moments = {name: UtcTime() for name in ("started_at", "zero_at", "received_at")}
    rows = connection.execute(sa.text(query).columns(**moments), {"aircraft": aircraft}).all()
    began: dict[str, datetime.datetime] = {}
    for row in rows:
        began[row.epoch] = min(row.received_at, began.get(row.epoch, row.received_at))
    ordered = sorted(rows, key=lambda row: (began[row.epoch], row.epoch, row.sequence))[-MOST_CALIBRATIONS:]
    return {(row.epoch, row.sequence): row for row in ordered}


def _biases(connection: sa.Connection, aircraft: str) -> dict[tuple[str, int], dict[str, list[Any]]]:
    b = schema.biases.c
    query = sa.select(
        b.epoch, b.sequence, b.imu, b.gyro_id, b.accel_id, b.temperature_degc, b.samples,
        sa.func.coalesce(b.gyro_read_rad_s, b.gyro_bias_rad_s).label("gyro_read_rad_s"),
        sa.func.coalesce(b.accel_read_m_s2, b.accel_bias_m_s2).label("accel_read_m_s2"),
        b.gyro_sigma_stat_rad_s, b.gyro_sigma_use_rad_s, b.accel_sigma_stat_m_s2, b.accel_sigma_use_m_s2,
    )  # fmt: skip
    found: dict[tuple[str, int], dict[str, list[Any]]] = {}
    for row in connection.execute(query.where(b.aircraft == aircraft).order_by(b.axis)):
        found.setdefault((row.epoch, row.sequence), {}).setdefault(row.imu, []).append(row)
    return found


def _power_ups(calibrations: list[_CalibrationOfImu]) -> list[_CalibrationOfImu]:
    """Select the last calibration of each power-up of the present sensor; earlier sensors of this IMU are left out.

    Calibrations soon after each other count as one power-up only if their biases agree, because a clock may be wrong.
    """
    ids = [(axes[0].gyro_id, axes[0].accel_id) for _, axes in calibrations]
    others = [place for place, each in enumerate(ids) if each != ids[-1]]
    calibrations = calibrations[others[-1] + 1 if others else 0 :]
    found = calibrations[:1]
    for before, one in pairwise(calibrations):
        read, use = (np.array([_figures(each, name) for each in (before, one)]) for name in ("read", "sigma_use"))
        off = np.nan_to_num(np.abs(read[1] - read[0]) / np.sqrt(np.square(use).sum(axis=0)))
        if abs(one[0].started_at - before[0].started_at) < SAME_POWER_UP_WITHIN and (off < _AGREE_SIGMAS).all():
            found.pop()
        found.append(one)
    return found


def _history(calibrations: Sequence[_CalibrationOfImu]) -> PartHistory:
    biases, sigma_stat, sigma_use = (
        np.array([_figures(one, name) for one in calibrations]) for name in ("read", "sigma_stat", "sigma_use")
    )
    samples = np.array([axes[0].samples or np.nan for _, axes in calibrations], dtype=np.float64)
    took_s = np.array([about.duration_s for about, _ in calibrations])
    # Sample rate from the quickest of the last calibrations: the duration of the others includes waiting.
    rate = samples / np.maximum(took_s, 1.0)
    rate = np.array([np.fmax.reduce(rate[max(k - 7, 0) : k + 1]) for k in range(len(rate))])
    degc = np.array([axes[0].temperature_degc for _, axes in calibrations], dtype=np.float64)
    zeros = [about.zero_at for about, _ in calibrations]
    return PartHistory(
        at=[about.started_at for about, _ in calibrations],
        temperature_degc=np.where(np.abs(degc) < MOST_DEGC, degc, np.nan),
        biases=biases,
        sigma_use=sigma_use,
        white=sigma_stat * np.sqrt(samples / rate)[:, None],
        new_zero=np.array([False, *(a != b for a, b in pairwise(zeros))]),
    )


_Found = list[tuple[str | None, Sequence[datetime.datetime], PartFinding]]


def _of_the_gradienter(found: _Found, imus: int) -> _Found:
    left = list(found)
    for axis, name in ((3, "forward"), (4, "right")):
        of_it = [one for one in found if one[2].axis == axis and one[2].kind in ("bias", "drift")]
        moved, sinces = [one[2].moved for one in of_it], [one[2].since for one in of_it]
        if imus < 2 or len(of_it) < imus or max(sinces) - min(sinces) > _TOGETHER_WITHIN_POWER_UPS:
            continue
        if min(moved) * max(moved) > 0.0 and max(map(abs, moved)) < 2.0 * min(map(abs, moved)):
            mean = float(np.mean(np.abs(moved)))
            words = (
                f"all accelerometers have moved {name} by {mean / MG:.1f} mg at once: the gradienter's zero, by"
                f" {mean / G / DEG:.2f} deg, or its mounting"
            )
            _, at, worst = max(of_it, key=lambda one: one[2].size)
            left = [one for one in left if one not in of_it]
            left.append((None, at, worst._replace(kind="zero", words=words)))
    return left


def _row(aircraft: str, place: int, imu: str | None, at: Sequence[datetime.datetime], found: PartFinding) -> Row:
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

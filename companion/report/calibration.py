"""HTML page of one calibration, made from files in the storage directory; needs no daemon and changes no file."""

from __future__ import annotations

import datetime
from collections.abc import Sequence
from operator import attrgetter
from pathlib import Path
from typing import Final

from companion.errors import StorageError
from companion.estimation.records.record import ArmingRecord, ImuRecord, Outcome, Record, outcome_word
from companion.physics.units import UNITS
from companion.report.markup import Child, Markup, join, row, tag
from companion.report.page import (
    AXES,
    MAX_IMUS,
    MAX_WARNINGS,
    NAMES,
    arming_items,
    card,
    damaged,
    drift,
    history,
    moment,
    page,
    with_sigma,
)
from companion.samples import TRIADS, Triad
from companion.storage.records import RecordStore
from companion.storage.state import BoundedList

MAX_EARLIER: Final = 60

_ARMED: Final = attrgetter("armed_at", "state", "reason")
_OUTCOMES: Final[dict[Outcome, tuple[str, str]]] = {
    "verified": ("ok", "read back, and seen in the telemetry"),
    "stored": ("warn", "read back; its effect could not be seen"),
    "failed": ("bad", "not set, or not put back"),
    "rolled_back": ("warn", "the old value is in force again"),
}


Numbered = Sequence[tuple[int, Record]]
"""Numbers and records of one aircraft's calibrations, oldest first; the page is about the last one."""


def read_material(directory: Path, wanted: int | None) -> tuple[Numbered, list[ArmingRecord], list[str]]:
    """Read the data for the page of calibration number `wanted` (None: the latest).

    Returns:
        Earlier calibrations and, last, the wanted one; armings while it was active; errors of unreadable files.
    """
    store, records = RecordStore(directory), directory / "records"
    try:
        # Check access first: a folder that only root may enter would look like a missing one.
        next(iter(records.iterdir()), None)
    except FileNotFoundError:
        raise StorageError(f"no calibration yet: there is no {records} (--storage DIR names another folder)") from None
    except OSError as error:
        hint = "; run it with sudo" if isinstance(error, PermissionError) else ""
        raise StorageError(f"{records}: cannot be read: {error.strerror}{hint}") from error
    found: dict[int, Record] = {}
    unreadable: dict[int, str] = {}
    for k in store.numbers():
        try:
            if (one := store.file(k).read()) is not None:
                found[k] = one
        except StorageError as error:
            unreadable[k] = str(error)
    if not found:
        why = f"can be read: {'; '.join([*unreadable.values()][:3])}" if unreadable else f"yet: {records} is empty"
        raise StorageError(f"no calibration {why}")
    wanted = max(found) if wanted is None else wanted
    if wanted not in found:
        first, last = min(found | unreadable), max(found | unreadable)
        words = f"no calibration {wanted}; there are number {first} to {last} (companion history)"
        raise StorageError(unreadable.get(wanted, words))
    record = found[wanted]
    problems, armings = [*unreadable.values()], list[ArmingRecord]()
    try:
        armings = BoundedList(directory / "armings.json", ArmingRecord, keep=0).all()
    except StorageError as error:
        problems.append(str(error))
    earlier = [(k, one) for k, one in found.items() if k <= wanted and one.system_id == record.system_id]
    with_it = [arming for arming in armings if arming.calibration == record.started_at]
    return earlier[-MAX_EARLIER:], with_it, problems


def calibration_page(
    records: Numbered, armings: Sequence[ArmingRecord], problems: Sequence[str], now: datetime.datetime
) -> str:
    number, record = records[-1]
    more = len(record.imus) - MAX_IMUS
    return page(
        f"Calibration {number}, {moment(record.started_at)}",
        now,
        _headline(number, record),
        damaged(problems),
        _warnings(record),
        *(_imu(imu) for imu in record.imus[:MAX_IMUS]),
        card("caution", f"{more} more IMUs are not shown.") if more > 0 else None,
        _written(record),
        join(tag("h2", "Armed with it"), arming_items(map(_ARMED, armings))) if armings else None,
        _pose(record),
        _drift(records),
    )


def _headline(number: int, record: Record) -> Markup:
    vehicle = "vehicle not heard" if record.system_id is None else f"vehicle {record.system_id}"
    undone = record.undone_at
    return join(
        tag("h1", f"Calibration {number}"),
        tag("p", f"{moment(record.started_at)}, {vehicle}, took {record.duration_s:.0f} s"),
        tag("p", tag("span", record.state.upper(), class_=f"state {record.state}")),
        tag("p", _in_short(record), class_="lead"),
        tag("p", record.reason) if record.state == "done" else card("alarm", tag("p", record.reason)),
        card("alarm", f"Undone {moment(undone)}: the values from before are in force again.") if undone else None,
    )


def _in_short(record: Record) -> str:
    outcomes = [written.outcome for imu in record.imus for written in imu.written.values()]
    found = ", ".join(imu.name for imu in record.imus)
    words = f"Biases found of {found}. " if record.state == "done" and found else ""
    if not outcomes and any(imu.unchanged for imu in record.imus):
        return f"{words}The offsets in the autopilot are already correct: nothing was written."
    if not outcomes:
        return f"{words}Nothing was written to the autopilot."
    if all(outcome == "verified" for outcome in outcomes):
        return f"{words}{len(outcomes)} parameters written, all verified."
    counts = ", ".join(f"{outcomes.count(kind)} {outcome_word(kind)}" for kind in _OUTCOMES if kind in outcomes)
    return f"{words}Parameters: {counts}."


def _warnings(record: Record) -> Markup | None:
    found = [*record.warnings, *(words for imu in record.imus for words in imu.warnings)]
    if not found:
        return join(tag("h2", "Warnings"), card("fine", "None.")) if record.state == "done" else None
    more = len(found) - MAX_WARNINGS
    return join(
        tag("h2", "Warnings"),
        *(card("caution", tag("p", words)) for words in found[:MAX_WARNINGS]),
        card("caution", f"{more} more warnings are not shown.") if more > 0 else None,
        tag("p", "What to do about each: docs/messages.md."),
    )


def _imu(imu: ImuRecord) -> Markup:
    temperature = "temperature unknown" if imu.temperature_degc is None else f"{imu.temperature_degc:.1f} degC"
    is_corrected = imu.residual_gyro_rad_s or imu.residual_accel_m_s2
    residual = " residual: error of its output before this write." if is_corrected else None
    return join(
        tag("h2", f"IMU {imu.name}"),
        tag("p", f"{imu.samples} samples, {temperature}", class_="soft"),
        tag("p", "σ use: one sigma for the next minutes. σ stat: what averaging left.", residual, class_="soft"),
        tag("div", *(_triad(imu, triad) for triad in TRIADS), class_="pairs"),
    )


def _triad(imu: ImuRecord, triad: Triad) -> Markup:
    unit, unit_name, _ = UNITS[triad]
    bias, stat, use, _, left, _ = imu.of(triad)
    title = tag("h3", f"{NAMES[triad]}, {unit_name}")
    if bias is None or stat is None or use is None:
        return tag("div", title, card("caution", "Not determined: not asked for, or a warning above says why."))
    rows = []
    for k in range(3):
        value, sigma = with_sigma(bias[k], use[k], unit)
        residual = with_sigma(left[k], use[k], unit)[0] if left else None
        rows.append(row(AXES[k], value, f"±{sigma}", with_sigma(0.0, stat[k], unit)[1], residual))
    heads = ["", "bias", "σ use", "σ stat", *(["residual"] if left else [])]
    held = card("caution", "Held back: measured, not written. What was in force before still is.")
    return tag(
        "div",
        title,
        held if triad in imu.held_back else None,
        tag("table", tag("tr", *(tag("th", words) for words in heads)), *rows),
    )


def _written(record: Record) -> Markup | None:
    if not any(imu.written for imu in record.imus):
        return None
    parts: list[Child] = [tag("h2", "Written to the autopilot")]
    seen: set[Outcome] = set()
    for imu in record.imus[:MAX_IMUS]:
        if not imu.written:
            continue
        rows = []
        for name, one in imu.written.items():
            seen.add(one.outcome)
            class_, _ = _OUTCOMES[one.outcome]
            head = tag("td", name, ": ", tag("strong", outcome_word(one.outcome), class_=class_), colspan="3")
            values = (("before", one.before), ("after", one.after), ("read back", one.read_back))
            cells = [tag("td", tag("small", words), _setting(value)) for words, value in values]
            rows += [row(head, class_="name"), row(*cells, class_="values")]
        parts += [tag("h3", f"IMU {imu.name}"), tag("table", *rows, class_="setting")]
    parts += [tag("p", f"{outcome_word(outcome)}: {_OUTCOMES[outcome][1]}.", class_="soft") for outcome in sorted(seen)]
    return tag("section", *parts)


def _setting(value: float | None) -> str:
    return tag("span", "unknown") if value is None else f"{value:.6g}"


def _pose(record: Record) -> Markup:
    parts: list[Child] = [tag("h2", "Pose")]
    pose = record.pose
    if pose is None:
        parts.append(card("", "Not determined."))
    else:
        angles = (
            ("pitch, nose up", pose.theta_deg, pose.sigma_deg.theta, "+"),
            ("roll, right side down", pose.gamma_deg, pose.sigma_deg.gamma, "+"),
            ("heading, true", pose.psi_deg, pose.sigma_deg.psi, ""),
        )
        parts.append(tag("table", *(row(words, _angle(value, sigma, sign)) for words, value, sigma, sign in angles)))
    if record.magnetic is not None:
        parts.append(tag("p", f"Compass: {record.magnetic.in_words()}."))
    return tag("section", *parts)


def _angle(value: float | None, sigma: float | None, sign: str) -> str:
    if value is None:
        return "unknown"
    return f"{value:{sign}.2f} deg" if sigma is None else f"{' ± '.join(with_sigma(value, sigma, 1.0, sign))} deg"


def _drift(records: Numbered) -> Markup:
    number, record = records[-1]
    names = [imu.name for imu in record.imus] or [imu.name for _, one in records for imu in one.imus]
    parts: list[Child] = [tag("h2", "Biases up to now")]
    for name in [*dict.fromkeys(names)][:MAX_IMUS]:
        figures: list[Child] = []
        for triad in TRIADS:
            points = history(records, name, triad)
            if len(points) < 2:
                continue
            plots = drift(points, triad, name=f"{name} {NAMES[triad].lower()}", this=number)
            figures.append(tag("div", tag("h3", NAMES[triad]), plots))
        if figures:
            parts += [tag("h3", f"IMU {name}"), tag("div", *figures, class_="pairs")]
    if len(parts) == 1:
        parts.append(card("", "Fewer than two finished calibrations: nothing to compare with yet."))
    elif record.state == "done":
        parts.append(tag("p", "The ring is this calibration.", class_="soft"))
    return tag("section", *parts)

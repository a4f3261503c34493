"""HTML page of one calibration, made from files in the storage directory; needs no daemon and changes no file."""

from __future__ import annotations

import datetime
from collections.abc import Sequence
from operator import attrgetter
from pathlib import Path
from typing import Final

from companion.errors import StorageError
from companion.estimation.records.record import ArmingRecord, ImuRecord, Outcome, Record, outcome_word
from companion.messages import remedy
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
    "failed": ("bad", "not set, or not restored"),
    "rolled_back": ("warn", "the old value is active again"),
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
        tag("p", "±: one sigma of the next minutes.", class_="soft") if record.imus else None,
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
        card("alarm", f"Undone {moment(undone)}: the values from before are active again.") if undone else None,
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
        *(
            card("caution", tag("p", words), tag("p", advice, class_="soft") if (advice := remedy(words)) else None)
            for words in found[:MAX_WARNINGS]
        ),
        card("caution", f"{more} more warnings are not shown.") if more > 0 else None,
    )


def _imu(imu: ImuRecord) -> Markup:
    temperature = "temperature unknown" if imu.temperature_degc is None else f"{imu.temperature_degc:.1f} degC"
    found = [triad for triad in TRIADS if imu.of(triad).bias is not None]
    names = " and ".join(NAMES[triad].lower() for triad in TRIADS if triad not in found)
    held = ", ".join(NAMES[triad].lower() for triad in TRIADS if triad in imu.held_back)
    heads = [f"{NAMES[triad]}, {UNITS[triad].name}" for triad in found]
    cells = zip(AXES, *(_column(imu, triad) for triad in found), strict=True)
    return join(
        tag("h2", f"IMU {imu.name}"),
        tag("p", f"{imu.samples} samples, {temperature}", class_="soft"),
        card("caution", f"{names.capitalize()} not determined: not requested, or a warning says why.")
        if names
        else None,
        card("caution", f"Held back: {held} measured, not written.") if held else None,
        tag("table", tag("tr", *(tag("th", words) for words in ["", *heads])), *(row(*line) for line in cells))
        if found
        else None,
        tag("details", tag("summary", "Noise and change"), *(_details(imu, triad) for triad in found))
        if found
        else None,
    )


def _column(imu: ImuRecord, triad: Triad) -> list[str]:
    bias, use = imu.of(triad).bias, imu.sigma_in_force(triad)
    assert bias is not None
    assert use is not None
    return [" ± ".join(with_sigma(bias[k], use[k], UNITS[triad].si)) for k in range(3)]


def _details(imu: ImuRecord, triad: Triad) -> Markup:
    """Show what averaging left of the noise, and the error of the output before the write."""
    unit, unit_name, _ = UNITS[triad]
    _, stat, use, _, left, _ = imu.of(triad)
    assert stat is not None
    assert use is not None
    heads = ["", "σ after averaging", *(["error before the write"] if left else [])]
    rows = [
        row(AXES[k], with_sigma(0.0, stat[k], unit)[1], with_sigma(left[k], use[k], unit)[0] if left else None)
        for k in range(3)
    ]
    table = tag("table", tag("tr", *(tag("th", words) for words in heads)), *rows)
    return tag("div", tag("h3", f"{NAMES[triad]}, {unit_name}"), table)


def _written(record: Record) -> Markup | None:
    outcomes = [one.outcome for imu in record.imus for one in imu.written.values()]
    if not outcomes:
        return None
    parts: list[Child] = [tag("summary", f"{len(outcomes)} parameters")]
    for imu in record.imus[:MAX_IMUS]:
        if not imu.written:
            continue
        rows = []
        for name, one in imu.written.items():
            words = tag("strong", outcome_word(one.outcome), class_=_OUTCOMES[one.outcome][0])
            read = [f"; read back {_setting(one.read_back)}"] if one.read_back != one.after else []
            rows += [row(tag("td", name, ": ", words, colspan="2"), class_="name")]
            rows += [row(tag("td", _setting(one.before), " → ", _setting(one.after), *read), class_="values")]
        parts += [tag("h3", f"IMU {imu.name}"), tag("table", *rows, class_="setting")]
    seen = sorted(set(outcomes))
    parts += [tag("p", f"{outcome_word(outcome)}: {_OUTCOMES[outcome][1]}.", class_="soft") for outcome in seen]
    return tag("section", tag("h2", "Written to the autopilot"), tag("details", *parts))


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


def _drift(records: Numbered) -> Markup | None:
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
        return None
    if record.state == "done":
        parts.append(tag("p", "The ring is this calibration.", class_="soft"))
    return tag("section", *parts)

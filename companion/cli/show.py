"""Text output: formats records and states of the daemon as lines and tables."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import msgspec

from companion import messages, summary
from companion.estimation.records.flight_record import Flight, figure
from companion.estimation.records.record import Magnetic, outcome_word
from companion.formats import Object
from companion.physics.units import DEG_H, MG

if TYPE_CHECKING:
    from companion.daemon.process.check import CheckLine
    from companion.installation.install import InstallStep
    from companion.links.serial.ports import SerialPort


REMEDY = "-> "  # Prefix of a line with the remedy for the line before
_BAR = 40
_VERDICTS = {"accept": "ready", "wait": "not yet", "refuse": "NOT ready"}


def record_lines(record: Object) -> list[str]:
    lines = [f"{record['state'].upper()} after {record['duration_s']:.0f} s: {without_state(record)}"]
    if (pose := record.get("pose")) is not None:
        sigma = pose["sigma_deg"]
        angles = (
            f"{words} unknown"
            if pose[f"{key}_deg"] is None
            else f"{words} {pose[f'{key}_deg']:.2f} deg (sigma {_number(sigma[key], '.2f')})"
            for words, key in (("pitch", "theta"), ("roll", "gamma"), ("heading", "psi"))
        )
        lines.append(f"pose: {', '.join(angles)}")
    lines += _magnetic_lines(record.get("magnetic"))
    for imu in record["imus"]:
        lines += _imu_lines(imu)
    lines += [f"warning: {warning}" for warning in record["warnings"]]
    outcomes = [one["outcome"] for imu in record["imus"] for one in imu["written"].values()]
    if "failed" in outcomes:
        return [*lines, "Some parameters may hold neither the old nor the new value: companion status"]
    if not outcomes or set(outcomes) == {"rolled_back"}:
        return [*lines, "The autopilot has its old values."]
    return [*lines, f"{len(outcomes)} parameters written to the autopilot; to restore them: companion undo"]


def without_state(ended: Object) -> str:
    reason: str = ended["reason"]  # that of a cancelled job begins with "cancelled"
    return reason.removeprefix(f"{ended['state']} ")


def _magnetic_lines(magnetic: Object | None) -> list[str]:
    return [] if magnetic is None else [f"compass: {msgspec.convert(magnetic, Magnetic).in_words()}"]


def _imu_lines(imu: Object) -> list[str]:
    degc = imu["temperature_degc"]
    lines = [f"{imu['name']}: {imu['samples']} samples" + (f", {degc:.1f} degC" if degc is not None else "")]
    for triad, unit, scale, form, si, left in (
        ("gyro", "deg/h", DEG_H, "+9.1f", "rad_s", "residual_gyro_rad_s"),
        ("accel", "mg   ", MG, "+9.3f", "m_s2", "residual_accel_m_s2"),
    ):
        if imu[bias := f"{triad}_bias_{si}"] is None:
            continue
        sigma = imu.get(f"{triad}_sigma_in_force_{si}") or imu[f"{triad}_sigma_use_{si}"]
        lines.append(f"  {triad:5} bias {unit} {axes(imu[bias], sigma, form, scale)}{_held_back(imu, triad)}")
        if imu["written"] and imu.get(left) not in (None, imu[bias]):
            lines.append(f"      change {unit} {axes(imu[left], None, form, scale)}")
    if not imu["written"] and imu.get("residual_gyro_rad_s") is imu.get("residual_accel_m_s2") is None:
        lines.append("  shown only, not written to the autopilot")
    lines += written_lines(imu["written"])
    lines += [f"  warning: {warning}" for warning in imu["warnings"]]
    return lines


def written_lines(written: Object) -> list[str]:
    lines = []
    for name, one in written.items():
        values = [_number(one["before"], "+.6f"), _number(one["after"], "+.6f")]
        first, last = reversed(values) if one["outcome"] == "rolled_back" else values
        lines.append(f"  {name:16} {first} -> {last}  {outcome_word(one['outcome'])}")
    return lines


def axes(values: Sequence[float], sigmas: Sequence[float] | None, form: str, scale: float = 1.0) -> str:
    """Format the values of x, y and z divided by `scale`, with sigmas if given, in a format such as "+9.1f"."""
    cells = [f"{axis} {value / scale:{form}}" for axis, value in zip("xyz", values, strict=True)]
    if sigmas is not None:
        pairs = zip(cells, sigmas, strict=True)
        cells = [f"{cell} +- {sigma / scale:.{form[-2]}f}" for cell, sigma in pairs]
    return "  ".join(cells)


def _number(value: float | None, form: str) -> str:
    return "unknown" if value is None else format(value, form)


def status_lines(status: Object) -> list[str]:
    lines, last, recording = [summary.headline(status)], status["last"], status["recording"]
    said = () if last is None else last["reason"]
    if status["progress"] is None and status["reason"] and status["reason"] != said:
        lines.append(f"last: {status['reason']}")
    if status["fault"] is not None:
        lines.append(f"FAULT: {status['fault']}")
    if status["putting_back"]:
        lines.append("an interrupted write is being restored (needs the autopilot, disarmed)")
    if recording["lost"]:
        lines.append(f"recordings: {recording['lost']} messages lost so far, the disk is too slow")
    if (file := recording["file"]) is not None:
        lines.append(f"recording to {file['path']}: {file['seconds']:.0f} s, {file['bytes'] / 1e6:.1f} MB")
    for _, name, words, remedy in summary.rows(status):
        lines += [f"{name}: {words}", *([f"  {REMEDY}{remedy}"] if remedy else [])]
    refused = status["vehicle"]["refused"].items()
    lines += [f"not allowed to ask: {sender} ({count} times)" for sender, count in refused]
    lines += _reading_lines(status)
    arming = status["arming"]
    verdict = _VERDICTS[arming["verdict"]] + (f", {arming['words']}" if arming["verdict"] != "accept" else "")
    lines += [f"at arming ({arming['at_arm']}): {verdict}", f"active calibration: {arming['in_force']}"]
    lines += [f"by hand, {_minute(one['measured_at'])} UTC: {by_hand_words(one)}" for one in status["by_hand"]]
    lines += [f"profile {each['imu']}: {each['summary']}" for each in status["profiles"]]
    lines += end_lines(status)
    lines += [undo_line(status["undoable"])] if status["undoable"] else []
    return lines if last is None else [*lines, *_magnetic_lines(last.get("magnetic")), *last.get("when_warm", [])]


def explained_lines(found: Sequence[tuple[str, messages.Entry]]) -> list[str]:
    lines: list[str] = []
    for name, entry in found:
        lines += ["", f"{name}: {' | '.join(entry.patterns)}"] if lines else [f"{name}: {' | '.join(entry.patterns)}"]
        lines += [f"  why: {entry.cause}"] if entry.cause else []
        what = entry.remedy or messages.KINDS[entry.do]
        lines.append(f"  {REMEDY}{what}{f' (docs/{entry.see})' if entry.see else ''}")
    return lines


def undo_line(steps: Sequence[Object]) -> str:
    if not steps:
        return "undo: no write left to revert"
    step, more = steps[0], len(steps) - 1
    when = f" of {_minute(step['at'])} UTC" if step["at"] else ""
    several = f" and all since {_minute(step['since'])}" if step["since"] != step["at"] else ""
    further = f"; {more} more after it" if more else ""
    what = step["what"] or "last write"
    return f"the next undo reverts: {what}{when}{several}, {len(step['parameters'])} parameters{further}"


def _minute(iso: str) -> str:
    return iso[:16].replace("T", " ")


def _reading_lines(status: Object) -> list[str]:
    lines, readings, alignment = [], status["readings"], status["alignment"]
    if readings["gradienter_x_deg"] is not None:
        x, y = readings["gradienter_x_deg"], readings["gradienter_y_deg"]
        lines.append(f"gradienter reads: x {x:+.3f} y {y:+.3f} deg")
    if readings["compass_deg"] is not None:
        lines.append(f"compass reads: {readings['compass_deg']:.1f} deg")
    if alignment is not None and alignment["in_force"]:
        (x, y), measured = alignment["offset_deg"], f"measured {alignment['measured_at'][:10]}"
        lines.append(f"gradienter zero: x {x:+.3f} y {y:+.3f} deg, sigma {alignment['sigma_deg']:.3f}, {measured}")
    return lines


def end_lines(status: Object) -> list[str]:
    page, last = status["page"], status["last"]
    lines = [] if page is None else [f"page: {'' if page['good'] else 'none: '}{page['summary']}"]
    found = "none yet"
    if last is not None:
        undone = ", undone" if last["undone_at"] else ""
        found = f"{last['state']} at {_minute(last['started_at'])} UTC{undone}: {without_state(last)}"
    return [*lines, f"last calibration: {found}"]


def monitor_lines(status: Object) -> list[str]:
    lines = []
    if (percent := status["progress"]) is not None:
        lines += [f"[{'#' * (percent * _BAR // 100):.<{_BAR}}] {percent} %", ""]
    if (pose := status["pose"]) is not None:
        heading = f"{_number(pose['heading_deg'], '.1f')} {pose['north'] or ''}"
        lines.append(f"pitch {pose['pitch_deg']:+.2f}  roll {pose['roll_deg']:+.2f}  heading {heading}")
    lines += ["", *_judged(summary.rows(status)), ""]
    lines += _bias_lines(status["calibration"])
    lines.append(f"active calibration: {status['arming']['in_force']}")
    lines += end_lines(status)
    return lines


def _bias_lines(calibration: Object | None) -> list[str]:
    lines = []
    for imu in calibration["imus"] if calibration is not None else ():
        for words, unit, form in (("gyro", "deg_h", "+6.1f"), ("accel", "mg", "+6.2f")):
            biases, sigmas = imu[f"{words}_bias_{unit}"], imu[f"{words}_sigma_{unit}"]
            if biases is None:
                continue
            figures = f"{axes(biases, sigmas, form)}{_held_back(imu, words)}"
            lines.append(f"{imu['name']:8} {words:5} {unit.replace('_', '/'):5} {figures}")
    return lines


def _held_back(imu: Object, triad: str) -> str:
    if triad in imu.get("unchanged", ()):
        return "  not written: the old offsets agree within sigma"
    return "  held back: not written" if triad in imu.get("held_back", ()) else ""


def finding_lines(findings: Sequence[CheckLine]) -> list[str]:
    found = [(one.verdict, one.name, one.words, "" if one.remedy else messages.remedy(one.words)) for one in findings]
    return _judged(found)


def problems(findings: Sequence[CheckLine]) -> str:
    return "; ".join(f"{finding.name}: {finding.words}" for finding in findings if not finding.good)


def failures(steps: Sequence[InstallStep]) -> str:
    return "; ".join(f"{step.what}: {step.words}" for step in steps if step.outcome == "failed")


def _judged(rows: Sequence[tuple[str, str, str, str]]) -> list[str]:
    width = max(len(name) for _, name, _, _ in rows)
    lines = []
    for verdict, name, words, remedy in rows:
        lines.append(f"{verdict:7}  {name if name != verdict else '':{width}}  {words}")
        if remedy and verdict != "ok":
            lines.append(f"{'':{width + 11}}{REMEDY}{remedy}")
    return lines


def history_lines(
    numbers: Sequence[int],
    records: Sequence[Object],
    armings: Sequence[Object],
    by_hand: Sequence[Object],
    flights: Sequence[Object] = (),
    interrupted: Sequence[Object] = (),
) -> list[str]:
    """Format the history, newest first in each section; `numbers` identify the records for `companion report`."""
    lines = ["no calibrations yet"]
    if records:
        lines = [f"{'no.':>4} {'started (UTC)':20} {'vehicle':>7} {'state':10} {'took':>6}  what came of it"]
    lines += [
        f"{number:4} {record['started_at'][:19]:20} {record.get('system_id') or '?':>7} {record['state']:10}"
        f" {record['duration_s']:5.0f}s  {without_state(record)}{_what_became(record)}"
        for number, record in zip(numbers, records, strict=True)
    ]
    if by_hand:
        lines.append(f"{'':4} {'beside these (UTC)':20} what came of it")
        lines += [f"{'':4} {one['measured_at'][:19]:20} {by_hand_words(one)}" for one in by_hand]
    if interrupted:
        lines.append(f"{'':4} {'interrupted (UTC)':20} what became of the old values")
        lines += [f"{'':4} {_interrupted(one)}" for one in interrupted]
    if armings:
        lines.append(f"{'':4} {'armed (UTC)':20} active")
        lines += [
            f"{'':4} {arming['armed_at'][:19]:20} {'' if arming['state'] != 'uncalibrated' else 'UNCALIBRATED: '}"
            f"{arming['reason']}"
            for arming in armings
        ]
    if flights:
        lines.append(f"{'no.':>4} {'flown (UTC)':20} {'what its log says'}")
        lines += [f"{one['number']:4} {_flown(msgspec.convert(one['flight'], Flight))}" for one in flights]
    return lines


def _interrupted(one: Object) -> str:
    ended = f", {_minute(one['ended_at'])}" if one["ended_at"] else ""
    what, number = one["what"] or "write", len(one["parameters"])
    began_at = (one["began_at"] or one["ended_at"] or "time unknown")[:19]
    return f"{began_at:20} {what}, {number} parameters: {one['reason']}{ended}"


def _flown(flight: Flight) -> str:
    return f"{(flight.began_at or 'time unknown')[:19]:20} {figure(flight.imus) or 'no drift known'}"


def by_hand_words(done: Object) -> str:
    words = f"{done['what']}{' failed' if done['state'] == 'failed' else ''}: {done['reason']}"
    if not (number := len(done["written"])):
        return f"{words}; forgotten {_minute(done['undone_at'])}" if done["undone_at"] else words
    if done["undone_at"]:
        return f"{words}; {number} parameters written, undone {_minute(done['undone_at'])}"
    in_force = {True: ", active", False: ", changed by another writer since", None: ""}[done["in_force"]]
    return f"{words}; {number} parameters written{in_force}"


def _what_became(record: Object) -> str:
    written = sum(len(imu["written"]) for imu in record.get("imus", ()))
    if not written or record["state"] != "done":
        return ""
    undone = record.get("undone_at")
    return f"; {written} parameters written" + (f", undone {undone[:19]}" if undone else "")


def temperature_lines(imus: Sequence[Object]) -> list[str]:
    lines: list[str] = []
    for imu in imus:
        lines.append(f"{imu['imu']}: {imu['summary']}")
        curve, now, at_power_up = imu["curve"], imu["now"], imu["at_power_up"]
        columns = [] if now is None else [(f"now {now['degc']:.1f}", now)]
        if at_power_up is not None:
            columns.append((f"power-up at {at_power_up['degc']:.1f}", at_power_up))
        picked = [curve[k * (len(curve) - 1) // 3] for k in range(4)] if len(curve) > 3 else curve
        columns += [(f"{row['degc']:5.0f}", row) for row in picked]
        if columns:
            lines.append(_in_columns("gyro, deg/h", [head for head, _ in columns], columns) + " degC")
            for k, axis in enumerate("xyz"):
                lines.append(_in_columns(axis, [f"{one['gyro_deg_h'][k]:+.0f}" for _, one in columns], columns))
            lines.append(_in_columns("1 sigma", [f"{max(one['sigma_deg_h']):.0f}" for _, one in columns], columns))
        lines += [f"    {words}" for words in (_accelerometers(imu), imu["needs"]) if words]
    return lines


def _in_columns(first: str, cells: Sequence[str], columns: Sequence[tuple[str, Object]]) -> str:
    padded = (f"{cell:>{len(head)}}" for cell, (head, _) in zip(cells, columns, strict=True))
    return f"    {first:<11}  " + "  ".join(padded)


def _accelerometers(imu: Object) -> str | None:
    of_today = [one for one in imu["points"] if one["power_up"] == imu["today"] and one["accel_mg"] is not None]
    if not of_today:
        return None
    last = of_today[-1]
    found = ", ".join(f"{axis} {value:+.2f}" for axis, value in zip("xyz", last["accel_mg"], strict=True))
    return f"accelerometers, mg, at {last['degc']:.1f} degC: {found}, 1 sigma {max(last['accel_sigma_mg']):.2f}"


def curves_written_lines(written: Object | None) -> list[str]:
    if written is None:
        return []
    lines = [f"{name}: {len(each)} parameters" for name, each in written["imus"].items()]
    return lines + [f"warning: {words}" for words in written["warnings"]]


def port_lines(ports: Sequence[SerialPort]) -> list[str]:
    if not ports:
        return ["no serial ports with hardware behind them (plugged in? dmesg says what the kernel saw)"]
    lines: list[str] = []
    for port in ports:
        lines.append(port.stable_name or port.device)
        name = f"{port.device}: " if port.stable_name not in (None, port.device) else ""
        lines.append(f"    {name}{port.description}" + (f", driver {port.driver}" if port.driver else ""))
        if port.stable_name is None:
            lines.append("    no stable name: this one may change at the next plugging (is udev running?)")
        if port.latency_timer_ms is not None and port.latency_timer_ms > 1:
            lines.append(f"    latency timer {port.latency_timer_ms} ms: samples come in bunches; 1 ms is better")
        if port.is_console:
            lines.append("    the kernel's console is on it: remove its console= from the kernel's command line")
        if port.holders:
            lines.append("    in use by " + ", ".join(f"{holder.name} ({holder.pid})" for holder in port.holders))
    return lines

"""Command `replay`, for recordings and for logs of an IMU at rest; command `flight`, for logs of the autopilot."""

from __future__ import annotations

import argparse
import datetime
import itertools
import time
from collections.abc import Mapping, Sequence
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Final

import msgspec

from companion.cli import show
from companion.cli.terminal import CommandGroup, conclude, print_lines, storage_path, within
from companion.errors import ConfigError, StorageError
from companion.estimation.records.flight_record import (
    HEADS,
    UNSEEN,
    Flight,
    ImuFlight,
    KeptFlight,
    Term,
    drift_lines,
    next_flight,
)
from companion.formats import Object
from companion.physics.units import unit_of

if TYPE_CHECKING:
    from companion.lab.estimate import Given
    from companion.lab.flight import Knowledge
    from companion.lab.replay import Replay
    from companion.lab.still_log import StillLog
    from companion.storage.records import FlightStore

# Limits of the text output; --json lists all differences and reasons.
MOST_DIFFERENCES: Final = 20
MOST_REASONS: Final = 12


def add_commands(log: CommandGroup) -> None:
    player = log.add("replay", replay, "calibrate from a recording, or from any log of an IMU at rest")
    player.add_argument(
        "files", nargs="+", type=Path, metavar="FILE",
        help="a recording (.mcap), or several that follow on one another; or a log (CSV; .ulg, .bin)",
    )  # fmt: skip
    _add_log_options(player)
    command = log.add("flight", flight, "judge a flight by the autopilot's log")
    command.add_argument("file", type=Path, metavar="LOG", help="ArduPilot's .bin or PX4's .ulg")


async def replay(options: argparse.Namespace) -> int:
    from companion.lab.log_files import format_of

    try:
        formats = [format_of(file) for file in options.files]
    except StorageError as error:
        raise ConfigError(f"companion log replay: {error}") from None
    if set(formats) == {"recording"}:
        return _replay_recording(options)
    if len(formats) > 1:
        raise ConfigError(f"companion log replay: found {len(formats)} files; allowed with a log: one")
    return _replay_log(options, options.files[0])


def _replay_recording(options: argparse.Namespace) -> int:
    from companion.lab.replay import replay as replay_recordings

    began_s = time.monotonic()
    result = replay_recordings(options.files)
    took_s = time.monotonic() - began_s
    different = any(each.differences for each in result.calibrations)
    lines = _lines(result)
    state = "different" if different else "done" if result.calibrations else "failed"
    cut = f"; the recording ends early: {result.cut_short}" if result.cut_short else ""
    print_lines(f"replayed {result.seconds:.0f} s in {took_s:.1f} s{cut}", error=True)
    print_lines(*(f"note: {note}" for note in result.notes), error=True)
    keys = ("calibrations", "seconds", "cut_short", "notes")
    found = {key: msgspec.to_builtins(getattr(result, key)) for key in keys}
    return conclude(options, {"state": state, "reason": lines[-1], **found}, lines, good=state == "done")


def _lines(result: Replay) -> list[str]:
    """Describe the result of a replay in lines of text; the last line is the verdict."""
    from companion.lab.replay import TOLERANCE_SIGMAS

    lines: list[str] = []
    different = 0
    worst = [each.worst_sigmas for each in result.calibrations if each.worst_sigmas is not None]
    for each in result.calibrations:
        lines.append(f"calibration of {each.record.started_at}")
        lines += show.record_lines(msgspec.to_builtins(each.record))
        if each.not_recomputed is not None:
            lines.append(f"not recomputed: {each.not_recomputed}")
        different += bool(each.differences)
        lines += [f"DIFFERENT {difference}" for difference in each.differences[:MOST_DIFFERENCES]]
        if len(each.differences) > MOST_DIFFERENCES:
            lines.append(f"... and {len(each.differences) - MOST_DIFFERENCES} more (--json has them all)")
    if not result.calibrations:
        lines.append("no calibration in the recording: calibrate while it runs")
    elif different:
        lines.append(f"{different} of {len(result.calibrations)} calibrations came out different")
    else:
        agree = f"; biases within {TOLERANCE_SIGMAS:g} sigma (at most {max(worst):.1g})" if worst else ""
        lines.append(f"{len(worst)} of {len(result.calibrations)} calibrations recomputed{agree}")
    return lines


def _add_log_options(parser: argparse.ArgumentParser) -> None:
    log = parser.add_argument_group("for a log (docs/recording.md)")
    add_table_options(log)
    log.add_argument("--imu", metavar="NAME", help="which one, where there are several")
    for name, least, most, default, unit, words in (
        ("pitch-deg", -84.0, 84.0, None, "DEG", "nose up"),
        ("roll-deg", -180.0, 180.0, None, "DEG", "right side down"),
        ("heading-deg", -360.0, 360.0, None, "DEG", "clockwise from true north"),
        ("latitude-deg", -90.0, 90.0, None, "DEG", "north is positive"),
        ("height-m", -500.0, 9000.0, None, "M", "above mean sea level"),
        ("sigma-deg", 1e-4, 45.0, 0.05, "DEG", "of pitch and roll (default 0.05)"),
        ("heading-sigma-deg", 1e-3, 180.0, 3.0, "DEG", "default 3"),
        ("powered", 0.0, 1e6, 0.0, "S", "time since switch-on when the log began (default 0), for the warm-up"),
        ("windows", 10.0, 3600.0, None, "S", "calibrate in every window of this length; check sigma by the next"),
    ):
        log.add_argument(f"--{name}", type=within(least, most), default=default, metavar=unit, help=words)
    log.add_argument("--mounting", default="ROTATION_NONE", metavar="ROTATION", help="sensor to vehicle")
    log.add_argument("--any-bias", action="store_true", help="take biases beyond what any part has (30 deg/s, 0.3 g)")
    log.add_argument(
        "--profile", metavar="PART", help="the sensor's model, such as icm42688p, or a saved profile's name or file"
    )


def add_table_options(parser: argparse._ActionsContainer) -> None:
    parser.add_argument(
        "--columns",
        metavar="NAMES",
        help="in place of the header: t_ms,gx_deg_s,gy_deg_s,gz_deg_s,ax_g,ay_g,az_g (_: skipped)",
    )
    parser.add_argument(
        "--rate", type=within(4.0, 10000.0), metavar="HZ", help="of a log without times, or in their place"
    )


def _replay_log(options: argparse.Namespace, file: Path) -> int:
    from companion.lab.estimate import estimate

    given = _given(options)
    log = _log(options, file)
    if options.windows is not None:
        return _windows(options, log, given)
    found, used = estimate(log, given)
    record = msgspec.to_builtins(found)
    lines = [*show.record_lines(record), *_used_lines(used)]
    answer = {**record, "log": used}
    return conclude(options, answer, lines, good=found.state == "done")


def _log(options: argparse.Namespace, file: Path) -> StillLog:
    from companion.lab.log_files import read_logs

    logs = read_logs([file], options.columns, options.rate)
    named = [log for log in logs if options.imu in (None, log.imu)]
    if len(named) == 1:
        return named[0]
    names = ", ".join(log.imu for log in logs)
    if named or options.imu is None:
        raise ConfigError(f"{file}: found IMUs {names}; allowed: one; say which with --imu")
    raise StorageError(f"no IMU {options.imu!r} in these files; there are: {names}")


def _given(options: argparse.Namespace) -> Given:
    from companion.lab.estimate import Given
    from companion.rotations import ROTATIONS_DEG
    from companion.storage.profiles import given_profile

    if options.mounting not in ROTATIONS_DEG:
        raise ConfigError(f"--mounting: found {options.mounting}; allowed: a MAVLink rotation such as ROTATION_YAW_90")
    if (options.pitch_deg is None) != (options.roll_deg is None):
        raise ConfigError("found only one of --pitch-deg and --roll-deg; allowed: both or neither")
    given = Given(**{name: getattr(options, name) for name in Given.__struct_fields__})
    if options.profile is None:
        return given
    return msgspec.structs.replace(given, profile=given_profile(options.profile, lambda: storage_path(options)))


def _windows(options: argparse.Namespace, log: StillLog, given: Given) -> int:
    from companion.lab.estimate import windows

    count, refused, axes = windows(log, given, options.windows)
    done = count - sum(refused.values())
    reason = "" if axes else "no two windows in a row that can be calibrated"
    if reason:
        print_lines(f"companion: {reason}", error=True)
    found = {"length_s": options.windows, "count": count, "done": done, "refused": refused}
    answer = {
        "state": "failed" if reason else "done",
        "reason": reason,
        "windows": {**found, "axes": axes},
        "log": {"left_out": log.left_out, "notes": log.notes},
    }
    lines = [f"windows of {options.windows:g} s: {count}, calibrated: {done}"]
    lines += [f"not calibrated: {number}: {why}" for why, number in [*refused.items()][:MOST_REASONS]]
    lines += [*_axis_lines(axes), *log_lines(log.left_out, log.notes)]
    return conclude(options, answer, lines, good=not reason)


def _axis_lines(axes: Sequence[Object]) -> list[str]:
    lines = []
    for next_s, group in itertools.groupby(axes, key=itemgetter("next_s")):
        rows = list(group)
        lines.append(f"against the next {next_s:g} s, {rows[0]['pairs']} pairs:")
        lines.append(f"{'':16} {'sigma_use':>10} {'rms error':>10} {'over sigma':>10} {'2 sigma':>8}")
        for each in rows:
            unit, name, _ = unit_of(each["axis"])
            digits = 1 if name == "deg/h" else 3
            sigma, rms = (f"{each[key] / unit:>10.{digits}f}" for key in ("sigma_use", "rms"))
            lines.append(f"{each['axis'] + ', ' + name:16} {sigma} {rms} {each['ratio']:>10.2f} {each['share']:>8.1%}")
    return lines


def _used_lines(used: Object) -> list[str]:
    lines = []
    if used["from_s"] is not None:
        still = f"{used['still_s']} s of it at rest"
        lines.append(f"used: {used['from_s']:.0f} to {used['to_s']:.0f} s of {used['seconds']:.1f} s; {still}")
    return lines + log_lines(used["left_out"], used["notes"])


def log_lines(left_out: Mapping[str, int], notes: Sequence[str]) -> list[str]:
    lines = [f"left out: {count} lines {why}" for why, count in left_out.items()]
    return lines + [f"note: {note}" for note in notes]


# --- flights


async def flight(options: argparse.Namespace) -> int:
    from companion.lab.flight import flights, read

    path = options.file
    known, store = _knowledge(options)
    starts, imus, lines, found = 0, 0, [], []
    for boot in read(path):
        starts, imus = starts + 1, imus + len(boot.imus)
        for each in await flights(boot, known):
            found.append(each)
            lines += _flight_lines(starts, each)
    if not imus:
        raise StorageError(f"{path}: no samples of an IMU in it")
    if not found:
        raise StorageError(f"{path}: no attitude and position of an EKF3 (ArduPilot) or EKF2 (PX4) in it")
    if starts > 1:
        lines.insert(0, f"{starts} starts of the autopilot in it, each by its own clock")
    numbers = [] if store is None else _keep(store, path.name, found)
    lines += [f"kept as flight {number}: companion history lists it" for number in numbers]
    told = msgspec.to_builtins(found)
    answer = {"state": "done", "reason": "", "file": str(path), "numbers": numbers, "flights": told}
    return conclude(options, answer, lines, good=True)


def _knowledge(options: argparse.Namespace) -> tuple[Knowledge, FlightStore | None]:
    """Read this computer's records and learned biases; return them (empty if unreadable) and the store of flights."""
    from companion.storage.records import BiasStore, FlightStore, RecordStore

    directory = storage_path(options)
    try:
        known = RecordStore(directory).history(), BiasStore(directory).all()
    except StorageError as error:
        words = "looked at without the companion's history, and not kept; sudo may help"
        print_lines(f"note: {error}: {words}", error=True)
        return ((), {}), None
    return known, FlightStore(directory)


def _keep(store: FlightStore, log: str, found: Sequence[Flight]) -> list[int]:
    read_at = datetime.datetime.now(tz=datetime.UTC).isoformat(timespec="seconds")
    flown = [each for each in found if any(imu.drift for imu in each.imus)]
    if flown and not store.folder.parent.is_dir():
        where = f"this computer has no companion's storage ({store.folder.parent})"
        print_lines(f"note: not kept: {where}; on the companion flights are kept for the history", error=True)
        return []
    try:
        return [store.save(KeptFlight(log=log, read_at=read_at, flight=each)) for each in flown]
    except StorageError as error:
        print_lines(f"note: not kept: {error}", error=True)
        return []


def _flight_lines(number: int, found: Flight) -> list[str]:
    stages = found.stages
    when = f"flight of {found.began_at}" if found.began_at else "flight at an unknown time"
    since = f"{stages.armed_s:.0f} s after" if stages.armed_s < 1e8 else "in"  # A simulated PX4's clock starts in 1970
    begun = f"{since} start {number} of the autopilot"
    start = f"{when}: {f'armed {begun}' if stages.is_arming_logged else f'no arming in the log, which begins {begun}'}"
    after = "arming" if stages.is_arming_logged else "that"
    told = [
        f"{what} {at_s - stages.armed_s:.0f} s"
        for what, at_s in (
            ("motors", stages.motors_s), ("take-off", stages.take_off_s), ("landing", stages.landing_s),
            ("disarmed", stages.disarmed_s),
        )
        if at_s is not None
    ]  # fmt: skip
    lines = [start, f"  after {after}: {', '.join(told) or 'nothing more is logged'}"]
    if found.reference == "truth":
        lines.append("  measured from the simulator's truth, not from the EKF")
    lines += [f"  note: {note}" for note in found.notes]
    for imu in found.imus:
        lines += _imu_lines(imu)
    if any(axis.in_flight for imu in found.imus for axis in imu.axes):
        lines += ["left over: bias that the offsets did not take off, ± one sigma (docs/flight.md)", f"  {UNSEEN}"]
    return [*lines, *([f"next flight: {next_flight(found)}"] if any(imu.drift for imu in found.imus) else [])]


def _imu_lines(imu: ImuFlight) -> list[str]:
    whose = f"offsets of {f'the calibration of {imu.calibration}' if imu.calibration else 'no calibration known here'}"
    lines = [f"IMU {imu.imu}, {imu.rate_hz:.0f} Hz: {whose}"]
    lines += [f"  note: {note}" for note in imu.notes]
    lines += [f"  {words}" for words in drift_lines(imu)]
    if any(axis.in_flight for axis in imu.axes):
        lines += [f"  {words}" for words in _table(imu)]
    return lines


def _table(imu: ImuFlight) -> list[str]:
    shown = [term for term in HEADS if any(getattr(axis, term) for axis in imu.axes)]
    lines = [f"{'left over':13}" + "".join(f"{HEADS[term]:>13}" for term in shown)]
    for axis in imu.axes:
        unit, name, digits = unit_of(axis.axis)
        terms = [_term(getattr(axis, term), unit, digits) for term in shown]
        lines.append(f"{', '.join((axis.axis, name)):13}" + "".join(f"{each:>13}" for each in terms))
    if lacking := [head for term, head in HEADS.items() if term not in shown]:
        lines.append(f"not known: {', '.join(lacking)}")
    return lines


def _term(term: Term | None, unit: float, digits: int) -> str:
    if term is None:
        return "?"
    # Adding zero avoids "-0".
    return f"{round(term.value / unit, digits) + 0.0:+.{digits}f} ± {term.sigma / unit:.{digits}f}"

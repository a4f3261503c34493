"""`companion replay`: a recording, or anybody's log of an IMU at rest, through the same estimator."""

from __future__ import annotations

import argparse
import itertools
import time
from pathlib import Path
from typing import TYPE_CHECKING, Final

import msgspec

from companion.cli import show
from companion.cli.terminal import AddCommand, conclude, print_lines, storage_path, within
from companion.errors import ConfigError, StorageError
from companion.physics.units import unit_of

if TYPE_CHECKING:
    from companion.lab.logs.log import StillLog
    from companion.lab.replay.engine import Result
    from companion.lab.replay.estimate import Given, Used
    from companion.lab.replay.windows import Windows

# --json has them all.
MOST_DIFFERENCES: Final = 20
MOST_REASONS: Final = 12


def add_command(add: AddCommand) -> None:
    player = add("replay", replay, "run a recording, or anybody's log of an IMU at rest, through the same estimator")
    player.add_argument(
        "files", nargs="+", type=Path, metavar="FILE",
        help="a recording (.mcap), or several that follow on one another; or a log (CSV; .ulg, .bin)",
    )  # fmt: skip
    _add_log_options(player)


async def replay(options: argparse.Namespace) -> int:
    from companion.lab.logs.log_files import reader_of
    from companion.lab.logs.recording import is_text

    logs = []
    for file in options.files:
        try:
            logs += [file] if reader_of(file) is not None or is_text(file) else []
        except OSError as error:
            raise ConfigError(f"companion replay: {file}: {error.strerror or error}") from None
    if not logs:
        return _replay_recording(options)
    if len(options.files) > 1:
        raise ConfigError(f"companion replay: found {len(options.files)} files; allowed with a log: one")
    return _replay_log(options, logs[0])


def _replay_recording(options: argparse.Namespace) -> int:
    from companion.lab.replay import engine

    began_s = time.monotonic()
    result = engine.replay(options.files)
    took_s = time.monotonic() - began_s
    different = [difference for each in result.calibrations for difference in each.differences]
    lines = _lines(result)
    reason = lines[-1]
    good = bool(result.calibrations) and not different
    state = "different" if different else "done" if good else "failed"
    print_lines(
        f"replayed {result.seconds:.0f} s in {took_s:.1f} s"
        + (f"; the recording ends early: {result.cut_short}" if result.cut_short else ""),
        error=True,
    )
    for note in result.notes:
        print_lines(f"note: {note}", error=True)
    return conclude(options, {"state": state, "reason": reason, **msgspec.to_builtins(result)}, lines, good=good)


def _lines(result: Result) -> list[str]:
    """Describe the result; the last line is the verdict."""
    from companion.lab.replay.engine import TOLERANCE_SIGMAS

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
        (
            "powered",
            0.0,
            1e6,
            0.0,
            "S",
            "time since switch-on when the log began (default 0): what it may still warm up",
        ),
        (
            "windows",
            10.0,
            3600.0,
            None,
            "S",
            "calibrate in every window of so many seconds, and check sigma by the next",
        ),
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
        help="in place of the header: t_ms,gx_deg_s,gy_deg_s,gz_deg_s,ax_g,ay_g,az_g (-: passed over)",
    )
    parser.add_argument(
        "--rate", type=within(4.0, 10000.0), metavar="HZ", help="of a log without times, or in their place"
    )


def _replay_log(options: argparse.Namespace, file: Path) -> int:
    from companion.lab.replay.estimate import estimate

    given = _given(options)
    log = _log(options, file)
    if options.windows is not None:
        return _windows(options, log, given)
    found, used = estimate(log, given)
    record = msgspec.to_builtins(found)
    lines = [*show.record_lines(record), *_used_lines(used)]
    answer = {**record, "log": msgspec.to_builtins(used)}
    return conclude(options, answer, lines, good=found.state == "done")


def _log(options: argparse.Namespace, file: Path) -> StillLog:
    from companion.lab.logs.log_files import read_logs

    logs = read_logs([file], options.columns, options.rate)
    named = [log for log in logs if options.imu in (None, log.imu)]
    if len(named) == 1:
        return named[0]
    names = ", ".join(log.imu for log in logs)
    if named or options.imu is None:
        raise ConfigError(f"{file}: found IMUs {names}; allowed: one; say which with --imu")
    raise StorageError(f"no IMU {options.imu!r} in these files; there are: {names}")


def _given(options: argparse.Namespace) -> Given:
    from companion.lab.replay.estimate import Given
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
    from companion.lab.replay.windows import windows

    found = windows(log, given, options.windows)
    reason = "" if found.axes else "no two windows in a row that can be calibrated"
    state = "done" if found.axes else "failed"
    if reason:
        print_lines(f"companion: {reason}", error=True)
    said = {"left_out": log.left_out, "notes": log.notes}
    answer = {"state": state, "reason": reason, "windows": msgspec.to_builtins(found), "log": said}
    lines = [*_window_lines(found), *(f"note: {note}" for note in log.notes)]
    return conclude(options, answer, lines, good=bool(found.axes))


def _window_lines(found: Windows) -> list[str]:
    lines = [f"windows of {found.length_s:g} s: {found.count}, calibrated: {found.done}"]
    lines += [f"not calibrated: {count}: {why}" for why, count in [*found.refused.items()][:MOST_REASONS]]
    for next_s, axes in itertools.groupby(found.axes, key=lambda each: each.next_s):
        rows = list(axes)
        lines.append(f"against the next {next_s:g} s, {rows[0].pairs} pairs:")
        lines.append(f"{'':16} {'sigma_use':>10} {'rms error':>10} {'over sigma':>10} {'2 sigma':>8}")
        for each in rows:
            unit, name, _ = unit_of(each.axis)
            digits = 1 if name == "deg/h" else 3
            figures = f"{each.sigma_use / unit:>10.{digits}f} {each.rms / unit:>10.{digits}f} {each.ratio:>10.2f}"
            lines.append(f"{f'{each.axis}, {name}':16} {figures} {each.share:>8.1%}")
    return lines


def _used_lines(used: Used) -> list[str]:
    lines = []
    if used.from_s is not None and used.to_s is not None:
        still = f"{used.still_s} s of it at rest"
        lines.append(f"used: {used.from_s:.0f} to {used.to_s:.0f} s of {used.seconds:.1f} s; {still}")
    lines += [f"left out: {count} lines {why}" for why, count in used.left_out.items()]
    return [*lines, *(f"note: {note}" for note in used.notes)]

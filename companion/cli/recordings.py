"""`companion replay`."""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from companion.cli import replay_log, show
from companion.cli.terminal import AddCommand, conclude, print_lines
from companion.errors import ConfigError

if TYPE_CHECKING:
    from companion.lab.replay.engine import Result

MOST_LINES = 20
"""Most differences that are shown; --json has them all."""


def add_command(add: AddCommand) -> None:
    """Add `replay` to the parser of the command line."""
    player = add("replay", replay, "run a recording, or anybody's log of an IMU at rest, through the same estimator")
    player.add_argument(
        "files", nargs="+", type=Path, metavar="FILE",
        help="a recording (.mcap), or several that follow on one another; or a log (CSV; .ulg, .bin)",
    )  # fmt: skip
    replay_log.add_options(player)


async def replay(options: argparse.Namespace) -> int:
    """`companion replay`."""
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
    return replay_log.replay(options, logs[0])


def _replay_recording(options: argparse.Namespace) -> int:
    from companion.lab.replay import engine

    began_s = time.monotonic()
    result = engine.replay(options.files)
    took_s = time.monotonic() - began_s
    different = [difference for each in result.calibrations for difference in each.differences]
    lines = _lines(result)
    reason = lines[-1]
    good = not different and (result.estimate is None or result.estimate.state == "done")
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
    """For people; the last line is the verdict."""
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
        lines += [f"DIFFERENT {difference}" for difference in each.differences[:MOST_LINES]]
        if len(each.differences) > MOST_LINES:
            lines.append(f"... and {len(each.differences) - MOST_LINES} more (--json has them all)")
    if result.estimate is not None:
        lines.append("no calibration in the recording; what one would have found at its end:")
        lines += show.record_lines(msgspec.to_builtins(result.estimate))
        lines.append(result.estimate.reason)
    elif different:
        lines.append(f"{different} of {len(result.calibrations)} calibrations came out different")
    else:
        agree = f"; biases within {TOLERANCE_SIGMAS:g} sigma (at most {max(worst):.1g})" if worst else ""
        lines.append(f"{len(worst)} of {len(result.calibrations)} calibrations recomputed{agree}")
    return lines

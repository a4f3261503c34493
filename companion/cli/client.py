"""Commands that send requests to the running daemon."""

from __future__ import annotations

import argparse
import asyncio
import math
import os
import shutil
import sys
import textwrap
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Final

from companion import commands, messages
from companion.cli import show
from companion.cli.monitor import FIGURES, monitor
from companion.cli.terminal import (
    CommandGroup,
    DaemonRefusedError,
    add_fields,
    conclude,
    load_config,
    print_lines,
    request_of,
)
from companion.errors import DaemonDeniedError, DaemonUnreachableError
from companion.formats import Object
from companion.links.system.connection import ask

SILENT_S: Final = 2.0  # Silence after which the command reports that it waits for an answer
CANCEL: Final = {"command": "cancel"}
ALIGNMENTS: Final = {
    "zero": ("the gradienter's zero, by turning it on one place", ("headings", "timeout_s")),
    "tilts": ("the zero, and the accelerometers' scale on four tilts", ("headings", "timeout_s")),
    "turn": (
        "accelerometers without a gradienter, by turning on one place",
        ("headings", "level", "write", "timeout_s"),
    ),
    "faces": ("accelerometers by hand, in about 11 poses on any side", ("write", "timeout_s")),
    "compass": (
        "the autopilot's compasses, by turning on one place (no heading need be known)",
        ("headings", "heading", "sides", "write", "timeout_s"),
    ),
    "show": ("show the stored alignment", ()),
    "forget": ("return to the zero and sigma of the configuration; a faces alignment stays", ()),
}
"""Kinds of `companion align`: help, and the fields of the request that each uses."""


def add_commands(top: CommandGroup, autopilot: CommandGroup, log: CommandGroup) -> None:
    for to, name, kind, command in (
        (top, "status", commands.Status, status),
        (top, "calibrate", commands.Calibrate, calibrate),
        (top, "fix", commands.Fix, partial(calibrate, kind=commands.Fix)),
        (top, "cancel", commands.Cancel, cancel),
        (top, "undo", commands.Undo, undo),
        (top, "history", commands.History, history),
        (autopilot, "params", commands.AutopilotSetup, setup),
        (autopilot, "temperature", commands.Temperature, temperature),
        (log, "record", commands.RecordInputs, record),
    ):
        add_fields(to.add(name, command, kind.help), kind, commands.Interface.COMMAND_LINE)
    top["status"].add_argument("--watch", action="store_true", help="go on until Ctrl-C")
    option = top["calibrate"].add_argument
    option("--no-wait", dest="wait", action="store_false", help="start it and return at once")
    option("--wait", action="store_true", default=True, help=argparse.SUPPRESS)  # the default since 0.3
    actions = top.group("align", commands.Align.help)
    for action, (words, fields) in ALIGNMENTS.items():
        sub = actions.add(action, align, words)
        sub.set_defaults(action=action)
        add_fields(sub, commands.Align, commands.Interface.COMMAND_LINE, fields)


class Progress:
    """Progress on stderr: on a terminal the last text counts in place; elsewhere a line is printed per step or 10 %."""

    def __init__(self) -> None:
        self._in_place = sys.stderr.isatty() and os.environ.get("TERM") != "dumb"
        self._rows: list[str] = []
        self._step = ""

    def show(self, percent: int, words: str) -> None:
        line = f"[{percent:3d} %] {words}"
        rows = textwrap.wrap(line, max(shutil.get_terminal_size().columns - 1, 20)) if self._in_place else [line]
        step = FIGURES.sub("", words) + ("" if self._in_place else f" {percent // 10}")
        if self._in_place and rows != self._rows:
            up = f"\x1b[{len(self._rows) - 1}A" if len(self._rows) > 1 else ""
            sys.stderr.write(f"\r{up}\x1b[J" if step == self._step else "\n" if self._rows else "")
            print_lines(*rows[:-1], error=True)
            print_lines(rows[-1], end="", error=True)
        elif step != self._step:
            print_lines(*rows, error=True)
        self._rows, self._step = rows, step

    def close(self) -> None:
        if self._in_place and self._rows:
            print_lines("", error=True)


async def request(options: argparse.Namespace, wanted: Object, at_interrupt: Object | None = None) -> Object:
    """Send a request, show its progress on stderr, return its result.

    Ctrl-C after the first reply sends the request `at_interrupt`; None: the daemon continues.

    Raises:
        DaemonRefusedError: the daemon refuses the request.
    """
    reply: Object = {}
    progress = Progress()
    ends = "Ctrl-C ends the waiting alone" if at_interrupt is None else "Ctrl-C cancels"
    waiting = f"waiting for the daemon's answer; {ends}"
    silent = asyncio.get_running_loop().call_later(SILENT_S, lambda: print_lines(waiting, error=True))
    try:
        async for reply in ask(load_config(options).control.path, wanted):
            silent.cancel()
            if reply["kind"] == "progress":
                words = ": ".join(filter(None, (reply.get("word", reply["state"]), reply["text"])))
                found = messages.explain(reply["text"])
                if found is not None and found[1].do in ("hardware", "setting"):
                    words += f" {show.REMEDY}{found[1].advice()}"
                progress.show(reply["percent"], words)
    except asyncio.CancelledError:
        if at_interrupt is None or not reply:
            raise
        return await request(options, at_interrupt | {"face": "interrupt"})
    finally:
        silent.cancel()
        progress.close()
    if reply.pop("kind") == "error":
        raise DaemonRefusedError(reply["reason"])
    return reply


def _conclude(options: argparse.Namespace, answer: Object, lines: Sequence[str], *, good: bool) -> int:
    """Print the daemon's answer, with the remedy after a failure; return the exit code."""
    remedy = "" if good else messages.remedy(answer.get("reason") or "")
    return conclude(options, answer, [*lines, *([f"{show.REMEDY}{remedy}"] if remedy else [])], good=good)


async def status(options: argparse.Namespace) -> int:
    if options.watch:
        return await monitor(options)
    answer = (await request(options, {"command": "status"}))["status"]
    return conclude(options, answer, show.status_lines(answer), good=True)


async def calibrate(options: argparse.Namespace, kind: type[commands.Command] = commands.Calibrate) -> int:
    waits = getattr(options, "wait", True)
    reply = await request(options, request_of(options, kind), CANCEL if waits else None)
    if "record" not in reply:
        return _conclude_briefly(options, reply, good=not waits or reply["state"] == "done")
    record = reply["record"]
    return _conclude(options, record, show.record_lines(record), good=record["state"] == "done")


def _conclude_briefly(options: argparse.Namespace, reply: Object, *, good: bool = True) -> int:
    answer = {key: reply.get(key) for key in ("state", "reason")}
    return _conclude(options, answer, [reply["reason"]], good=good)


async def cancel(options: argparse.Namespace) -> int:
    return _conclude_briefly(options, await request(options, CANCEL))


async def undo(options: argparse.Namespace, kind: type[commands.Command] = commands.Undo) -> int:
    reply = await request(options, request_of(options, kind))
    answer = {key: reply.get(key) for key in ("state", "reason", "written", "undone", "undoable")}
    undone = (answer["undone"] or {}).get("what", "")
    lines = [_heading(answer), *show.written_lines(answer["written"] or {})]
    lines += ["automatic calibration is off until you calibrate"] if undone.endswith("calibration") else []
    lines.append(show.undo_line(answer["undoable"] or ()))
    return _conclude(options, answer, lines, good=answer["state"] == "done")


async def history(options: argparse.Namespace) -> int:
    """Show the history: the daemon's, or without a daemon the stored one."""
    try:
        reply = await request(options, request_of(options, commands.History))
    except DaemonUnreachableError as error:
        if isinstance(error, DaemonDeniedError) or not (storage := load_config(options).storage.path).is_dir():
            raise
        from companion.storage.records import stored_history

        print_lines(f"companion: {error}; the stored history:", error=True)
        reply = stored_history(storage, options.limit)
    keys = ("numbers", "records", "armings", "by_hand", "interrupted", "flights")
    answer = {key: reply.get(key, []) for key in keys}
    return conclude(options, answer, show.history_lines(**answer), good=True)


async def temperature(options: argparse.Namespace) -> int:
    if options.action == "undo":
        return await undo(options, commands.Temperature)
    wanted = request_of(options, commands.Temperature)
    if options.action == "write" or options.overwrite:
        reply = await request(options, {**wanted, "action": "write"}, CANCEL)
        answer: Object = {key: reply.get(key) for key in ("state", "reason", "written")}
        lines = [_heading(answer), *show.curves_written_lines(answer["written"])]
        return _conclude(options, answer, lines, good=answer["state"] == "done")
    imus = (await request(options, wanted)).get("imus", [])
    return conclude(options, {"imus": imus}, show.temperature_lines(imus), good=True)


def _heading(answer: Object) -> str:
    state: str = answer["state"].upper()
    return f"{state}: {show.without_state(answer)}" if answer["reason"] else state


async def setup(options: argparse.Namespace) -> int:
    answer = await request(options, {"command": "autopilot-setup"})
    return conclude(options, answer, setup_lines(answer), good=True)


async def align(options: argparse.Namespace) -> int:
    wanted = request_of(options, commands.Align)
    answer = {"alignment": None, **await request(options, wanted, CANCEL)}
    alignment, state = answer["alignment"], answer["state"]
    lines = [_heading(answer), *(pose_lines(alignment) if alignment else [])]
    lines += six_position_lines(answer.get("accelerometers", ()))
    good = state in ("done", "active") or (wanted["action"] == "show" and state != "refused")
    return _conclude(options, answer, lines, good=good)


async def record(options: argparse.Namespace) -> int:
    wanted, stop = request_of(options, commands.RecordInputs), {"command": "record", "stop": True}
    if "file" in wanted:
        wanted["file"] = str(Path.cwd() / wanted["file"])
    answer = await request(options, wanted, stop)
    lines: list[str] = []
    if "file" in answer:
        lost = f", {answer['lost']} messages lost" if answer["lost"] else ""
        size = f"{answer['seconds']:.0f} s, {answer['bytes'] / 1e6:.1f} MB"
        lines = [f"{answer['file']}: {size}{lost}; {answer['reason']}"]
    return _conclude(options, answer, lines, good=answer.get("state") == "done")


def setup_lines(answer: Object) -> list[str]:
    net = answer["net"]
    heading = answer["reason"] if net is None else f"{answer['state']}: {answer['reason']}"
    lines = [f"heading: {heading}", *map(_row, answer["parameters"])]
    lines += [] if net is None else [f"safety net: {net['words']}", *(f"risk: {risk}" for risk in answer["risks"])]
    gate = answer["gate"]
    how = gate["problem"] or "the autopilot asks before it arms"
    lines.append(f"gate: {how}" if gate["at_arm"] == "gate" else f"gate: not wanted; for at_arm = gate: {how}")
    lines += [f"rival: {words}" for words in answer["rivals"]] or ["rivals: none: nothing overwrites the offsets"]
    return lines


def _row(row: Object) -> str:
    now, wanted = _number(row["now"]), _number(row["wanted"])
    change = f"{now} -> {wanted}" if now != wanted else now
    return f"  {row['parameter']:16} {change:12}  {row['why']}"


def _number(value: float | None) -> str:
    return "none" if value is None else f"{value:g}"


def six_position_lines(imus: Sequence[Object]) -> list[str]:
    lines = []
    for imu in imus:
        lines.append(f"{imu['name']}: faces alignment, {imu['measured_at'][:19]} UTC; errors left in its output:")
        lines.append(_figure_line("accel bias", "mg", imu["bias_left_mg"], imu["bias_sigma_mg"], "+.3f"))
        lines.append(_figure_line("accel scale", "%", imu["scale_left"], imu["scale_sigma"], "+.4f", 0.01))
    return lines


_FIGURES: Final = {
    "accel_bias_mg": ("accel bias", "mg", "+.3f", 1.0),
    "accel_scale": ("accel scale", "%", "+.4f", 0.01),
    "accel_shear": ("accel shear", "%", "+.4f", 0.01),
    "misalignment_deg": ("misalignment", "deg", "+.3f", 1.0),
    "gyro_bias_deg_h": ("gyro bias", "deg/h", "+.1f", 1.0),
}
_SHOWN: Final = {"faces": ("accel_bias_mg", "accel_scale", "accel_shear"), "turn": ()}
"""Figures to print for a kind of alignment; kinds not in this table print all known figures except the shear."""


def _figure_line(
    words: str, unit: str, values: Sequence[float], sigma: Sequence[float] | None, form: str, scale: float = 1.0
) -> str:
    return f"  {words:16} {unit:6} {show.axes(values, sigma, form, scale)}"


def _bias_lines(words: str, whole: Sequence[float] | None, left: Sequence[float], sigma: Sequence[float]) -> list[str]:
    """Format an accelerometer's whole bias, and its change: the residual bias `left` in the autopilot's output."""
    if words == "slant when level" or whole is None:
        return [_figure_line(words, "mg", left, sigma, "+.3f")]
    return [_figure_line(words, "mg", whole, sigma, "+.3f"), _figure_line("  change", "mg", left, None, "+.3f")]


def compass_lines(record: Object) -> list[str]:
    turns = " ".join(f"{turn:+.0f}" for turn in record["turns_deg"])
    heading = f"{record['heading_deg']:.1f} +- {record['heading_sigma_deg']:.1f} deg, then {turns or 'no turn'}"
    tilt = f"tilt up to {record['tilt_deg']:.1f} deg"
    lines = [f"measured {record['measured_at'][:19]} UTC; first heading {heading}; {tilt}"]
    for one in record["compasses"]:
        good = f"{one['heading_sigma_deg']:.1f} deg, leaned by 10 deg {one['heading_sigma_leaned_deg']:.1f}"
        lines += [
            f"compass {one['number']}: heading good to {good}; it was up to {one['heading_before_deg']:.1f} deg off",
            _figure_line("hard iron", "mG", one["offset_mgauss"], one["offset_sigma_mgauss"], "+.1f"),
            _figure_line("soft iron", "", one["soft_diagonal"], None, "+.4f"),
            *show.written_lines(one["written"]),
        ]
    return [*lines, *(f"warning: {words}" for words in record["warnings"])]


def pose_lines(record: Object) -> list[str]:
    if record["kind"] == "compass":
        return compass_lines(record)
    slope = f"; the spot slopes by {record['slope_deg']:.2f} deg" if "slope_deg" in record else ""
    lines = [f"measured {record['measured_at'][:19]} UTC in {len(record['stands'])} poses{slope}"]
    if "gradienter" in record:
        (x, y), sigma = record["offset_deg"], record["sigma_deg"]
        worth_mg = 1e3 * math.radians(sigma)
        lines.append(
            f"gradienter zero: x {x:+.4f} y {y:+.4f} deg, sigma {sigma:.4f} deg, {worth_mg:.2f} mg horizontally"
        )
    for imu in record["imus"]:
        scatter = f" poses miss gravity by {imu['scatter_mg']:.2f} mg" if "scatter_mg" in imu else ""
        lines.append(f"{imu['name']}:{scatter}")
        whole = imu.get("whole_bias_mg")
        if "level_bias_mg" in imu:
            # After a six-position calibration the remaining bias when level comes from the tilt of the board.
            words = "bias when level" if record.get("board") is None else "slant when level"
            lines += _bias_lines(words, whole, imu["level_bias_mg"], imu["level_sigma_mg"])
        known = [key for key in _FIGURES if key != "accel_shear" and key in imu and all(imu[key]["known"])]
        for key in _SHOWN.get(record["kind"], known):
            words, unit, form, scale = _FIGURES[key]
            if key == "accel_bias_mg":
                lines += _bias_lines(words, whole, imu[key]["value"], imu[key]["sigma"])
                continue
            lines.append(_figure_line(words, unit, imu[key]["value"], imu[key]["sigma"], form, scale))
        lines += show.written_lines(imu.get("written", {}))
    if (board := record.get("board")) is not None:
        roll, pitch = board["sigma_deg"]
        lines.append(
            f"the board of {board['imu']} sits at roll {board['roll_deg']:+.3f} +- {roll:.3f},"
            f" pitch {board['pitch_deg']:+.3f} +- {pitch:.3f} deg"
            + ("" if board["written"] else "; companion align turn --level tells it the autopilot")
        )
        lines += show.written_lines(board["written"])
    return [*lines, *(f"warning: {words}" for words in record["warnings"])]

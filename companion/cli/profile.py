"""`companion profile`: the noise of an IMU, from recordings of it at rest."""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgspec

from companion.cli.replay import add_table_options
from companion.cli.terminal import AddCommand, conclude, load_config, print_lines, seconds, storage_path
from companion.errors import CalibrationRefusedError, ConfigError, StorageError
from companion.formats import utc_now
from companion.physics.units import DEG_H, MG

if TYPE_CHECKING:
    from companion.config.sections import NoiseProfile
    from companion.estimation.noise.allan import AxisFit
    from companion.lab.logs.log import StillLog
    from companion.lab.profile import LearnedNoise, Rests

SHORT_S: Final = 1200
_UNITS: Final = {"gyro": (DEG_H, "deg/h", 1), "accel": (1e-3 * MG, "ug", 0)}


class Learned(NamedTuple):
    """Noise of one IMU, and the recordings that it comes from."""

    imu: str
    logs: list[StillLog]
    rests: list[Rests]
    finding: LearnedNoise
    compared: NoiseProfile
    notes: list[str]


def add_command(add: AddCommand) -> None:
    sub = add("profile", profile, "learn an IMU's noise from recordings of it at rest (docs/profiles.md)")
    sub.add_argument("files", nargs="+", type=Path, metavar="FILE", help="recordings (.mcap) or CSV logs")
    sub.add_argument("--imu", metavar="NAME", help="only this one; of CSV files: what theirs is called (default imu)")
    add_table_options(sub)
    words = "to compare with, and for what the recordings do not tell (default: as used)"
    sub.add_argument("--profile", metavar="PART", help=words)
    sub.add_argument("--skip", type=seconds, default=0.0, metavar="S", help="leave out so much at each beginning")
    sub.add_argument("--save", metavar="NAME", help='keep it: profile = "NAME" in [[imu]] then takes it')
    sub.add_argument("--storage", type=Path, metavar="DIR", help="where to (default: as in the configuration)")


async def profile(options: argparse.Namespace) -> int:
    from companion.estimation.noise.allan import noise_profile
    from companion.lab.logs.log import NAME
    from companion.lab.logs.log_files import read_logs
    from companion.storage.profiles import ProfileStore, check_name, given_profile

    store = compared = None
    if options.save is not None:
        check_name(options.save)
        store = ProfileStore(options.storage or load_config(options).storage.path)
    if options.profile is not None:
        given = given_profile(options.profile, lambda: options.storage or storage_path(options))
        compared = noise_profile(given)
    logs = read_logs(options.files, options.columns, options.rate, options.imu or NAME)
    names = dict.fromkeys(log.imu for log in logs)
    if options.imu is not None and options.imu not in names:
        raise StorageError(f"no IMU {options.imu!r} in these files; there are: {', '.join(names)}")
    results, refused = [], []
    for imu in names if options.imu is None else [options.imu]:
        try:
            results.append(_learn(imu, [log for log in logs if log.imu == imu], compared, options.skip))
        except CalibrationRefusedError as error:
            refused.append(f"imu {imu}: {error}")
    for words in refused:
        print_lines(f"companion: {words}", error=True)
    good = bool(results) and not refused
    lines = [line for result in results for line in _lines(result)]
    saved = None
    if store is not None and good:
        if len(results) > 1:
            found = ", ".join(result.imu for result in results)
            raise ConfigError(f"--save: found IMUs {found}; allowed: one; say which with --imu")
        saved = store.write(_to_save(results[0], options.save))
        lines.append(f'saved: {saved}; profile = "{options.save}" in [[imu]] takes it, after a restart')
        lines.append(f"check it: companion replay LOG --windows 60 --profile {saved}")
    state, file = "done" if good else "failed", None if saved is None else str(saved)
    answer = {"state": state, "reason": "; ".join(refused), "file": file}
    return conclude(options, {**answer, "imus": [_object(result) for result in results]}, lines, good=good)


def _learn(imu: str, logs: list[StillLog], compared: NoiseProfile | None, skip_s: float) -> Learned:
    """Estimate the noise of one IMU; raise CalibrationRefusedError where the recordings do not show it."""
    from companion.estimation.noise.allan import noise_profile
    from companion.lab.profile import Rests, fit_profile, rests

    whole = [log for log in logs if not log.truncated]
    if not whole:
        raise CalibrationRefusedError(
            "it was recorded in whole mrad/s and mg, cut toward zero: their steps hide the sensor's noise"
        )
    against = compared or noise_profile(whole[-1].profile)
    found = []
    for log in whole:
        parts = [rests(log.t_s[at], log.readings[at], imu, against) for at in log.pieces(skip_s)]
        stretches = tuple(rest for part in parts for rest in part.stretches)
        obstacle = next((part.obstacle for part in parts if part.obstacle), "")
        found.append(Rests(stretches, sum(part.seconds for part in parts), obstacle))
    obstacle = next((each.obstacle for each in found if each.obstacle), "")
    try:
        finding = fit_profile(imu, [stretch for each in found for stretch in each.stretches], against)
    except CalibrationRefusedError as error:
        in_the_way = f" (in the way: {obstacle})" if obstacle else ""
        raise CalibrationRefusedError(f"{error}{in_the_way}") from None
    notes = []
    if finding.kept:
        notes.append(
            f"too short to tell {', '.join(finding.kept)}: as in {against.name!r}, as far as the recordings allow"
        )
    if finding.still_s < SHORT_S:
        notes.append("less than 20 min at rest: an hour tells N and B, a night K too")
    if moved_s := sum(each.seconds - each.still_s for each in found):
        notes.append(f"{moved_s} s were not at rest and are left out{f' ({obstacle})' if obstacle else ''}")
    return Learned(imu, whole, found, finding, against, notes)


def _named(finding: LearnedNoise) -> Iterator[tuple[str, AxisFit, float, str, int]]:
    for column, fit in enumerate(finding.axes):
        triad = "gyro" if column < 3 else "accel"
        yield (f"{triad} {'xyz'[column % 3]}", fit, *_UNITS[triad])


def _lines(result: Learned) -> list[str]:
    finding = result.finding
    recordings = f"{len(result.logs)} recording{'s' if len(result.logs) > 1 else ''}"
    span = _temperatures(result.logs)
    degc = "" if span is None else f", {span[0]:.1f} to {span[1]:.1f} degC"
    lines = [f"imu {result.imu}: {finding.still_s / 3600.0:.2f} h at rest in {recordings}{degc}"]
    table = [("", ["N, x sqrt(s)", "floor A", "K, / sqrt(s)"])]
    for name, fit, unit, unit_name, digits in _named(finding):
        table.append((f"{name}, {unit_name}", [_cell(fit, which, unit, digits) for which in range(3)]))
    for triad, (unit, _, digits) in _UNITS.items():
        for name, noise in (("this profile", finding.profile), (result.compared.name, result.compared)):
            model = noise.gyro if triad == "gyro" else noise.accel
            figures = ((model.white, digits), (model.floor, digits), (model.walk, digits + 2))
            table.append((f"{triad}: {name}", [f"{value / unit:.{places}f}" for value, places in figures]))
    lines += [f"{first:24} " + " ".join(f"{cell:>16}" for cell in cells) for first, cells in table]
    for log, found in zip(result.logs, result.rests, strict=True):
        lines.append(f"used of {', '.join(log.files)}: {found.still_s} of {found.seconds} s")
        lines += [f"left out: {count} lines {why}" for why, count in log.left_out.items()]
        lines += [f"note: {note}" for note in log.notes]
    return lines + [f"note: {note}" for note in result.notes]


def _cell(fit: AxisFit, which: int, unit: float, digits: int) -> str:
    """Write a figure with its standard error, or its upper limit where the recordings do not show it."""
    from companion.estimation.noise.allan import FLOOR_OF_FLICKER

    factor = (1.0, FLOOR_OF_FLICKER, 1.0)[which] / unit
    digits += 2 * (which == 2)
    value, square = fit.figures[which], fit.sigmas[which]
    if fit.known[which]:
        return f"{value * factor:.{digits}f} +-{square / (2.0 * value) * factor:.{digits}f}"
    upper = fit.upper[which] * factor
    return f"< {upper:.{digits}f}" if math.isfinite(upper) else "not told"


def _temperatures(logs: Sequence[StillLog]) -> tuple[float, float] | None:
    import numpy as np

    degc = np.concatenate([log.temperature_degc for log in logs])
    known = degc[np.isfinite(degc)]
    return (float(known.min()), float(known.max())) if len(known) else None


def _to_save(result: Learned, name: str) -> Any:
    from companion.storage.profiles import FORMAT_VERSION, ProfileSource, SavedProfile

    learned = result.finding.profile
    sources = [
        ProfileSource(
            file=", ".join(log.files),
            began_at=log.began_at,
            still_s=float(rests.still_s),
            temperature_degc=_temperatures([log]),
        )
        for log, rests in zip(result.logs, result.rests, strict=True)
    ]
    return SavedProfile(
        format_version=FORMAT_VERSION,
        name=name,
        saved_at=utc_now(),
        imu=result.imu,
        gyro=learned.gyro,
        accel=learned.accel,
        kept_from=result.compared.name,
        kept=result.finding.kept,
        sources=tuple(sources),
        notes=tuple(result.notes),
        warm_up=learned.warm_up,
    )


def _object(result: Learned) -> dict[str, Any]:
    finding = result.finding
    return {
        "name": result.imu,
        "still_s": finding.still_s,
        "seconds": sum(each.seconds for each in result.rests),
        "recordings": [", ".join(log.files) for log in result.logs],
        "used": [
            {"seconds": found.seconds, "still_s": found.still_s, "left_out": log.left_out, "notes": log.notes}
            for log, found in zip(result.logs, result.rests, strict=True)
        ],
        "temperature_degc": _temperatures(result.logs),
        "profile": msgspec.to_builtins(finding.profile),
        "compared": msgspec.to_builtins(result.compared),
        "kept": list(finding.kept),
        # An upper limit that nobody knows is infinite; msgspec writes null for it.
        "axes": [{"fit": msgspec.json.decode(msgspec.json.encode(fit))} for fit in finding.axes],
        "notes": result.notes,
    }

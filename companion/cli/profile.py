"""Command `profile`: estimates the noise of an IMU from recordings of the IMU at rest."""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

import msgspec

from companion.cli.logs import add_table_options, log_lines
from companion.cli.terminal import CommandGroup, conclude, load_config, print_lines, seconds, storage_path
from companion.errors import CalibrationRefusedError, ConfigError, StorageError
from companion.formats import Object, utc_now
from companion.physics.units import DEG_H, MG
from companion.samples import TRIADS, Triad

if TYPE_CHECKING:
    from companion.config.sections import NoiseProfile
    from companion.estimation.noise.allan import AxisFit
    from companion.lab.still_log import StillLog
    from companion.storage.profiles import SavedProfile

SHORT_S: Final = 1200
LEAST_S: Final = 600  # Minimum time at rest: a profile from less fails its own test too often
_UNITS: Final[dict[Triad, tuple[float, str, int]]] = {"gyro": (DEG_H, "deg/h", 1), "accel": (1e-3 * MG, "ug", 0)}


def add_commands(log: CommandGroup) -> None:
    sub = log.add("profile", profile, "learn an IMU's noise from recordings of it at rest (docs/profiles.md)")
    sub.add_argument("files", nargs="+", type=Path, metavar="FILE", help="recordings (.mcap) or CSV logs")
    sub.add_argument("--imu", metavar="NAME", help="only this one; of CSV files: what theirs is called (default imu)")
    add_table_options(sub)
    words = "to compare with, and for what the recordings do not tell (default: as used)"
    sub.add_argument("--profile", metavar="PART", help=words)
    sub.add_argument("--skip", type=seconds, default=0.0, metavar="S", help="leave out so much at each beginning")
    sub.add_argument("--short", action="store_true", help="accept less than 10 min at rest, from 1 min on")
    sub.add_argument("--save", metavar="NAME", help='keep it: profile = "NAME" in [[imu]] then takes it')
    sub.add_argument("--storage", type=Path, metavar="DIR", help="where to (default: as in the configuration)")


async def profile(options: argparse.Namespace) -> int:
    from companion.estimation.noise.allan import noise_profile
    from companion.lab.log_files import read_logs
    from companion.lab.still_log import NAME
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
            results.append(
                _learn(imu, [log for log in logs if log.imu == imu], compared, options.skip, short=options.short)
            )
        except CalibrationRefusedError as error:
            refused.append(f"imu {imu}: {error}")
    for words in refused:
        print_lines(f"companion: {words}", error=True)
    good = bool(results) and not refused
    lines = [line for _, found, _ in results for line in found]
    file = None
    if store is not None and good:
        if len(results) > 1:
            found = ", ".join(saved.imu for saved, _, _ in results)
            raise ConfigError(f"--save: found IMUs {found}; allowed: one; say which with --imu")
        file = store.write(msgspec.structs.replace(results[0][0], name=options.save))
        lines.append(f'saved: {file}; profile = "{options.save}" in [[imu]] takes it, after a restart')
        lines.append(f"check it: companion log replay LOG --windows 60 --profile {file}")
    answer = {
        "state": "done" if good else "failed",
        "reason": "; ".join(refused),
        "file": None if file is None else str(file),
        "imus": [found for _, _, found in results],
    }
    return conclude(options, answer, lines, good=good)


def _learn(
    imu: str, logs: list[StillLog], compared: NoiseProfile | None, skip_s: float, *, short: bool
) -> tuple[SavedProfile, list[str], Object]:
    """Estimate the noise of one IMU; return the profile to save, the result as lines of text, and the result as JSON.

    Raises:
        CalibrationRefusedError: the recordings are too short or too coarse to show the noise.
    """
    from companion.estimation.noise.allan import noise_profile
    from companion.lab.profile import fit_profile, rests, seconds_at_rest
    from companion.storage.profiles import FORMAT_VERSION, ProfileSource, SavedProfile

    logs = [log for log in logs if len(log.t_s)]
    if not logs:
        raise CalibrationRefusedError(
            "it was recorded in whole mrad/s and mg, cut toward zero: their steps hide the sensor's noise"
        )
    against = compared or noise_profile(logs[-1].profile)
    found = [[rests(log.t_s[at], log.readings[at], imu, against) for at in log.pieces(skip_s)] for log in logs]
    obstacle = next((words for parts in found for *_, words in parts if words), "")
    try:
        stretches = [stretch for parts in found for part, _, _ in parts for stretch in part]
        learned, fits, kept = fit_profile(imu, stretches, against)
    except CalibrationRefusedError as error:
        in_the_way = f" (in the way: {obstacle})" if obstacle else ""
        raise CalibrationRefusedError(f"{error}{in_the_way}") from None
    still_s = [sum(seconds_at_rest(part) for part, _, _ in parts) for parts in found]
    if sum(still_s) < LEAST_S and not short:
        raise CalibrationRefusedError(
            f"only {sum(still_s)} s at rest; a profile needs {LEAST_S} s, better an hour (--short accepts less)"
        )
    seconds = [sum(number for _, number, _ in parts) for parts in found]
    notes = []
    if kept:
        notes.append(f"too short to tell {', '.join(kept)}: as in {against.name!r}, as far as the recordings allow")
    if sum(still_s) < SHORT_S:
        notes.append("less than 20 min at rest: an hour tells N and B, a night K too")
    if moved_s := sum(seconds) - sum(still_s):
        notes.append(f"{moved_s} s were not at rest and are left out{f' ({obstacle})' if obstacle else ''}")
    files, span = [", ".join(log.files) for log in logs], _temperatures(logs)
    saved = SavedProfile(
        format_version=FORMAT_VERSION,
        name=imu,
        saved_at=utc_now(),
        imu=imu,
        gyro=learned.gyro,
        accel=learned.accel,
        kept_from=against.name,
        kept=tuple(kept),
        sources=tuple(
            ProfileSource(file=file, began_at=log.began_at, still_s=float(still), temperature_degc=_temperatures([log]))
            for file, log, still in zip(files, logs, still_s, strict=True)
        ),
        notes=tuple(notes),
        warm_up=learned.warm_up,
    )
    degc = "" if span is None else f", {span[0]:.1f} to {span[1]:.1f} degC"
    recordings = f"{len(logs)} recording{'s' if len(logs) > 1 else ''}"
    lines = [f"imu {imu}: {sum(still_s) / 3600.0:.2f} h at rest in {recordings}{degc}", *_table(fits, learned, against)]
    used = []
    for file, log, still, whole in zip(files, logs, still_s, seconds, strict=True):
        lines.append(f"used of {file}: {still} of {whole} s")
        lines += log_lines(log.left_out, log.notes)
        used.append({"seconds": whole, "still_s": still, "left_out": log.left_out, "notes": log.notes})
    answer = {
        "name": imu,
        "still_s": sum(still_s),
        "seconds": sum(seconds),
        "recordings": files,
        "used": used,
        "temperature_degc": span,
        "profile": msgspec.to_builtins(learned),
        "compared": msgspec.to_builtins(against),
        "kept": kept,
        # An unknown upper limit is infinite; msgspec writes null for it.
        "axes": [{"fit": msgspec.json.decode(msgspec.json.encode(fit))} for fit in fits],
        "notes": notes,
    }
    return saved, lines + [f"note: {note}" for note in notes], answer


def _table(fits: Sequence[AxisFit], learned: NoiseProfile, compared: NoiseProfile) -> list[str]:
    table = [("", ["N, x sqrt(s)", "floor A", "K, / sqrt(s)"])]
    for column, fit in enumerate(fits):
        triad = TRIADS[column // 3]
        unit, name, digits = _UNITS[triad]
        cells = [_cell(fit, which, unit, digits) for which in range(3)]
        table.append((f"{triad} {'xyz'[column % 3]}, {name}", cells))
    for triad, (unit, _, digits) in _UNITS.items():
        for name, noise in (("this profile", learned), (compared.name, compared)):
            model = noise.of(triad)
            figures = ((model.white, digits), (model.floor, digits), (model.walk, digits + 2))
            table.append((f"{triad}: {name}", [f"{value / unit:.{places}f}" for value, places in figures]))
    return [f"{first:24} " + " ".join(f"{cell:>16}" for cell in cells) for first, cells in table]


def _cell(fit: AxisFit, which: int, unit: float, digits: int) -> str:
    """Format a noise figure with its standard error, or only its upper limit if the recordings do not determine it."""
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

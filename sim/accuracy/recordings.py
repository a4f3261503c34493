"""`python -m sim recordings DIR`: is sigma honest on real sensors, and is the estimate better than a plain mean?

DIR has one folder for each part, with recordings of it at rest, as `companion log replay` reads them. Files in its
folder `moving` were recorded in motion from beginning to end. Its file `part.toml` has what the recordings lack, all
optional: `profile` (of the catalogue), `columns`, `rate_hz`, `powered_s` (since switch-on, at the beginning of a file).

Every window is calibrated alone, as after a start. The window's truth is the plain mean of the raw samples of the
following 180 s (60 s at least where the recording ends before). The pose is the same in both, and cancels. Profiles:

- `default`: an unknown part;
- `catalogue`: the profile that part.toml names;
- `learned`: fitted to the other recordings of the part, if these have 10 minutes at rest.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
import tomllib
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Final

import msgspec
import numpy as np

from companion.config.sections import NoiseProfile
from companion.errors import CalibrationRefusedError, CompanionError
from companion.estimation.noise.allan import allan_variance, noise_profile
from companion.estimation.stillness.gates import ImuGate
from companion.lab.estimate import HORIZON_S, Given, calibrated, uncounted
from companion.lab.log_files import read_logs
from companion.lab.profile import Rest, fit_profile, rests, seconds_at_rest, seconds_of
from companion.lab.still_log import StillLog
from companion.physics.frames import Floats
from companion.physics.units import DEG_H, MG
from companion.samples import TRIADS, Triad, rows_of

WINDOWS_S: Final = (10.0, 30.0, 60.0)
LEAST_TRUTH_S: Final = 60.0
LEAST_LEARNED_S: Final = 600.0
_UNITS: Final[dict[Triad, tuple[float, str]]] = {"gyro": (DEG_H, "deg/h"), "accel": (MG, "mg")}
_HEAD: Final = ("part", "profile", "T", "windows", "refused", "2 sigma", "rms/sigma", "rms", "of mean", "naive")


class Part(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Content of a folder's `part.toml`."""

    profile: str | None = None
    columns: str | None = None
    rate_hz: float | None = None
    powered_s: float = 0.0


class Score:
    """Windows of one length under one profile: errors against the truth, in rad/s and m/s^2."""

    def __init__(self) -> None:
        self.windows = 0
        self.refused: Counter[str] = Counter()
        self._rows: list[Floats] = []  # Error, sigma_use and naive sigma of the estimate, error of the mean: (4, 6)

    def add(self, error: Floats, sigma: Floats, naive: Floats, of_mean: Floats) -> None:
        self._rows.append(np.array([error, sigma, naive, of_mean]))

    def merge(self, other: Score) -> None:
        self.windows += other.windows
        self.refused += other.refused
        self._rows += other._rows

    def cells(self, triad: Triad) -> tuple[str, ...]:
        """Format a row: coverage, rms/sigma, rms error, its ratio to the plain mean's, the naive sigma's coverage."""
        if not self._rows:
            return ("-",) * 5
        error, sigma, naive, of_mean = np.array(self._rows)[:, :, rows_of(triad)].transpose(1, 0, 2)
        unit, name = _UNITS[triad]
        rms, plain = (math.sqrt(np.square(each).mean()) for each in (error, of_mean))
        return (
            f"{(np.abs(error) <= 2.0 * sigma).mean():.1%}",
            f"{math.sqrt(np.square(error / sigma).mean()):.2f}",
            f"{rms / unit:.3g} {name}",
            f"{rms / plain:.3f}",
            f"{(np.abs(error) <= 2.0 * naive).mean():.1%}",
        )


def scored(logs: Iterable[StillLog], profile: NoiseProfile, powered_s: float, length_s: float) -> Score:
    """Calibrate every window of a length, and compare the biases with the raw samples after the window."""
    score = Score()
    for log in logs:
        for window in calibrated(log, Given(powered=powered_s, profile=profile), length_s):
            score.windows += 1
            if window.biases is None:
                score.refused[uncounted(window.why)] += 1
            elif (after := _truth(log, window.end)) is not None:
                truth, seen = after
                here = log.readings[window.start : window.end]
                mean = here.mean(axis=0)
                bias, _, sigma = window.biases
                # A bias is a mean minus the bias-free reading of the pose; so is the truth's.
                error = bias - (truth - window.by_pose)
                naive = here.std(axis=0) / math.sqrt(len(here))
                score.add(error, np.hypot(sigma, seen), np.hypot(naive, seen), mean - truth)
    return score


def _truth(log: StillLog, start: int) -> tuple[Floats, Floats] | None:
    """Return the mean (6,) of the raw samples after a window, and its sigma by white noise; None: too few samples."""
    if start >= len(log.t_s):
        return None
    end = int(np.searchsorted(log.t_s, log.t_s[start] + HORIZON_S))
    seconds = seconds_of(log.t_s[start:end], log.readings[start:end])
    if len(seconds) < LEAST_TRUTH_S:
        return None
    slots, means = np.array([each.slot for each in seconds]), np.array([each.mean for each in seconds])
    variance, _ = allan_variance(slots, means, 1)
    return log.readings[start:end].mean(axis=0), np.sqrt(variance / len(seconds))


def learned(at_rest: Sequence[Sequence[Rest]], but: int) -> NoiseProfile | None:
    """Fit a profile to all recordings of a part except one; None: the recordings are too short."""
    found = [rest for number, one in enumerate(at_rest) if number != but for rest in one]
    if seconds_at_rest(found) < LEAST_LEARNED_S:
        return None
    try:
        return fit_profile("learned", found, noise_profile(None))[0]
    except CalibrationRefusedError:
        return None


def judged_still(logs: Iterable[StillLog]) -> tuple[int, int]:
    """Count the seconds in recordings of motion, and how many of them the gate judges motionless, without a profile."""
    still = seconds = 0
    for log in logs:
        gate = ImuGate(log.imu, noise_profile(None))
        for batch in seconds_of(log.t_s, log.readings):
            seconds += 1
            verdict = gate.judge(batch)
            still += verdict.still
            gate.accept(batch) if verdict.still else gate.new_stretch()
    return seconds, still


def part_rows(folder: Path) -> Iterator[Sequence[str]]:
    """Yield the rows of one part's table.

    Raises:
        CompanionError: a recording or part.toml cannot be read.
    """
    facts = folder / "part.toml"
    part = msgspec.convert(tomllib.loads(facts.read_text("utf-8")) if facts.exists() else {}, Part)

    def logs_in(place: Path) -> list[StillLog]:
        files = sorted(path for path in place.glob("*") if path.is_file() and path.name != "part.toml")
        return read_logs(files, part.columns, part.rate_hz) if files else []

    logs = [log for log in logs_in(folder) if len(log.t_s)]
    profiles: dict[str, list[tuple[NoiseProfile, list[StillLog]]]] = {"default": [(noise_profile(None), logs)]}
    if part.profile is not None:
        profiles["catalogue"] = [(noise_profile(part.profile), logs)]
    at_rest = [rests(log.t_s, log.readings, log.imu, noise_profile(None))[0] for log in logs]
    elsewhere = [(profile, [log]) for k, log in enumerate(logs) if (profile := learned(at_rest, k)) is not None]
    if elsewhere:
        profiles["learned"] = elsewhere
    for name, pairs in profiles.items():
        for length_s in WINDOWS_S:
            score = Score()
            for profile, some in pairs:
                score.merge(scored(some, profile, part.powered_s, length_s))
            refused = f"{score.refused.total() / max(score.windows, 1):.1%}"
            for triad in TRIADS:
                first = (
                    (folder.name, name, f"{length_s:g} s", str(score.windows), refused)
                    if triad == "gyro"
                    else ("",) * 5
                )
                yield (*first, *score.cells(triad))
            for why, count in score.refused.most_common(2):
                yield ("", f"{count} refused: {why}")
    if moving := logs_in(folder / "moving"):
        seconds, still = judged_still(moving)
        yield (folder.name, f"moving: {still} of {seconds} s judged still")


def parser() -> argparse.ArgumentParser:
    made = argparse.ArgumentParser(prog="python -m sim recordings", description=__doc__)
    made.formatter_class = argparse.RawDescriptionHelpFormatter
    made.add_argument("folder", type=Path, metavar="DIR", help="one folder for each part")
    return made


def main(arguments: Sequence[str] | None = None) -> int:
    folder = parser().parse_args(arguments).folder
    parts = sorted(path for path in folder.glob("*") if path.is_dir())
    if not parts:
        sys.stderr.write(f"{folder}: found no folder in it; allowed: one folder for each part\n")
        return 2
    print(_line(_HEAD))
    for each in parts:
        begun_s = time.process_time()
        try:
            for row in part_rows(each):
                print(_line(row), flush=True)
        except (CompanionError, msgspec.ValidationError, tomllib.TOMLDecodeError) as error:
            sys.stderr.write(f"{each}: {error}\n")
            return 1
        print(f"{'':14} {time.process_time() - begun_s:.1f} s of processor time", flush=True)
    return 0


def _line(cells: Sequence[str]) -> str:
    if len(cells) < len(_HEAD):
        return f"{cells[0]:14} {' '.join(cells[1:])}"
    return f"{cells[0]:14} {cells[1]:10}" + "".join(f"{cell:>12}" for cell in cells[2:])


if __name__ == "__main__":
    sys.exit(main())

"""A noise profile out of a night's recording: 2.8 h at 100 Hz, a million samples of six axes, against reading them.

`python -m tests.bench_learning`; a part of `make bench`.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final, TypeVar

import numpy as np

from companion.estimation.noise.allan import noise_profile
from companion.lab.logs.csv_log import read
from companion.lab.profiling.coverage import Kept, coverage
from companion.lab.profiling.profile_fit import Rests, fit_profile, rests
from tests.support.made_noise import DEG_H, adis16405, write_csv

SECONDS: Final = 10080
RATE_HZ: Final = 100
ROUNDS: Final = 3

T = TypeVar("T")


def best(work: Callable[[], T]) -> tuple[float, T]:
    """The best of some rounds in processor time, and what came of it."""
    best_s = float("inf")
    for _ in range(ROUNDS):
        start_s = time.process_time()
        result = work()
        best_s = min(best_s, time.process_time() - start_s)
    return best_s, result


def table() -> None:
    """Print it."""
    part = noise_profile(None)
    with tempfile.TemporaryDirectory() as folder:
        path = write_csv(Path(folder) / "night.csv", *adis16405(SECONDS, RATE_HZ, seed=1))

        def seconds() -> Rests:
            log = read(path)
            return rests(log.t_s, log.readings, log.temperature_degc, "adis", part)

        def all_of_it() -> list[Kept]:
            found = seconds()
            fit_profile("adis", found.stretches, part)
            return coverage([found.stretches], part)

        floor_s, _ = best(lambda: np.loadtxt(path, delimiter=",", skiprows=1))
        read_s, found = best(seconds)
        whole_s, kept = best(all_of_it)
    print(
        f"\na noise profile from 2.8 h at 100 Hz ({SECONDS * RATE_HZ} samples), processor time, x numpy.loadtxt alone:"
    )
    for words, took_s in (("reading the CSV file", floor_s), ("seconds and stillness", read_s), ("all of it", whole_s)):
        print(f"{words:44} {took_s:6.2f} s {took_s / floor_s:6.1f}")
    print(f"at rest {found.still_s} of {found.seconds} s; the next minute within 2 sigma:")
    for each in kept:
        use = each.sigma_use / (DEG_H if each.triad == "gyro" else 9.80665e-6)
        print(
            f"  {each.triad:6} T {each.mean_s:3} s  sigma_use {use:6.1f} {'deg/h' if each.triad == 'gyro' else 'ug':6}"
            f" {each.share:6.1%}"
        )


if __name__ == "__main__":
    table()

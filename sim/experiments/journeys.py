"""`python -m sim drive | flights`: how the attitude holds after a calibration, as tables and, on request, as a page."""

from __future__ import annotations

import argparse
import datetime
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from companion.report import svg
from companion.report.markup import Markup, tag
from companion.report.page import page
from sim.earth import Array
from sim.experiments import peers
from sim.experiments.setups import CIRCLES, DRIVE, SHUTTLE
from sim.experiments.trials import Setup, Trial, many, rms

PAPER_DEG: Final = {"pitch": 2.0, "roll": 1.5, "heading": 5.0}
"""Section 5.2: "about 2, 1.5 and 5 degrees in 180 second"; one run."""
AXES: Final = (("pitch", 1), ("roll", 0), ("heading", 2))
PHONE_PLOTS: Final = 40
"""Number of seeds drawn."""


def main(argv: Sequence[str]) -> int:
    """Run one of the two; returns the exit code."""
    top = argparse.ArgumentParser(prog="python -m sim")
    commands = top.add_subparsers(dest="command", required=True)
    for name, text in (
        ("drive", "180 s in a car from 9.52 degrees of roll, beside the paper's figure 1"),
        ("flights", "banked circles and shuttling, beside the filters of others"),
    ):
        command = commands.add_parser(name, help=text, description=text)
        command.add_argument("--seeds", type=int, default=100 if name == "drive" else 4, help="default %(default)s")
        command.add_argument("--jobs", type=int, default=2, help="processes (default 2)")
        command.add_argument("--html", type=Path, metavar="FILE", help="write a page with plots as well")
    arguments = top.parse_args(argv)
    if arguments.seeds < 1 or arguments.jobs < 1:
        top.error("--seeds and --jobs are at least 1")
    parts = _drive(arguments) if arguments.command == "drive" else _flights(arguments)
    if arguments.html is not None:
        now = datetime.datetime.now(datetime.UTC)
        arguments.html.write_text(
            page(f"Simulated {arguments.command}", now, *parts, source="by simulation"), encoding="utf-8"
        )
        print(f"\nPlots: {arguments.html}")
    return 0


class Table(NamedTuple):
    """Figures with what they are."""

    about: tuple[str, ...]
    head: tuple[str, ...]
    rows: list[tuple[str, ...]]

    def text(self) -> str:
        """For a terminal."""
        width = max(len(row[0]) for row in self.rows) + 2
        lines = [*self.about, ""]
        for first, *others in (self.head, *self.rows):
            lines.append(f"{first:{width}}" + "".join(f"{other:>9}" for other in others))
        return "\n".join(lines)

    def html(self) -> Markup:
        """For a page."""
        head = tag("tr", tag("th", ""), *(tag("th", word, class_="no") for word in self.head[1:]))
        rows = [tag("tr", tag("td", row[0]), *(tag("td", word, class_="no") for word in row[1:])) for row in self.rows]
        return tag("div", *(tag("p", line) for line in self.about), tag("table", head, *rows))


def _drive(arguments: argparse.Namespace) -> list[Markup]:
    trials = many(DRIVE, range(arguments.seeds), jobs=arguments.jobs)
    rows: list[tuple[str, ...]] = []
    for name in ("companion", "companion, no compass", "not calibrated"):
        ends = rms(np.array([trial.errors_deg[name][-1] for trial in trials]))
        rows.append((name, *(f"{ends[column]:.2f}" for _, column in AXES)))
    rows.append(("the paper, one drive", *(f"{PAPER_DEG[axis]:.1f}" for axis, _ in AXES)))
    whole = [
        rms(np.array([trial.errors_deg["companion"][:, column] for trial in trials]), (0, 1)) for _, column in AXES
    ]
    covered = np.mean([np.abs(trial.errors_deg["companion"]) < 2.0 * trial.sigma_deg for trial in trials], axis=(0, 1))
    rows.append(("companion, all the way", *(f"{value:.2f}" for value in whole)))
    rows.append(("within 2 of its sigmas", *(f"{covered[column]:.0%}" for _, column in AXES)))
    about = (
        f"{len(trials)} drives of 180 s from roll 9.52 deg, an {DRIVE.part.upper()} calibrated for 60 s before each.",
        "Errors at 180 s, degrees rms over the drives:",
    )
    found = Table(about, ("", *(axis for axis, _ in AXES)), rows)
    print(found.text())
    return [tag("h1", "A drive of 180 s"), found.html(), *_plots(trials)]


def _flights(arguments: argparse.Namespace) -> list[Markup]:
    others, missing = peers.available()
    parts: list[Markup] = [tag("h1", "Flights without GPS, airspeed or compass")]
    for setup in (CIRCLES, SHUTTLE):
        trials = many(setup, range(arguments.seeds), others, jobs=arguments.jobs)
        found = _compared(setup, trials)
        print(found.text(), end="\n\n")
        parts += [tag("h2", setup.name), found.html(), *_plots(trials)]
    if missing:
        print(missing, file=sys.stderr)
    return parts


def _compared(setup: Setup, trials: Sequence[Trial]) -> Table:
    about = (
        (
            f"{setup.name}, {setup.seconds:.0f} s, {setup.part} at {setup.rate_hz:.0f} Hz, {len(trials)} flights, all"
            " on the same samples, all but one after the same calibration. Tilt, degrees:"
        ),
    )
    rows: list[tuple[str, ...]] = []
    for name in trials[0].tilt_deg:
        if name == "companion, no compass":
            continue
        tilts = np.array([trial.tilt_deg[name] for trial in trials])
        rows.append((name, f"{rms(tilts, (0, 1)):.2f}", f"{tilts.max():.2f}"))
    return Table(about, ("", "rms", "worst"), rows)


def _plots(trials: Sequence[Trial]) -> list[Markup]:
    """Errors over time of every drive, and twice the sigma that is claimed; uncalibrated below."""
    drawn = trials[:PHONE_PLOTS]
    figures = []
    for name in ("companion", "not calibrated"):
        plots = []
        for number, (axis, column) in enumerate(AXES):
            series = [trial.errors_deg[name][::4, column] for trial in drawn]
            sigma: Array = np.mean([trial.sigma_deg[::4, column] for trial in drawn], axis=0)
            reach = [float(value) for value in (*np.concatenate(series), *(2.0 * sigma), *(-2.0 * sigma))]
            times = drawn[0].times_s[::4].tolist()
            plot = svg.Plot(
                svg.linear(times),
                svg.linear(reach, ticks=5),
                name=f"{name}: error of {axis}",
                x_label="time, s" if number == 2 else None,
                y_label=f"{name}: {axis}, deg",
            )
            for values in series:
                plot.line(list(zip(times, values.tolist(), strict=True)), f"curve {('sx', 'sy', 'sz')[number]}")
            if name == "companion":
                for sign in (2.0, -2.0):
                    plot.line(list(zip(times, (sign * sigma).tolist(), strict=True)), "floor")
            plots.append(plot.svg())
        figures.append(tag("figure", *plots))
    figures.append(tag("p", "Dashed: twice the sigma that the companion states.", class_="soft"))
    return figures

"""`python -m sim fly`: flights of a real firmware with our heading, and the effect of a fault."""

from __future__ import annotations

import argparse
import asyncio
import itertools
import random
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from sim.flying.flight import FAULTS, SET_UPS, WATCHED_S, Plan, SetUp, flying
from sim.flying.verdict import HEADER, Figures, Record, figures, row, summary
from sim.sitl.process import BinaryError

OWN_COMPASS = "own-compass"
HELP = "A real firmware flies with our heading, and something fails: the largest errors, as a table."


def parser() -> argparse.ArgumentParser:
    command = argparse.ArgumentParser(prog="python -m sim fly", description=HELP)
    command.add_argument("--binary", type=Path, required=True, help="the firmware: arducopter, arduplane or px4")
    command.add_argument(
        "--fault", choices=tuple(FAULTS), action="append", default=[],
        help="what happens (default: each of them); may be repeated: "
        + "; ".join(f"{name}: {words}" for name, (words, _) in FAULTS.items()),
    )  # fmt: skip
    command.add_argument(
        "--set-up", choices=tuple(SET_UPS), action="append", default=[],
        help="how the autopilot is set up (default script); may be repeated: "
        + "; ".join(f"{name}: {words}" for name, words in SET_UPS.items()),
    )  # fmt: skip
    command.add_argument(
        "--wind", type=float, nargs=2, metavar=("M_S", "FROM_DEG"), help="default: 3 to 8 m/s, by the seed"
    )
    command.add_argument("--seed", type=int, default=0, help="of wind, heading and noise (default 0)")
    command.add_argument(
        "--flights", type=int, default=1, metavar="N",
        help="so many of each, with seeds from that one on; a last line has the largest figures (default 1)",
    )  # fmt: skip
    command.add_argument(
        "--watch", type=float, default=WATCHED_S, metavar="SECONDS",
        help=f"how long it flies on after the fault (default {WATCHED_S:g})",
    )  # fmt: skip
    command.add_argument("--dir", type=Path, help="keep all files here (default: a new folder)")
    return command


def plans_of(arguments: argparse.Namespace) -> list[Plan]:
    """Return the flights that the options ask for, sorted by fault and set-up; each seed has its own wind."""
    plans = []
    px4 = "px4" in arguments.binary.name
    if any((set_up == "px4") is not px4 for set_up in arguments.set_up):
        raise BinaryError(f"--set-up: {', '.join(arguments.set_up)}: px4 is that of PX4, the others are ArduPilot's")
    if px4 and OWN_COMPASS in arguments.fault:
        raise BinaryError("--fault own-compass: the compass of PX4's simulation cannot be turned; ArduPilot's can")
    able = [fault for fault in FAULTS if not px4 or fault != OWN_COMPASS]
    set_ups: list[SetUp] = ["px4"] if px4 else arguments.set_up or ["script"]
    seeds = range(arguments.seed, arguments.seed + arguments.flights)
    for fault, set_up, seed in itertools.product(arguments.fault or able, set_ups, seeds):
        dice = random.Random(f"{fault} {seed}")
        wind = (round(dice.uniform(3.0, 8.0), 1), round(dice.uniform(0.0, 360.0)))
        heading_deg = float(round(dice.uniform(0.0, 360.0)))
        plans.append(
            Plan(
                arguments.binary, fault, set_up, tuple(arguments.wind or wind), heading_deg,
                seed, arguments.watch,
            )
        )  # fmt: skip
    return plans


async def fly(plan: Plan, folder: Path) -> tuple[Record, Figures]:
    async with flying(plan, folder, time.time()) as flight:
        await flight.set_up()
        await flight.calibrate()
        record = await flight.fly()
    return record, figures(record)


def main(argv: Sequence[str]) -> int:
    """Fly; 0: every flight was good, 1: one was not, 2: one failed to start."""
    command = parser()
    arguments = command.parse_args(argv)
    try:
        plans = plans_of(arguments)
    except BinaryError as error:
        command.error(str(error))
    folder = (arguments.dir or Path(tempfile.mkdtemp(prefix="companion-flights-"))).absolute()
    worst = 0
    print(HEADER, flush=True)
    for (fault, set_up), same in itertools.groupby(plans, lambda plan: (plan.fault, plan.set_up)):
        flights = [flown(plan, folder) for plan in same]
        if len(flights) > 1:
            print(summary(fault, set_up, flights), flush=True)
        worst = max(worst, *(2 if found is None else bool(found.wrong) for found in flights))
    print(f"Records, logs and the firmware's files: {folder}", file=sys.stderr)
    return worst


def flown(plan: Plan, folder: Path) -> Figures | None:
    """Fly once and print the line of the table; None if the flight failed to start."""
    plan = replace(plan, stored=folder / f"set-up-{plan.set_up}")
    try:
        record, found = asyncio.run(fly(plan, folder / f"{plan.fault}-{plan.set_up}-{plan.seed}"))
    except (BinaryError, RuntimeError, TimeoutError, OSError, KeyError, ValueError) as error:
        print(f"{plan.fault:16}{plan.set_up:9}did not come about: {error}", file=sys.stderr, flush=True)
        return None
    print(row(record, found), flush=True)
    return found

"""`python -m sim accuracy`: print the tables of docs/accuracy.md."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from typing import Final

SECTIONS: Final = (
    "white", "floors", "tilt", "warm-up", "integers", "deck", "turning", "by-hand", "compasses", "power-up",
    "mid-warm-up", "until-ready",
)  # fmt: skip
HELP: Final = "errors and sigmas of the estimator, beside the physical bound"


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--runs", type=int, default=2000, help="stands with white noise (default 2000); others scale")
    parser.add_argument("--seed", type=int, default=1, help="of everything (default 1)")
    parser.add_argument("--only", help=f"sections, comma between: {','.join(SECTIONS)}")
    parser.add_argument("--jobs", type=int, default=2, help="processes (default 2)")


def main(argv: Sequence[str]) -> int:
    """Run the command; return 0 if every claim holds, otherwise 1."""
    from sim.accuracy.tables import report

    parser = argparse.ArgumentParser(prog="python -m sim accuracy", description=f"Monte Carlo: {HELP}.")
    add_options(parser)
    arguments = parser.parse_args(argv)
    only = SECTIONS if arguments.only is None else tuple(arguments.only.split(","))
    if arguments.runs < 1 or arguments.jobs < 1 or arguments.seed < 0:
        parser.error("--runs and --jobs are at least 1, --seed is not negative")
    if unknown := sorted(set(only) - set(SECTIONS)):
        parser.error(f"--only knows {','.join(SECTIONS)}, not {','.join(unknown)}")
    begun_s = time.monotonic()

    def progress(words: str) -> None:
        print(f"{words} ...", file=sys.stderr, flush=True)

    found = report(arguments.runs, arguments.seed, only, arguments.jobs, progress)
    claims = [claim for section in found.values() for claim in section.claims]
    for section in found.values():
        print("\n".join([f"## {section.title}", "", *section.lines]), end="\n\n")
    if claims:
        print("\n".join(["## What must hold", "", *map(str, claims)]), end="\n\n")
    print(f"{time.monotonic() - begun_s:.0f} s, seed {arguments.seed}", file=sys.stderr)
    return 0 if all(claim.holds for claim in claims) else 1

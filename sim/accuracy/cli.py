"""`python -m sim accuracy`: the tables of docs/accuracy.md, made anew."""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Final

from sim.accuracy.figures import Figure

if TYPE_CHECKING:
    from sim.accuracy.figures import Section

SECTIONS: Final = (
    "white",
    "floors",
    "methods",
    "tilt",
    "warm-up",
    "integers",
    "deck",
    "turning",
    "by-hand",
    "power-up",
    "mid-warm-up",
    "paper",
)
HELP: Final = "errors and sigmas of the estimator, beside the physical bound and what else is done"


def add_options(parser: argparse.ArgumentParser) -> None:
    """Everything that it takes."""
    parser.add_argument("--runs", type=int, default=2000, help="stands with white noise (default 2000); others scale")
    parser.add_argument("--seed", type=int, default=1, help="of everything (default 1)")
    parser.add_argument("--only", help=f"sections, comma between: {','.join(SECTIONS)}")
    parser.add_argument("--jobs", type=int, default=2, help="processes (default 2)")
    parser.add_argument("--json", action="store_true", help="figures with standard errors, as one JSON object")


def main(argv: Sequence[str]) -> int:
    """Run it; 0 when every claim holds, 1 when one does not."""
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
    if arguments.json:
        print(json.dumps(_as_json(found, arguments.runs, arguments.seed), indent=1))
    else:
        for section in found.values():
            print("\n".join([f"## {section.title}", "", *section.lines]), end="\n\n")
        if claims:
            print("\n".join(["## What must hold", "", *map(str, claims)]), end="\n\n")
    print(f"{time.monotonic() - begun_s:.0f} s, seed {arguments.seed}", file=sys.stderr)
    return 0 if all(claim.holds for claim in claims) else 1


def _as_json(found: dict[str, Section], runs: int, seed: int) -> dict[str, Any]:
    claims = [
        {
            "words": claim.words,
            "unit": claim.unit,
            "found": _plain(claim.found),
            "at_least": claim.at_least,
            "at_most": claim.at_most,
            "holds": claim.holds,
        }
        for section in found.values()
        for claim in section.claims
    ]
    sections = {name: {"title": one.title, "figures": _plain(one.figures)} for name, one in found.items()}
    return {"runs": runs, "seed": seed, "sections": sections, "claims": claims}


def _plain(value: Any) -> Any:
    """Figures as {"value", "standard_error"}; NaN as null."""
    if isinstance(value, Figure):
        return {"value": _plain(value.value), "standard_error": _plain(value.error)}
    if isinstance(value, dict):
        return {key: _plain(one) for key, one in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(one) for one in value]
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    return value
